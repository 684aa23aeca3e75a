// What the shadings cost elsewhere, by the prices of facerender/pricing/shown.py.
let prices = null;  // of each of facts.prices; data that is unpacked first

const priceName = term => [
  term.model, term.lobe === "g-power" ? `g-power ${term.g}` : term.lobe,
  ...modelOf(term).factors ? [term.fresnel, term.masking] : [],
].join(" ");

// What a fragment costs with a term, or without one where it is null; null where something that is
// drawn has no price.
function fragmentPrice({lights: known, dull, shining}, term, {lights, ambient}) {
  const each = lights.map(light => known[lightKind(light)] ?? null);
  if (each.includes(null)) return null;
  const lit = each.reduce((sum, price) => sum + price, 0);
  const around = Number(ambient.some(Boolean));
  if (!term || !lights.length || term.ks === 0) return dull[around] + lit;
  const slope = term.m === null ? "own" : term.m < registry.small_slope ? "small" : "plain";
  const {fixed, terms} = shining[slope][term.ks === null ? "own" : "given"];
  const [first, further] = terms[priceName(term)] ?? [null];
  return first === null ? null : fixed[around] + lit + first + (lights.length - 1) * further;
}

// The same of a picture without highlights, of A and of B, and what B costs more.
function fragmentPrices(target, state) {
  const [base, a, b] = [null, state.a, state.b].map(term => fragmentPrice(target, term, state));
  const difference = a === null || b === null ? null : +(b - a).toFixed(6);  // without 1e-15
  return {base, a, b, difference};
}
