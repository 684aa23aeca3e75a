// Builds the GLSL of a term, and of the programs that draw it, from texts in the page's data.
let sources = null;  // GLSL texts, keyed by role; null until the texts are unpacked.

const modelOf = term => registry.models[term.model];
const lobeOf = term => term.lobe === "g-power" ? registry.g_power : registry.lobes[term.lobe];
// Returns a term with the factors for a part: m, f0 and ks of the term apply only to skin, a constant
// m of the term to every part.
const termOf = (part, term) => ({
  ...term, ...!part.skin && {m: null, f0: null, ks: null},
  ...term.constant !== null && {m: term.constant},
});

// Returns a term's function call, and its GLSL without #include, valid for m >= smallest.
function termSource(term, smallest) {
  const plain = lobeOf(term).by_angle && smallest >= registry.small_slope;
  const factors = modelOf(term).factors ? [term.fresnel, term.masking] : [];
  const key = [term.model, term.lobe, ...factors, ...plain ? ["plain"] : []].join(" ");
  const {lines, call} = sources.terms[key];
  const text = lines.map(i => sources.lines[i]).join("\n") + "\n";
  if (term.lobe !== "g-power") return {text, call};
  const offset = term.offset ? ` - ${literal(term.offset)}` : "";
  const steepness = `(${literal(term.factor)} / ((m) * (m))${offset})`;
  return {call, text: text.replace(/(?<=^#define FR_G ).*/m, term.g)
    .replace(/(?<=^#define FR_STEEPNESS\(m, k\) ).*/m, steepness)};
}

const lobeName = ({lobe, g, factor, offset}) =>
  lobe === "g-power" ? `g-power ${g}, factor ${short(factor)}, offset ${short(offset)}` : lobe;

// Returns the first lines of the renderer's programs for a part: the part's features as macros.
function surfaceHead(part, term) {
  const own = part.features.filter(
    name => termOf(part, term).m === null || name !== "ROUGHNESS_MAP");
  return "#version 300 es\n" + own.map(name => `#define ${name}\n`).join("");
}

const vertexSource = (part, term) => surfaceHead(part, term) + sources.host["surface.vert"];
const gbufferSource = (part, term) => surfaceHead(part, term) + sources.host["gbuffer.frag"];

function shadeSource(part, term, {lights, ambient, only}, specular = true) {
  const head = [surfaceHead(part, term)];
  if (only === "all" && part.uniforms.diffuse_brdf > 0) head.push("#define DIFFUSE\n");
  if (only === "all" && ambient.some(Boolean)) head.push("#define AMBIENT\n");
  if (specular) {
    const {text, call} = termSource(term, termOf(part, term).m ?? part.slopes[0]);
    head.push(text, "#define SPECULAR\n",
      "float specular_term(vec3 n, vec3 l, vec3 v, float m, float f0) {\n",
      term.constant === null ? "" : `    m = ${literal(term.constant)};\n`,
      `    return ${call};\n}\n`);
  } else {
    head.push("precision highp float;\n");
  }
  const loops = [];
  for (const [kind, text] of Object.entries(sources.lights)) {
    const count = lights.filter(light => lightKind(light) === kind).length;
    if (!count) continue;
    head.push(`#define ${kind.toUpperCase()}_LIGHTS ${count}\n`, text);
    loops.push(`for (int i = 0; i < ${count}; ++i) add_light(s, v, ${kind}_light(i, s.position), true);`);
  }
  return [...head, `#define EVERY_LIGHT ${loops.join(" ")}\n`, sources.host["shade.frag"]].join("");
}
