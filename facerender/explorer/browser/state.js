// The state of the page, the URL fragment that stores its differences from the first state, and the
// command line and the scene file that draw the page's image.
const facts = JSON.parse(document.getElementById("facts").textContent);  // explorer/page.py writes it.
const {registry, ranges} = facts;

const mapped = (table, value) =>
  Object.fromEntries(Object.entries(table).map(([name, each]) => [name, value(each, name)]));

const radians = degrees => degrees * Math.PI / 180;
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const isWithin = (value, [low, high]) => value >= low && value <= high;

// Returns a number with six significant digits, and as text without trailing zeros.
const rounded = x => +x.toPrecision(6);
const short = x => String(rounded(x));

// Returns a number as text of at most seven characters for an input, with two or more digits.
function narrow(x) {
  const texts = [6, 5, 4, 3, 2].map(digits => String(+x.toPrecision(digits)));
  return texts.find(text => text.length <= 7) ?? texts.at(-1);
}

// Returns a number as text with three significant digits for display, never with an exponent.
function figure(x) {
  if (!Number.isFinite(x)) return "not finite";
  if (x === 0) return "0";
  if (Math.abs(x) < 0.001) return "< 0.001";
  const digits = clamp(2 - Math.floor(Math.log10(Math.abs(x))), 0, 4);
  return x.toLocaleString("en", {minimumFractionDigits: digits, maximumFractionDigits: digits});
}

// Returns a literal of a float: GLSL ES does not convert integers to floats.
const literal = x => /[.e]/.test(x) ? String(x) : `${x}.0`;

const SHOWS = {wipe: "A | B", a: "A", b: "B", difference: "|A − B|"};
const ONLY = {all: "all terms", specular: "specular"};
const SWATCH = {a: "A", b: "B"};
const MOST_GAIN = 4096;
const POWER = ["g", "factor", "offset"];  // numbers that only the lobe g-power has

const modelOf = term => registry.models[term.model];
const isPower = term => term.lobe === "g-power";
const lobeOf = term => registry.lobes[term.lobe];
const lobeName = term => isPower(term)
  ? `g-power ${term.g}, factor ${short(term.factor)}, offset ${short(term.offset)}` : term.lobe;
// Returns a term with the factors for a part: m, f0 and ks of the term apply only to skin, a constant
// m of the term to every part.
const termOf = (part, term) => ({
  ...term, ...!part.skin && {m: null, f0: null, ks: null},
  ...term.constant !== null && {m: term.constant},
});

// A term's m, f0 and ks: null selects the value of the mesh file. constant: m of a plan for all parts,
// or null. gain: null fits the gain to the largest error.
const firstState = () => structuredClone({
  ...facts.first, show: "wipe", only: "all", cut: 0.5, gain: null, budget: null, exposure: 0,
});
let state = firstState();

// Parsers of the fields; they return undefined for invalid text.
const oneOf = names => text => names.includes(text) ? text : undefined;
const within = range => text =>
  text.trim() !== "" && isWithin(Number(text), range) ? Number(text) : undefined;
const optional = parse => text => text === "" ? null : parse(text);
const isColour = values =>
  values.length === 3 && values.every(value => isWithin(value, ranges.light.irradiance));

function lightOf(text) {
  const [azimuth, elevation, ...rest] = text.split(",").map(Number);
  const [irradiance, radius = 0, distance = null] = [rest.slice(0, 3), ...rest.slice(3)];
  const light = {azimuth, elevation, irradiance, radius, distance};
  const good = isColour(irradiance) && (distance === null || distance > 1)
    && ["azimuth", "elevation", "radius"].every(name => isWithin(light[name], ranges.light[name]));
  return good ? light : undefined;
}

const TERM_FIELDS = {
  model: oneOf(Object.keys(registry.models)),
  lobe: oneOf(Object.keys(registry.lobes)),
  fresnel: oneOf(registry.fresnel),
  masking: oneOf(registry.masking),
  ...mapped(ranges.term, (range, name) => POWER.includes(name) ? within(range) : optional(within(range))),
  g: text => Number.isInteger(Number(text)) ? within(ranges.term.g)(text) : undefined,
};
const TABLES = {a: TERM_FIELDS, b: TERM_FIELDS, camera: mapped(ranges.camera, within)};
const FIELDS = {
  lights(text) {
    const lights = text === "none" ? [] : text.split(";").map(lightOf);
    return lights.includes(undefined) || lights.length > facts.most_lights ? undefined : lights;
  },
  ambient(text) {
    const ambient = text.split(",").map(Number);
    return isColour(ambient) ? ambient : undefined;
  },
  show: oneOf(Object.keys(SHOWS)),
  only: oneOf(Object.keys(ONLY)),
  cut: within([0, 1]),
  gain: optional(within([1, MOST_GAIN])),
  budget: optional(within([0, 255])),
  exposure: within(ranges.image.exposure),
};

// Returns a value as text, which the parsers above read.
function textOf(value) {
  if (typeof value === "number") return short(value);
  if (!Array.isArray(value)) return value ?? "";
  if (typeof value[0] === "number") return value.map(short).join(",");
  return value.map(({azimuth, elevation, irradiance, radius, distance}) => textOf([
    azimuth, elevation, ...irradiance, ...radius || distance !== null ? [radius] : [],
    ...distance !== null ? [distance] : [],
  ])).join(";") || "none";
}

function fragmentOf() {
  const first = firstState();
  const changes = (fields, now, before, sign) => Object.keys(fields)
    .filter(name => textOf(now[name]) !== textOf(before[name]))
    .map(name => `${name}${sign}${textOf(now[name])}`);
  const words = Object.entries(TABLES).map(([table, fields]) => {
    const used = changes(fields, state[table], first[table], ":")
      .filter(word => isPower(state[table]) || !POWER.includes(word.split(":")[0]));
    return used.length ? `${table}=${used.join(";")}` : "";
  });
  return [...words.filter(Boolean), ...changes(FIELDS, state, first, "=")].join("&");
}

// Returns the state of a URL fragment, and the invalid parts of the fragment.
function stateOf(fragment) {
  const result = firstState();
  const unknown = [];
  const assign = (into, fields, [name, text = ""], words) => {
    const value = Object.hasOwn(fields, name) ? fields[name](text) : undefined;
    if (value === undefined) unknown.push(words);
    else into[name] = value;
  };
  for (const pair of decodeURIComponent(fragment.replace(/^#/, "")).split("&").filter(Boolean)) {
    const [name, text = ""] = pair.split("=");
    if (!TABLES[name]) assign(result, FIELDS, [name, text], pair);
    else for (const each of text.split(";")) {
      assign(result[name], TABLES[name], each.split(":"), `${SWATCH[name] ?? name} ${each}`);
    }
  }
  return {state: result, unknown};
}

// Returns the reason why facerender render refuses m of a term; "" if m is in the domain of the lobe.
function outsideDomain(term) {
  const highest = Math.max(...facts.parts.map(part => termOf(part, term).m ?? part.slopes[1]));
  const {k} = modelOf(term);
  const {ends: {[k]: end}, open} = lobeOf(term);
  const inside = open.includes(k) ? highest < end : highest <= end * (1 + 1e-6);
  return inside ? "" : `m reaches ${figure(highest)}, but ${lobeName(term)} is valid only up to `
    + `${figure(end)} with this model: facerender render needs --outside exact`;
}

const fieldsOf = (term, names, isSet) =>
  Object.fromEntries(names.filter(name => isSet(term[name], name)).map(name => [name, term[name]]));
const materialFields = term =>
  mapped(fieldsOf(term, ["m", "f0", "ks"], value => value !== null), rounded);

// Returns the fields of the shading that differ from their defaults, keyed by their names in TOML.
const shadingFields = term => ({
  ...term.constant !== null && {m: rounded(term.constant)},
  ...fieldsOf(term, ["model", "lobe", ...modelOf(term).factors ? ["fresnel", "masking"] : []],
    (value, name) => value !== registry.defaults[name]),
});

// Returns the arguments of an image that a scene file does not contain.
const imageWords = which => [
  ...state.exposure ? [`--exposure ${short(state.exposure)}`] : [],
  ...state.only === "all" ? [] : [`--only ${state.only}`],
  `--size ${size.join("x")}`, `-o ${which}.png`,
];

// Returns the position of a point light in the mesh file's space.
const pointOf = light => scaledBy(directionTo(light), light.distance * facts.radius)
  .map((x, i) => rounded(x + facts.center[i]));

// Returns the command-line arguments of the mesh, without the roughness map if the term sets m.
function meshWords(term) {
  const {roughness_map: roughness, ...others} = facts.mesh.maps;
  return [facts.mesh.shell, ...Object.values(others), term.m === null && roughness].filter(Boolean);
}

// The page draws no shadows, so its command and its scene file turn them off.
function commandLine(which) {
  const term = state[which];
  const {azimuth, elevation, zoom, fov} = state.camera;
  const options = table => Object.entries(table).map(([name, value]) => `--${name} ${value}`);
  // Some values have no option: the command needs the scene file.
  const needsFile = isPower(term) || term.constant !== null || !state.lights.length
    || facts.mesh.pose !== "" || facts.mesh.material.length > 0;
  return [
    "facerender render", ...meshWords(term),
    ...needsFile ? [`--scene ${which}.toml`] : options(shadingFields(term)),
    ...options(materialFields(term)),
    ...state.lights.map(light => {
      const place = light.distance === null
        ? `${short(light.azimuth)},${short(light.elevation)}` : `point:${pointOf(light)}`;
      const radius = light.radius ? `,radius=${short(light.radius)}` : "";
      return `--light ${place},${light.irradiance.map(short)}${radius},no-shadow`;
    }),
    `--ambient ${state.ambient.map(short)}`, `--background ${facts.background.map(short)}`,
    `--camera ${[azimuth, elevation, zoom].map(short)}`, `--fov ${short(fov)}`,
    ...options(facts.aim), ...imageWords(which),
  ].join(" \\\n    ");
}

function sceneFile(which) {
  const term = state[which];
  const toml = value => Array.isArray(value) ? `[${value.join(", ")}]` : JSON.stringify(value);
  const lines = table => Object.entries(table).map(([name, value]) => `${name} = ${toml(value)}`);
  const section = (name, words) => words.length ? ["", `[${name}]`, ...words] : [];
  const lights = state.lights.map(light => `    { ${lines({
    ...light.distance === null ? {azimuth: rounded(light.azimuth), elevation: rounded(light.elevation)}
      : {position: pointOf(light)},
    irradiance: light.irradiance.map(rounded), ...light.radius && {radius: rounded(light.radius)},
    shadow: false,
  }).join(", ")} },\n`);
  const power = `{ g = ${term.g}, factor = ${literal(term.factor)}, offset = ${literal(term.offset)} }`;
  return [
    `# ${["facerender render", ...meshWords(term), `--scene ${which}.toml`, ...imageWords(which)].join(" ")}`,
    ...lines({ambient: state.ambient.map(rounded), background: facts.background.map(rounded)}),
    lights.length ? `lights = [\n${lights.join("")}]` : "lights = []",
    ...section("camera", lines({...mapped(state.camera, rounded), ...facts.aim})),
    ...section("material", [...facts.mesh.material, ...lines(materialFields(term))]),
    ...section("shading", lines(shadingFields(term))).map(line => line.replace('"g-power"', power)),
    ...facts.mesh.pose ? ["", facts.mesh.pose.trimEnd()] : [],
  ].join("\n") + "\n";
}
