// Writes code that draws the page's image (command line, TOML, Python or GLSL), and the diff of two
// texts.
const rounded = list => list.map(short).join(", ");

const materialFields = term => Object.fromEntries(
  ["m", "f0", "ks"].filter(name => term[name] !== null).map(name => [name, short(term[name])]));

// Returns the fields of the shading that differ from their defaults, keyed by their names in TOML.
function shadingFields(term) {
  const first = {model: firstModel, lobe: Object.keys(registry.lobes)[0],
    ...modelOf(term).factors && {fresnel: firstFresnel, masking: firstMasking}};
  const m = term.constant === null ? {} : {m: +short(term.constant)};
  return {...m, ...Object.fromEntries(
    Object.keys(first).filter(name => term[name] !== first[name]).map(name => [name, term[name]]))};
}

// Returns whether the command needs the scene file: some values have no option.
const needsFile = term => term.lobe === "g-power" || term.constant !== null
  || facts.mesh.pose !== "" || facts.mesh.material.toml.length > 0;

// Returns the arguments of an image that a scene file does not contain.
const imageWords = (state, which, size) => [
  ...state.exposure ? [`--exposure ${short(state.exposure)}`] : [],
  ...state.only === "all" ? [] : [`--only ${state.only}`],
  `--size ${size.join("x")}`, `-o ${which}.png`,
];

function pointOf(light) {
  return scaledBy(directionTo(light), light.distance * facts.radius).map((x, i) => x + facts.center[i]);
}

// Returns the command-line arguments of the mesh, without the roughness map if the term sets m.
function meshWords(term) {
  const {roughness_map: roughness, ...others} = facts.mesh.maps;
  return [facts.mesh.shell, ...Object.values(others), term.m === null && roughness].filter(Boolean);
}

function commandLine(state, which, size) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const option = ([name, value]) => `--${name} ${value}`;
  const lines = [
    "facerender render", ...meshWords(term),
    ...needsFile(term) ? [`--scene ${which}.toml`] : Object.entries(shadingFields(term)).map(option),
    ...Object.entries(materialFields(term)).map(option),
    ...state.lights.map(light => {
      const place = light.distance === null
        ? `${short(light.azimuth)},${short(light.elevation)}` : `point:${pointOf(light).map(short)}`;
      const radius = light.radius ? `,radius=${short(light.radius)}` : "";
      return `--light ${place},${light.irradiance.map(short)}${radius},no-shadow`;
    }),
    `--ambient ${state.ambient.map(short)}`, `--background ${facts.background.map(short)}`,
    `--camera ${short(azimuth)},${short(elevation)},${short(zoom)}`, `--fov ${short(fov)}`,
    ...Object.entries(facts.aim).map(option), ...imageWords(state, which, size),
  ];
  return (state.lights.length ? "" : "# No light: use the TOML scene file, because --light needs a light.\n")
    + lines.join(" \\\n    ");
}

// TOML tables and Python calls of a scene differ only in the syntax of a field and of false (`no`).
// The page draws no shadows, so its code turns them off.
const lightFields = (light, no) => ({
  ...light.distance === null ? {azimuth: short(light.azimuth), elevation: short(light.elevation)}
    : {position: pointOf(light).map(short)},
  irradiance: light.irradiance.map(short), ...light.radius && {radius: short(light.radius)},
  shadow: no,
});
const fieldsOf = (table, form) => Object.entries(table).map(([name, value]) => form(name, value));

function toml(state, which, size) {
  const term = state[which];
  const field = (name, value) => `${name} = ${Array.isArray(value) ? `[${value.join(", ")}]` : value}`;
  const lobe = value => value === "g-power"
    ? `{ g = ${term.g}, factor = ${literal(term.factor)}, offset = ${literal(term.offset)} }`
    : JSON.stringify(value);
  const section = (name, fields) => fields.length ? ["", `[${name}]`, ...fields] : [];
  const camera = Object.fromEntries(Object.keys(ranges.camera).map(name => [name, short(state.camera[name])]));
  const aim = Object.entries(facts.aim).map(([name, value]) => field(name, JSON.stringify(value)));
  const lights = state.lights.map(light => `    { ${fieldsOf(lightFields(light, "false"), field).join(", ")} },\n`);
  return [
    `# ${["facerender render", ...meshWords(term), `--scene ${which}.toml`, ...imageWords(state, which, size)].join(" ")}`,
    `ambient = [${rounded(state.ambient)}]`, `background = [${rounded(facts.background)}]`,
    lights.length ? `lights = [\n${lights.join("")}]` : "lights = []",
    ...section("camera", [...fieldsOf(camera, field), ...aim]),
    ...section("material", [...facts.mesh.material.toml, ...fieldsOf(materialFields(term), field)]),
    ...section("shading", fieldsOf(shadingFields(term), (name, value) => field(name, lobe(value)))),
    ...facts.mesh.pose ? ["", facts.mesh.pose.trimEnd()] : [],
  ].join("\n") + "\n";
}

function python(state, which, size) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const field = (name, value) => `${name}=${Array.isArray(value) ? `(${value.join(", ")})` : value}`;
  const lobe = value => value === "g-power"
    ? `GPower(${term.g}, ${literal(term.factor)}, ${literal(term.offset)})` : JSON.stringify(value);
  const lights = state.lights.map(light => `    fr.Light(${fieldsOf(lightFields(light, "False"), field).join(", ")}),\n`);
  const material = [...facts.mesh.material.python, ...fieldsOf(materialFields(term), field)].join(", ");
  const shading = fieldsOf(shadingFields(term), (name, value) => field(name, lobe(value))).join(", ");
  const mesh = facts.mesh.python + (material && `.with_skin(${material})`);
  const only = state.only === "all" ? "" : `, only="${state.only}"`;
  return [
    "import facerender as fr", ...mesh.includes("np.load") ? ["import numpy as np"] : [],
    ...term.lobe === "g-power" ? ["from facerender.lobes import GPower"] : [], "",
    `lights = (\n${lights.join("")})`,
    `camera = fr.Camera(${short(azimuth)}, ${short(elevation)}, fov=${short(fov)}, zoom=${short(zoom)}`
      + `${Object.entries(facts.aim).map(([name, value]) => `, ${name}=${JSON.stringify(value)}`).join("")})`,
    `scene = fr.Scene(\n    ${mesh},\n    camera,\n    lights,\n    ambient=(${rounded(state.ambient)}),`
      + `\n    background=(${rounded(facts.background)}),\n)`,
    `with fr.Renderer((${size.join(", ")})) as renderer:`,
    `    frame = renderer.render(scene, fr.Shading(${shading})${only})`,
    `frame.save("${which}.png"${state.exposure ? `, ${short(state.exposure)}` : ""})`,
  ].join("\n") + "\n";
}

// Returns the code of A or B; form is "command", "toml", "python", or a target of GLSL.
function codeOf(state, which, form, size) {
  const forms = {command: commandLine, toml, python};
  if (forms[form]) return forms[form](state, which, size);
  const {text} = termSource(state[which], smallestSlope(state[which]));
  return `#version ${facts.targets[form]}\n${text}`;
}

// Returns the diff of two texts (longest common subsequence): pairs of "-", "+" or " " and a line.
function diff(before, after) {
  const [a, b] = [before.split("\n"), after.split("\n")];
  const lengths = Array.from({length: a.length + 1}, () => new Uint16Array(b.length + 1));
  for (let i = a.length - 1; i >= 0; --i) {
    for (let j = b.length - 1; j >= 0; --j) {
      lengths[i][j] = a[i] === b[j] ? 1 + lengths[i + 1][j + 1] : Math.max(lengths[i + 1][j], lengths[i][j + 1]);
    }
  }
  const lines = [];
  for (let i = 0, j = 0; i < a.length || j < b.length;) {
    if (i < a.length && a[i] === b[j]) {
      lines.push([" ", a[i++]]);
      ++j;
    } else if (j === b.length || i < a.length && lengths[i + 1][j] >= lengths[i][j + 1]) {
      lines.push(["-", a[i++]]);
    } else {
      lines.push(["+", b[j++]]);
    }
  }
  return lines;
}

const CONTEXT = 3;  // Unchanged lines that are shown before and after a change.

// Replaces the lines of a diff that are far from a change by "@" and the number of these lines.
function hunks(lines) {
  const near = lines.map((_, i) =>
    lines.slice(Math.max(i - CONTEXT, 0), i + CONTEXT + 1).some(([sign]) => sign !== " "));
  return lines.flatMap((line, i) => {
    if (near[i]) return [line];
    const end = near.indexOf(true, i);
    const count = (end < 0 ? lines.length : end) - i;
    return i && !near[i - 1] ? [] : [["@", `${count} unchanged lines`]];
  });
}
