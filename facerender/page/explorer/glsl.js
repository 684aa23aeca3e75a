// A term's GLSL: the macros that choose it, its call, the library's file with them resolved.
let sources = null;  // by role; data that is unpacked first

const modelOf = term => registry.models[term.model];
const lobeOf = term => term.lobe === "g-power" ? registry.g_power : registry.lobes[term.lobe];

// A slope in place of the file's, or null.
const ownSlope = ({constant, m}) => constant ?? m;

// The macros of all that a term's call reads, for slopes from the smallest on.
function lobeMacros(term, smallest) {
  const lobe = lobeOf(term);
  const macros = {FR_LOBE: lobe.macro};
  if (term.lobe === "g-power") {
    const {constant, factor} = term;
    const offset = term.offset ? ` - ${literal(term.offset)}` : "";
    macros.FR_G = String(term.g);
    macros["FR_STEEPNESS(m, k)"] = constant === null
      ? `(${literal(factor)} / ((m) * (m))${offset})` : literal(factor / constant ** 2 - term.offset);
  }
  const plain = term.small === "plain" || (term.constant ?? smallest) >= registry.small_slope;
  if (lobe.by_angle && plain) macros.FR_SMALL_SLOPE = "0";
  return macros;
}

function termMacros(term, smallest) {
  const macros = lobeMacros(term, smallest);
  if (modelOf(term).factors) {
    macros.FR_FRESNEL = registry.fresnel[term.fresnel];
    macros.FR_MASKING = registry.masking[term.masking];
  }
  if (term.constant !== null) macros["FR_SLOPE(m)"] = literal(term.constant);
  return macros;
}

function termCall(term) {
  const words = {
    m: term.constant === null ? "m" : literal(term.constant), lobe: lobeOf(term).macro,
    fresnel: registry.fresnel[term.fresnel], masking: registry.masking[term.masking],
  };
  return modelOf(term).call.replace(/\{(\w+)\}/g, (_, word) => words[word]);
}

const defined = macros =>
  Object.entries(macros).map(([name, value]) => `#define ${name} ${value}`.trimEnd() + "\n").join("");

// Text without the branches that macros decide and without include guards, as glsl/includes.py leaves
// them out. Conditions of comparisons and defined() are understood; others stay.
function resolved(text, chosen) {
  const macros = new Map(Object.entries(chosen).map(([name, value]) => [name.split("(")[0], value]));
  const open = [];
  const lines = [];
  const all = values => values.includes(false) ? false : values.includes(null) ? null : true;
  const any = values => values.includes(true) ? true : values.includes(null) ? null : false;

  function value(word) {
    for (let i = 0; i < 8 && macros.has(word); ++i) word = macros.get(word);
    return /^(0|[1-9]\d*)$/.test(word) ? +word : null;
  }

  function comparison(term) {
    const asked = term.match(/^(!?)defined (\w+)$/);
    if (asked) return macros.has(asked[2]) ? !asked[1] : null;
    const [, a, sign, b] = term.match(/^(\w+)\s*(==|!=|<=|>=|<|>)\s*(\w+)$/) ?? [0, term, "!=", "0"];
    const [left, right] = [value(a), value(b)];
    if (left === null || right === null) return null;
    return {"==": left === right, "!=": left !== right, "<": left < right, ">": left > right,
      "<=": left <= right, ">=": left >= right}[sign];
  }

  function truth(directive, condition) {
    if (directive === "else") return true;
    if (directive !== "if" && directive !== "elif") {
      return macros.has(condition) ? directive === "ifdef" : null;
    }
    const plain = condition.replace(/defined\s*\(\s*(\w+)\s*\)/g, "defined $1");
    if (/[()\\]/.test(plain)) return null;
    return any(plain.split("||").map(part => all(part.split("&&").map(s => comparison(s.trim())))));
  }

  function branch(directive, rest, line) {
    const current = open.at(-1);
    const found = current.over ? false : current.guard || truth(directive, rest);
    current.active = found !== false;
    current.over ||= found === true;
    if (found === null) {
      lines.push(current.stays || directive !== "elif" ? line : `#if ${rest}`);
      current.stays = true;
    } else if (found && current.stays) {
      lines.push("#else");
    }
  }

  for (const line of text.split("\n")) {
    const code = line.replace(/\/\/.*/, "");
    const [, directive, rest] = code.match(/^\s*#\s*(\w+)\s*(.*?)\s*$/) ?? [];
    const active = open.every(each => each.active);
    if (directive === "if" || directive === "ifdef" || directive === "ifndef") {
      const guard = directive === "ifndef" && rest.endsWith("_GLSL");
      open.push({active: false, over: !active, stays: false, guard});
      branch(directive, rest, line);
    } else if (directive === "elif" || directive === "else") {
      branch(directive, rest, line);
    } else if (directive === "endif") {
      if (open.pop().stays) lines.push(line);
    } else if (active) {
      const [, name, meaning] = directive === "define"
        ? rest.match(/^(\w+)(?:\([^)]*\))?\s*(.*)$/) : [];
      const sure = open.every(each => each.guard || !each.stays);
      if (name && sure && !macros.has(name)) macros.set(name, meaning);
      lines.push(line);
    }
  }
  return lines.join("\n");
}

// What facerender shaders flatten prints of a term's model, with every choice made.
function flattened(term, target, smallest) {
  const macros = termMacros(term, smallest);
  const pinned = term.constant === null ? "" : `, m = ${literal(term.constant)} whatever the caller passes`;
  const [origin, licence, , ...body] = sources.models[term.model].split("\n");
  const text = [
    `#version ${facts.targets[target]}`,
    origin.replace(/\.$/, `, lobe ${lobeName(term)}${pinned}.`), licence, defined(macros).trimEnd(), "",
    resolved(body.join("\n"), macros),
  ].join("\n");
  return text.replace(/\n{3,}/g, "\n\n").trimEnd() + "\n";
}

function lobeName({lobe, g, factor, offset}) {
  if (lobe !== "g-power") return lobe;
  const less = offset ? ` ${offset > 0 ? "-" : "+"} ${+Math.abs(offset).toPrecision(5)}` : "";
  return `g-power ${g} (${+factor.toPrecision(5)}/m^2${less})`;
}

// The host's two programs for a part: the picture, and all that it reads at a pixel.
function surfaceHead(part, term) {
  const out = [
    ...ownSlope(term) === null ? [] : ["ROUGHNESS_MAP"],
    ...term.weight === null ? [] : ["SPECULAR_MAP"],
    ...term.normal === "on" ? [] : ["NORMAL_MAP", "SLOPE_FILTER"],
  ];
  const own = part.features.filter(name => !out.includes(name));
  if (term.constant !== null) own.push("CONSTANT_SLOPE");
  return "#version 300 es\n" + own.map(name => `#define ${name}\n`).join("");
}

function vertexSource(part, term) {
  return surfaceHead(part, term) + sources.host["surface.vert"];
}

const among = (lights, i) => lights.split(",").includes(String(i));

// The number of a light's term: -1 for none, 1 for that of frontal light.
const lightTerm = ({dark, frontal}, i) => among(dark, i) ? -1 : +among(frontal, i);

function shadeSource(part, term, {lights, ambient, only}, specular = true) {
  const head = [surfaceHead(part, term)];
  if (only === "all" && part.uniforms.diffuse_brdf > 0) head.push("#define DIFFUSE\n");
  if (only === "all" && term.ambient === "on" && ambient.some(Boolean)) head.push("#define AMBIENT\n");
  const smallest = ownSlope(term) ?? part.slopes[0];
  if (!specular) {
    head.push("precision highp float;\n");
  } else {
    head.push(
      defined(lobeMacros(term, smallest)), sources.models[term.model], "#define SPECULAR\n",
      "float specular_term(int term, vec3 n, vec3 l, vec3 v, float m, float f0) {\n",
      ...term.frontal && [`    if (term == 1) return ${termCall({...term, ...registry.frontal})};\n`],
      `    return ${termCall(term)};\n}\n`,
    );
  }
  const loops = [];
  for (const [kind, text] of Object.entries(sources.lights)) {
    const terms = lights.flatMap((light, i) => lightKind(light) === kind ? [lightTerm(term, i)] : []);
    if (!terms.length) continue;
    head.push(`#define ${kind.toUpperCase()}_LIGHTS ${terms.length}\n`, text);
    for (let start = 0, end = 0; start < terms.length; start = end) {
      while (terms[end] === terms[start]) ++end;
      loops.push(`for (int i = ${start}; i < ${end}; ++i) `
        + `add_light(s, v, ${kind}_light(i, s.position), ${terms[start]});`);
    }
  }
  return [...head, `#define EVERY_LIGHT ${loops.join(" ")}\n`, sources.host["shade.frag"]].join("");
}

function gbufferSource(part, term) {
  return surfaceHead(part, term) + sources.host["gbuffer.frag"];
}
