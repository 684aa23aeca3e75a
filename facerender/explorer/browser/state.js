// The state of the page. The URL fragment stores the differences from the initial state as text.
const SHOWS = {wipe: "A | B", a: "A", b: "B", difference: "|A − B|"};
const ONLY = {all: "all terms", specular: "specular"};
const SWATCH = {a: "A", b: "B"};
const MOST_GAIN = 4096;
const {ranges} = facts;

const [firstModel] = Object.keys(registry.models);
const [firstFresnel] = registry.fresnel;
const [firstMasking] = registry.masking;

// m, f0, ks: null selects the value of the mesh file. constant: m of a plan for all parts, or null.
const termWith = own =>
  ({g: 8, factor: 0.25, offset: 0.5, m: null, f0: null, ks: null, constant: null, ...own});

const isWithin = (value, [low, high]) => value >= low && value <= high;
const within = range => text => {
  const value = Number(text);
  return text.trim() !== "" && isWithin(value, range) ? value : undefined;
};
const allWithin = table => Object.fromEntries(
  Object.entries(table).map(([name, range]) => [name, within(range)]));
const oneOf = names => text => names.includes(text) ? text : undefined;

// Parsers of the fields; they return undefined for invalid text.
const TERM_FIELDS = {
  model: oneOf(Object.keys(registry.models)),
  lobe: oneOf([...Object.keys(registry.lobes), "g-power"]),
  fresnel: oneOf(registry.fresnel),
  masking: oneOf(registry.masking),
  ...allWithin(ranges.term),
  constant: text => text === "" ? null : within(ranges.term.m)(text),
  g: text => Number.isInteger(Number(text)) ? within(ranges.term.g)(text) : undefined,
};
const CAMERA_FIELDS = allWithin(ranges.camera);
const FIELDS = {
  show: oneOf(Object.keys(SHOWS)),
  only: oneOf(Object.keys(ONLY)),
  cut: within([0, 1]),
  gain: text => text === "" ? null : within([1, MOST_GAIN])(text),
  budget: text => text === "" ? null : within([0, 255])(text),
  exposure: within(ranges.exposure),
};

function firstState() {
  return {
    a: termWith(facts.shadings.a), b: termWith(facts.shadings.b),
    show: "wipe", only: "all", cut: 0.5, gain: null, budget: null, exposure: 0,
    camera: {...facts.camera},
    lights: facts.lights.map(light => ({...light})),
    ambient: [...facts.ambient],
  };
}

const lightWords = ({azimuth, elevation, irradiance, radius, distance}) =>
  [azimuth, elevation, ...irradiance, ...radius || distance !== null ? [radius] : [],
    ...distance !== null ? [distance] : []].map(short).join(",");
const lightsWords = lights => lights.map(lightWords).join(";") || "none";

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

const word = value => typeof value === "number" ? short(value) : value ?? "";

function fragmentOf(state) {
  const first = firstState();
  const changes = (table, own) => Object.keys(table)
    .filter(name => own[name] !== table[name])
    .map(name => `${name}:${word(own[name])}`);
  const words = [];
  for (const which of ["a", "b"]) {
    const own = changes(first[which], state[which])
      .filter(word => state[which].lobe === "g-power" || !/^(g|factor|offset):/.test(word));
    if (own.length) words.push(`${which}=${own.join(";")}`);
  }
  const camera = changes(first.camera, state.camera);
  if (camera.length) words.push(`camera=${camera.join(";")}`);
  const lists = ({lights, ambient}) =>
    ({lights: lightsWords(lights), ambient: ambient.map(short).join(",")});
  for (const [name, text] of Object.entries(lists(state))) {
    if (text !== lists(first)[name]) words.push(`${name}=${text}`);
  }
  for (const name of Object.keys(FIELDS)) {
    if (state[name] !== first[name]) words.push(`${name}=${word(state[name])}`);
  }
  return words.join("&");
}

// Returns the state of a URL fragment, and the invalid parts of the fragment.
function stateOf(fragment) {
  const state = firstState();
  const unknown = [];
  const assign = (into, fields, [name, text = ""], words) => {
    const value = Object.hasOwn(fields, name) ? fields[name](text) : undefined;
    if (value === undefined) unknown.push(words);
    else into[name] = value;
  };
  const lists = {
    lights(text) {
      const lights = text === "none" ? [] : text.split(";").map(lightOf);
      return lights.includes(undefined) || lights.length > facts.most_lights ? undefined : lights;
    },
    ambient(text) {
      const ambient = text.split(",").map(Number);
      return isColour(ambient) ? ambient : undefined;
    },
  };
  for (const pair of decodeURIComponent(fragment.replace(/^#/, "")).split("&").filter(Boolean)) {
    const [name, text = ""] = pair.split("=");
    const table = {a: TERM_FIELDS, b: TERM_FIELDS, camera: CAMERA_FIELDS}[name];
    if (!table) assign(state, {...FIELDS, ...lists}, [name, text], pair);
    else for (const each of text.split(";")) {
      assign(state[name], table, each.split(":"), `${SWATCH[name] ?? name} ${each}`);
    }
  }
  return {state, unknown};
}

// Returns the reason why facerender render refuses m of a term; "" if m is in the domain of the lobe.
function outsideDomain(term) {
  const highest = Math.max(...facts.parts.map(part => termOf(part, term).m ?? part.slopes[1]));
  const {k} = modelOf(term);
  const lobe = lobeOf(term);
  const end = lobe.ends[k];
  const inside = lobe.open.includes(k) ? highest < end : highest <= end * (1 + 1e-6);
  return inside ? "" : `m reaches ${figure(highest)}, but ${lobeName(term)} is valid only up to `
    + `${figure(end)} with this model: facerender render needs --outside exact`;
}
