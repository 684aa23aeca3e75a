// What the shadings cost elsewhere, by the prices of facerender/pricing/shown.py.
let prices = null;  // of each of facts.prices; data that is unpacked first

const priceName = term => [
  term.model, term.lobe === "g-power" ? `g-power ${term.g}` : term.lobe,
  ...modelOf(term).factors ? [term.fresnel, term.masking] : [],
].join(" ");

const slopeKind = ({constant, m, small}) => {
  const own = constant ?? m;
  const plain = small === "plain" || own >= registry.small_slope ? "plain" : "small";
  if (own === null) return small === "plain" ? "own plain" : "own";
  return constant === null ? plain : `constant ${plain}`;
};

// What a fragment costs; null where something that is drawn has no price.
function fragmentPrice({lights: known, dull, normal, shining}, term, {lights, ambient}) {
  const each = lights.map(light => known[lightKind(light)] ?? null);
  if (each.includes(null)) return null;
  const flat = term.normal === "on" ? 0 : normal;
  const lit = each.reduce((sum, price) => sum + price, 0) - flat;
  const around = Number(term.ambient === "on" && ambient.some(Boolean));
  const numbers = lights.map((_, i) => lightTerm(term, i)).filter(number => number >= 0).sort();
  if (!numbers.length || (term.weight ?? term.ks) === 0) return dull[around] + lit;
  const weight = term.weight !== null ? "weight" : term.ks !== null ? "given" : "own";
  const {fixed, terms} = shining[slopeKind(term)][weight];
  const names = [term, {...term, ...registry.frontal}].map(priceName);
  const lobes = numbers.map((number, i) => terms[names[number]]?.[Math.min(i, 1)] ?? null);
  return lobes.includes(null) ? null : lobes.reduce((sum, price) => sum + price, fixed[around] + lit);
}

// The same of a picture without highlights, of A and of B, and what B costs more.
function fragmentPrices(target, state) {
  const {a, b} = state;
  const [base, ...both] = [{...a, ks: 0, weight: null}, a, b].map(term => fragmentPrice(target, term, state));
  const difference = both.includes(null) ? null : +(both[1] - both[0]).toFixed(6);  // without 1e-15
  return {base, a: both[0], b: both[1], difference};
}
