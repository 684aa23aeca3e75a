// What the page shows, and its form in the URL's fragment, where only what differs from the first
// picture is said.
const CAMERAS = {front: 0, "three-quarter": -35, profile: 90};  // azimuths, of the command line
const SHOWS = {wipe: "A | B", a: "A", b: "B", difference: "|A − B|"};
const ONLY = {all: "whole", specular: "specular"};
const MOST_LIGHTS = 8;
const SWATCH = {a: "A", b: "B"};

const [firstModel] = Object.keys(registry.models);
const [firstFresnel] = Object.keys(registry.fresnel);
const [firstMasking] = Object.keys(registry.masking);

// m, f0, ks: null for the file's own. The rest is what a plan may decide besides: a slope that
// nothing widens, a weight in place of maps, whether the normal map and the ambient light count, the
// lights without a highlight and those with the frontal term, whether small slopes are exact.
const plainTerm = lobe => ({
  model: firstModel, lobe, g: 8, factor: 0.25, offset: 0.5,
  fresnel: firstFresnel, masking: firstMasking, m: null, f0: null, ks: null,
  constant: null, weight: null, normal: "on", ambient: "on", dark: "", frontal: "", small: "exact",
});

const within = (low, high) => text => {
  const value = Number(text);
  return text.trim() !== "" && value >= low && value <= high ? value : undefined;
};
const whole = (low, high) => text => {
  const value = within(low, high)(text);
  return Number.isInteger(value) ? value : undefined;
};
const orNull = read => text => text === "" ? null : read(text);
const lightsOf = text => /^(\d(,\d)*)?$/.test(text) ? text : undefined;  // by index
const oneOf = names => text => Object.hasOwn(names, text) ? text : undefined;

// How each field of a term is read; undefined where it cannot be.
const TERM_FIELDS = {
  model: oneOf(registry.models),
  lobe: oneOf({...registry.lobes, "g-power": null}),
  g: whole(1, 31),
  factor: within(1e-6, 1e6),
  offset: within(-1e6, 1e6),
  fresnel: oneOf(registry.fresnel),
  masking: oneOf(registry.masking),
  m: within(...registry.slopes),
  f0: within(0, 0.999),
  ks: within(0, registry.largest_weight),
  ...facts.plan && {
    constant: orNull(within(...registry.slopes)),
    weight: orNull(within(0, registry.largest_weight)),
    normal: oneOf({on: 0, off: 0}),
    ambient: oneOf({on: 0, off: 0}),
    dark: lightsOf,
    frontal: lightsOf,
    small: oneOf({exact: 0, plain: 0}),
  },
};

const CAMERA_FIELDS = {
  azimuth: within(-3600, 3600), elevation: within(-90, 90), zoom: within(0.1, 50), fov: within(1, 150),
};

const FIELDS = {
  show: oneOf(SHOWS),
  only: oneOf(ONLY),
  cut: within(0, 1),
  gain: within(1, 64),
  budget: orNull(within(0, 255)),
  exposure: within(-10, 10),
};

function firstState() {
  const lobes = Object.keys(registry.lobes);
  return {
    a: plainTerm(lobes[0]),
    b: facts.plan ? planTerm(plainTerm(lobes[0])) : plainTerm(registry.lobes.d16 ? "d16" : lobes.at(-1)),
    show: "wipe", only: "all", cut: 0.5, gain: 8, budget: facts.plan?.steps ?? null, exposure: 0,
    camera: {...facts.camera},
    lights: facts.lights.map(light => ({...light})),
    ambient: [...facts.ambient],
  };
}

const lightWords = ({azimuth, elevation, irradiance, radius, distance}) =>
  [azimuth, elevation, ...irradiance, ...radius || distance !== null ? [radius] : [],
    ...distance !== null ? [distance] : []].map(short).join(",");

function lightOf(text) {
  const [azimuth, elevation, ...rest] = text.split(",").map(Number);
  const [irradiance, radius = 0, distance = null] = [rest.slice(0, 3), ...rest.slice(3)];
  const good = irradiance.length === 3 && irradiance.every(x => x >= 0 && x < 1e6)
    && Math.abs(azimuth) <= 3600 && Math.abs(elevation) <= 90 && radius >= 0 && radius <= 20
    && (distance === null || distance > 1);
  return good ? {azimuth, elevation, irradiance, radius, distance} : undefined;
}

const word = value => typeof value === "number" ? short(value) : value ?? "";

function fragmentOf(state) {
  const first = firstState();
  const changes = (table, own) => Object.keys(table)
    .filter(name => own[name] !== table[name])
    .map(name => `${name}:${word(own[name])}`);
  const words = [];
  for (const which of ["a", "b"]) {
    const said = changes(first[which], state[which]);
    if (state[which].lobe !== "g-power") {
      said.splice(0, said.length, ...said.filter(word => !/^(g|factor|offset):/.test(word)));
    }
    if (said.length) words.push(`${which}=${said.join(";")}`);
  }
  const camera = changes(first.camera, state.camera);
  if (camera.length) words.push(`camera=${camera.join(";")}`);
  const lights = state.lights.map(lightWords).join(";") || "none";
  if (lights !== (first.lights.map(lightWords).join(";") || "none")) words.push(`lights=${lights}`);
  const ambient = state.ambient.map(short).join(",");
  if (ambient !== first.ambient.map(short).join(",")) words.push(`ambient=${ambient}`);
  for (const name of Object.keys(FIELDS)) {
    if (state[name] !== first[name]) {
      words.push(`${name}=${word(state[name])}`);
    }
  }
  return words.join("&");
}

// The state that a fragment says, and what in it is not understood.
function stateOf(fragment) {
  const state = firstState();
  const unknown = [];
  const table = (into, fields, text, where) => {
    for (const word of text.split(";")) {
      const [name, value = ""] = word.split(":");
      const read = Object.hasOwn(fields, name) ? fields[name](value) : undefined;
      if (read === undefined) unknown.push(`${where} ${word}`);
      else into[name] = read;
    }
  };
  for (const pair of decodeURIComponent(fragment.replace(/^#/, "")).split("&").filter(Boolean)) {
    const [name, value = ""] = pair.split("=");
    if (name === "a" || name === "b") table(state[name], TERM_FIELDS, value, SWATCH[name]);
    else if (name === "camera") table(state.camera, CAMERA_FIELDS, value, name);
    else if (name === "lights") {
      const lights = value === "none" ? [] : value.split(";").map(lightOf);
      if (lights.includes(undefined) || lights.length > MOST_LIGHTS) unknown.push(pair);
      else state.lights = lights;
    } else if (name === "ambient") {
      const ambient = value.split(",").map(Number);
      if (ambient.length === 3 && ambient.every(x => x >= 0 && x < 1e6)) state.ambient = ambient;
      else unknown.push(pair);
    } else {
      const read = Object.hasOwn(FIELDS, name) ? FIELDS[name](value) : undefined;
      if (read === undefined) unknown.push(pair);
      else state[name] = read;
    }
  }
  return {state, unknown};
}

// Whether slopes from low to high lie in the domain of a term's lobe, in words; "" where they do.
function outside(term) {
  const own = ownSlope(term);
  const ranges = own === null ? facts.parts.map(part => part.slopes) : [[own, own]];
  const {k} = modelOf(term);
  const lobe = lobeOf(term);
  const end = lobe.ends[k];
  const highest = Math.max(...ranges.map(([, high]) => high));
  const inside = lobe.open.includes(k) ? highest < end : highest <= end * (1 + 1e-6);
  return inside ? "" : `m reaches ${figure(highest)}, outside the domain of ${lobeName(term)} here, which `
    + `ends at ${figure(end)}: facerender render refuses it without --outside exact`;
}
