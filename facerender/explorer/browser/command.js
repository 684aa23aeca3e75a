// Writes the command line that draws the page's image, and its scene file.
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
const needsFile = (term, lights) => term.lobe === "g-power" || term.constant !== null
  || !lights.length || facts.mesh.pose !== "" || facts.mesh.material.length > 0;

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

// The page draws no shadows, so its command and its scene file turn them off.
function commandLine(state, which, size) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const option = ([name, value]) => `--${name} ${value}`;
  return [
    "facerender render", ...meshWords(term),
    ...needsFile(term, state.lights) ? [`--scene ${which}.toml`]
      : Object.entries(shadingFields(term)).map(option),
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
  ].join(" \\\n    ");
}

const lineOf = ([name, value]) =>
  `${name} = ${Array.isArray(value) ? `[${value.join(", ")}]` : value}`;
const linesOf = table => Object.entries(table).map(lineOf);

function sceneFile(state, which, size) {
  const term = state[which];
  const lobe = value => value === "g-power"
    ? `{ g = ${term.g}, factor = ${literal(term.factor)}, offset = ${literal(term.offset)} }`
    : JSON.stringify(value);
  const section = (name, lines) => lines.length ? ["", `[${name}]`, ...lines] : [];
  const camera = Object.fromEntries(Object.keys(ranges.camera).map(name => [name, short(state.camera[name])]));
  const aim = Object.entries(facts.aim).map(([name, value]) => lineOf([name, JSON.stringify(value)]));
  const lights = state.lights.map(light => `    { ${linesOf({
    ...light.distance === null ? {azimuth: short(light.azimuth), elevation: short(light.elevation)}
      : {position: pointOf(light).map(short)},
    irradiance: light.irradiance.map(short), ...light.radius && {radius: short(light.radius)},
    shadow: false,
  }).join(", ")} },\n`);
  return [
    `# ${["facerender render", ...meshWords(term), `--scene ${which}.toml`, ...imageWords(state, which, size)].join(" ")}`,
    lineOf(["ambient", state.ambient.map(short)]), lineOf(["background", facts.background.map(short)]),
    lights.length ? `lights = [\n${lights.join("")}]` : "lights = []",
    ...section("camera", [...linesOf(camera), ...aim]),
    ...section("material", [...facts.mesh.material, ...linesOf(materialFields(term))]),
    ...section("shading", Object.entries(shadingFields(term)).map(([name, value]) => lineOf([name, lobe(value)]))),
    ...facts.mesh.pose ? ["", facts.mesh.pose.trimEnd()] : [],
  ].join("\n") + "\n";
}
