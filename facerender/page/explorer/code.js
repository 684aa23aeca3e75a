// The same picture elsewhere: its GLSL, a diff of A to B, the command line, TOML, Python.
const changedFields = (term, names) => names.filter(name => term[name] !== null);

// Fields of the shading that are not the first ones, by their names in TOML and Python.
function shadingFields(term) {
  const own = {};
  if (term.model !== firstModel) own.model = term.model;
  if (term.lobe !== Object.keys(registry.lobes)[0]) own.lobe = term.lobe;
  if (modelOf(term).factors) {
    if (term.fresnel !== firstFresnel) own.fresnel = term.fresnel;
    if (term.masking !== firstMasking) own.masking = term.masking;
  }
  return own;
}

// What a plan decided that no option says.
function plannedFields(term, count) {
  const own = {};
  const lights = [...Array(count).keys()];
  const some = names => lights.filter(i => among(names, i));
  if (term.constant !== null) own.m = term.constant;
  if (term.weight !== null) own.ks = term.weight;
  if (term.small === "plain") own.small_slope = false;
  if (term.normal === "off") own.normal_map = false;
  if (term.ambient === "off") own.ambient = false;
  if (some(term.dark).length) own.specular_lights = lights.filter(i => !among(term.dark, i));
  if (modelOf(term).factors && some(term.frontal).length) own.frontal_lights = some(term.frontal);
  return own;
}

const rounded = list => list.map(short).join(", ");

function pointOf(light) {
  return scaledBy(directionTo(light.azimuth, light.elevation), light.distance * facts.radius)
    .map((x, i) => x + facts.center[i]);
}

// Without the maps in whose place the term has something of its own.
function meshWords(term) {
  const {roughness_map: roughness, specular_map: weight, normal_map: normal, ...others} = facts.mesh.maps;
  return [
    facts.mesh.shell, ...Object.values(others), ownSlope(term) === null && roughness,
    term.weight === null && weight, term.normal === "on" && normal,
  ];
}

function commandLine(state, which, [width, height]) {
  const term = state[which];
  const words = ["facerender render", ...meshWords(term)];
  if (Object.keys(plannedFields(term, state.lights.length)).length) {
    words.push(`--scene ${which}.toml`);
    if (state.exposure) words.push(`--exposure ${short(state.exposure)}`);
    if (state.only !== "all") words.push(`--only ${state.only}`);
    words.push(`--size ${width}x${height}`, `-o ${which}.png`);
    return words.filter(Boolean).join(" \\\n    ");
  }
  const own = term.lobe === "g-power";
  if (own) words.push(`--scene ${which}.toml`);
  for (const [name, value] of Object.entries(shadingFields(term))) {
    if (!own) words.push(`--${name} ${value}`);
  }
  for (const name of changedFields(term, ["m", "f0", "ks"])) words.push(`--${name} ${short(term[name])}`);
  for (const light of state.lights) {
    const place = light.distance === null
      ? `${short(light.azimuth)},${short(light.elevation)}` : `point:${pointOf(light).map(short)}`;
    const size = light.radius ? `,radius=${short(light.radius)}` : "";
    words.push(`--light ${place},${light.irradiance.map(short)}${size}`);
  }
  const {azimuth, elevation, zoom, fov} = state.camera;
  words.push(`--ambient ${state.ambient.map(short)}`, `--background ${facts.background.map(short)}`);
  words.push(`--camera ${short(azimuth)},${short(elevation)},${short(zoom)}`, `--fov ${short(fov)}`);
  if (state.exposure) words.push(`--exposure ${short(state.exposure)}`);
  if (state.only !== "all") words.push(`--only ${state.only}`);
  words.push(`--size ${width}x${height}`, `-o ${which}.png`);
  const line = words.filter(Boolean).join(" \\\n    ");
  return state.lights.length ? line
    : `# without a light: --light cannot say none, so write the scene file\n${line}`;
}

function toml(state, which) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const lights = state.lights.map(light => {
    const place = light.distance === null
      ? `azimuth = ${short(light.azimuth)}, elevation = ${short(light.elevation)}`
      : `position = [${rounded(pointOf(light))}]`;
    const size = light.radius ? `, radius = ${short(light.radius)}` : "";
    return `    { ${place}, irradiance = [${rounded(light.irradiance)}]${size} },\n`;
  });
  const lines = [
    `# ${["facerender render", ...meshWords(term), `--scene ${which}.toml -o ${which}.png`]
      .filter(Boolean).join(" ")}`,
    `ambient = [${rounded(state.ambient)}]`,
    `background = [${rounded(facts.background)}]`,
    lights.length ? `lights = [\n${lights.join("")}]` : "lights = []", "",
    "[camera]", `azimuth = ${short(azimuth)}`, `elevation = ${short(elevation)}`,
    `zoom = ${short(zoom)}`, `fov = ${short(fov)}`,
  ];
  const material = changedFields(term, ["m", "f0", "ks"]);
  if (material.length) lines.push("", "[material]", ...material.map(name => `${name} = ${short(term[name])}`));
  const decided = Object.entries({...shadingFields(term), ...plannedFields(term, state.lights.length)});
  const shading = decided.map(([name, value]) => value === "g-power"
    ? `lobe = { g = ${term.g}, factor = ${literal(term.factor)}, offset = ${literal(term.offset)} }`
    : `${name} = ${JSON.stringify(value)}`);
  if (shading.length) lines.push("", "[shading]", ...shading);
  return lines.join("\n") + "\n";
}

function python(state, which, [width, height]) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const lights = state.lights.map(light => {
    const size = light.radius ? `, radius=${short(light.radius)}` : "";
    const power = `irradiance=(${rounded(light.irradiance)})`;
    return light.distance === null
      ? `    fr.Light(${short(light.azimuth)}, ${short(light.elevation)}, ${power}${size}),\n`
      : `    fr.Light(position=(${rounded(pointOf(light))}), ${power}${size}),\n`;
  });
  const material = changedFields(term, ["m", "f0", "ks"]).map(name => `${name}=${short(term[name])}`);
  const decided = Object.entries({...shadingFields(term), ...plannedFields(term, state.lights.length)});
  const shading = decided.map(([name, value]) => value === "g-power"
    ? `lobe=GPower(${term.g}, ${literal(term.factor)}, ${literal(term.offset)})`
    : `${name}=${value === false ? "False" : JSON.stringify(value)}`);
  const mesh = material.length
    ? `${facts.mesh.python}.with_material(${material.join(", ")})` : facts.mesh.python;
  const only = state.only === "all" ? "" : `, only="${state.only}"`;
  return [
    "import facerender as fr",
    ...term.lobe === "g-power" ? ["from facerender.lobes import GPower"] : [], "",
    `lights = (\n${lights.join("")})`,
    `camera = fr.Camera(${short(azimuth)}, ${short(elevation)}, fov=${short(fov)}, zoom=${short(zoom)})`,
    `scene = fr.Scene(\n    ${mesh},\n    camera,\n    lights,\n    ambient=(${rounded(state.ambient)}),`
      + `\n    background=(${rounded(facts.background)}),\n)`,
    `with fr.Renderer((${width}, ${height})) as renderer:`,
    `    frame = renderer.render(scene, fr.Shading(${shading.join(", ")})${only})`,
    `frame.save("${which}.png"${state.exposure ? `, ${short(state.exposure)}` : ""})`,
  ].join("\n") + "\n";
}

// Lines of one text and another: "-", "+" or " " before each; the longest common subsequence.
function diff(before, after) {
  const [a, b] = [before.split("\n"), after.split("\n")];
  let start = 0;
  while (start < a.length && start < b.length && a[start] === b[start]) ++start;
  let end = 0;
  while (end < a.length - start && end < b.length - start && a.at(-1 - end) === b.at(-1 - end)) ++end;
  const [left, right] = [a.slice(start, a.length - end), b.slice(start, b.length - end)];
  const lengths = Array.from({length: left.length + 1}, () => new Uint16Array(right.length + 1));
  for (let i = left.length - 1; i >= 0; --i) {
    for (let j = right.length - 1; j >= 0; --j) {
      lengths[i][j] = left[i] === right[j]
        ? 1 + lengths[i + 1][j + 1] : Math.max(lengths[i + 1][j], lengths[i][j + 1]);
    }
  }
  const lines = a.slice(0, start).map(line => [" ", line]);
  for (let i = 0, j = 0; i < left.length || j < right.length;) {
    if (i < left.length && j < right.length && left[i] === right[j]) {
      lines.push([" ", left[i]]);
      ++i;
      ++j;
    } else if (j === right.length || i < left.length && lengths[i + 1][j] >= lengths[i][j + 1]) {
      lines.push(["-", left[i++]]);
    } else {
      lines.push(["+", right[j++]]);
    }
  }
  return [...lines, ...a.slice(a.length - end).map(line => [" ", line])];
}

const CONTEXT = 3;  // lines around a change

// A diff with what has not changed left out; the places of it say how many lines.
function hunks(lines) {
  const near = lines.map(() => false);
  lines.forEach(([sign], i) => {
    if (sign === " ") return;
    for (let j = Math.max(i - CONTEXT, 0); j <= i + CONTEXT && j < near.length; ++j) near[j] = true;
  });
  const shown = [];
  for (let i = 0; i < lines.length;) {
    let end = i;
    while (end < lines.length && !near[end]) ++end;
    if (end > i) shown.push(["@", `${end - i} lines the same`]);
    else shown.push(lines[end++]);
    i = end;
  }
  return shown;
}
