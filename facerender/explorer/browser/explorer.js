// The page: drawing, pointer and keyboard input, and the URL fragment.
const SETTLED = 180;  // Milliseconds without a change before errors, command and URL are updated.

const HANDLE = 32;    // Size of a light's handle with its outline, in CSS pixels.

let state = firstState();
let drawing = null;  // Null before the start and after a failure.
let pixels = null;   // Errors at the pixels of the current image.
let statisticsNow = null;
let awaited = [];    // Promises for the errors of the current image.
let [frame, timer, version] = [0, 0, 0];
const canvas = byId("canvas");
const viewport = byId("image");
const still = () => state;
const isDrawing = () => drawing && !drawing.gl.isContextLost();

function showMessage(text) {
  byId("message").textContent = text;
  byId("message").hidden = !text;
}

// Updates the page; to be called after every change of the state.
function changed() {
  ++version;
  statisticsNow = null;
  showOld(true);
  refresh();
  if (!frame) frame = requestAnimationFrame(paint);
  clearTimeout(timer);
  timer = setTimeout(settle, SETTLED);
}

// Marks the shown errors as errors of an earlier image.
function showOld(old) {
  for (const each of document.querySelectorAll("#readout table, #where, #over, #mark")) {
    each.classList.toggle("old", old);
  }
  byId("against").textContent = old ? "computing …" : "B against A";
}

let fittedGain = 1;   // Gain at which the largest error of the last measured image is white.
const gainNow = () => state.gain ?? fittedGain;

// Aligns the image with device pixels, and returns its size in pixels: one per device pixel, or two
// per CSS pixel on finer screens. The edges are also whole CSS pixels if a multiple of up to four is
// whole in both, because browsers that emulate a screen align boxes with CSS pixels.
function fitImage() {
  const box = byId("viewport").getBoundingClientRect();
  const common = [1, 2, 3, 4].find(count => count * devicePixelRatio % 1 === 0);
  const step = common ?? 1 / devicePixelRatio;
  const first = edge => Math.ceil(edge / step - 1e-3) * step;
  const sides = [[box.left, box.right], [box.top, box.bottom]].map(([low, high]) =>
    [first(low) - low, Math.max(Math.floor(high / step + 1e-3) * step - first(low), step)]);
  const [[left, width], [top, height]] = sides;
  for (const [name, length] of Object.entries({left, top, width, height})) {
    viewport.style[name] = `${length}px`;
  }
  const scale = Math.min(devicePixelRatio, 2);
  return [width, height].map(side => Math.round(side * scale));
}

function paint() {
  frame = 0;
  if (!isDrawing()) return;
  try {
    drawing.resize(...fitImage());
    drawing.draw("a", state);
    drawing.draw("b", state);
    drawing.show(state, gainNow());
  } catch (error) {
    fail(error);
  }
  place();
}

async function settle() {
  history.replaceState(null, "", `#${fragmentOf(state)}`);
  writeCommand();
  if (!isDrawing()) return;
  if (frame) {
    cancelAnimationFrame(frame);
    paint();
  }
  const now = version;
  const found = await drawing.measure(state);
  if (now !== version || !found) return;
  pixels = found;
  statisticsNow = statistics(found, drawing.size[0]);
  const {largest} = statisticsNow.display;
  fittedGain = largest > 0 ? clamp(255 / largest, 1, MOST_GAIN) : 1;
  if (state.gain === null) {
    refresh();
    drawing.show(state, fittedGain);
    place();
  }
  showOld(false);
  readout();
  plotHere();
  awaited.splice(0).forEach(({resolve}) => resolve(statisticsNow));
}

// Places the overlays of the image: handles of lights, split line, names and legend.
function place() {
  const [width, height] = [viewport.clientWidth, viewport.clientHeight];
  const view = viewOf(state.camera, width / height);
  const reach = 0.9 * Math.max(...facts.profile.map(each => Math.hypot(...each)));
  [...byId("handles").children].forEach((handle, i) => {
    const light = state.lights[i];
    const at = projected(view, fromTarget(scaledBy(directionTo(light), reach)));
    const inside = (fraction, side) =>  // the whole handle stays visible
      `${clamp(fraction * side, HANDLE / 2, Math.max(side - HANDLE / 2, HANDLE / 2))}px`;
    handle.style.left = inside(at.x, width);
    handle.style.top = inside(at.y, height);
    handle.classList.toggle("behind", at.z > 0);
  });
  const wipe = state.show === "wipe";
  byId("cut").hidden = !wipe;
  byId("cut").style.left = `${100 * state.cut}%`;
  byId("cut").setAttribute("aria-valuenow", Math.round(100 * state.cut));
  byId("tag-a").hidden = !wipe && state.show !== "a";
  byId("tag-b").hidden = !wipe && state.show !== "b";
  for (const which of ["a", "b"]) {
    byId(`tag-${which}`).replaceChildren(element("b", {}, SWATCH[which]), ` ${lobeName(state[which])}`);
  }
  byId("legend").hidden = state.show !== "difference";
  byId("legend-middle").textContent = figure(255 / gainNow() / 4);
  byId("legend-end").textContent = `${figure(255 / gainNow())} of 255`;
}

function readout() {
  for (const row of document.querySelectorAll("#readout tr[data-measure]")) {
    const {measure} = row.dataset;
    const scale = {display: 1, relative: 100, linear: 255}[measure];
    const found = statisticsNow[measure];
    [found.largest, found.most, found.mean].forEach((value, i) => {
      row.cells[i + 1].textContent = figure(scale * value);
    });
  }
  const {at} = statisticsNow.display;
  const [width, height] = drawing.size;
  const some = at !== null && statisticsNow.display.largest > 0;
  byId("mark").hidden = !some;
  if (some) {
    byId("mark").style.left = `${100 * (at[0] + 0.5) / width}%`;
    byId("mark").style.top = `${100 * (at[1] + 0.5) / height}%`;
  }
  const many = x => x.toLocaleString("en");
  const samples = drawing.samples > 1 ? `${drawing.samples} samples` : "1 sample";
  byId("where").textContent
    = (some ? `Largest error at ${at[0]}, ${at[1]} (ring). ` : "A and B are identical. ")
    + `${many(statisticsNow.covered)} of ${many(width)} × ${many(height)} pixels covered, ${samples}.`;
  byId("over").textContent = state.budget === null ? ""
    : `Over ${short(state.budget)}/255: ${figure(100 * fractionOver(pixels, state.budget))} % of these.`;
}

// Pixel under the pointer, or null. The plotted lobes use m of this pixel. If it is null, they use
// m of the pixel with the largest error.
let pointed = null;
let scale = "linear";
let lobes = null;

function plotHere() {
  const at = pointed ?? statisticsNow?.display.at;
  if (!drawing || !at) return;
  const [found] = drawing.probe(state, [at]);
  if (found.a.part < 0) return;
  const {position} = viewOf(state.camera, drawing.size[0] / drawing.size[1]);
  const here = geometryAt(found.a, position, state.lights);
  const slopeOf = which => state[which].constant ?? found[which].m;
  const angles = here.lights.filter(light => light.lit).map(light => light.angle);
  lobes = Object.fromEntries(["a", "b"].map(which => {
    const m = slopeOf(which);
    return [which, {m, angles, values: lobeValues(drawing, state[which], m)}];
  }));
  plotLobes(byId("lobes"), lobes, scale);
  const slopes = slopeOf("a") === slopeOf("b") ? `m = ${figure(slopeOf("a"))}`
    : `m = ${figure(slopeOf("a"))} in A, ${figure(slopeOf("b"))} in B`;
  const cosines = here.lights.map(light => figure(light.cosine)).join(", ");
  byId("here").textContent = `${pointed ? "Under the pointer" : "At the ring"}: ${slopes}, `
    + `N.V = ${figure(here.facing)}, ${cosines ? `N.L = ${cosines}` : "no lights"}.`;
}

let cost = null;  // The last measurement of costs.
let costOf = "";  // Key of the measured image.
const imageKey = ({a, b, camera, lights, ambient, only}) =>
  JSON.stringify([a, b, camera, lights, ambient, only, drawing?.size]);
const showCostMessage = text => { byId("cost-message").textContent = text; };

async function measureCost() {
  if (!isDrawing()) return;
  const began = version;
  byId("cost").disabled = true;
  byId("save").hidden = true;
  showCostMessage("warming up");
  try {
    costOf = imageKey(state);
    cost = await measuredCost(drawing, state, showCostMessage,
      () => version !== began || !isDrawing());
    if (!cost) showCostMessage("Stopped: the image changed.");
    byId("save").hidden = !cost;
  } finally {
    byId("cost").disabled = false;
  }
  refresh();
  if (began === version) drawing.show(state, gainNow());
}

// Updates the table of costs: a measurement is valid for one image only.
function writeCosts({write}) {
  const same = cost !== null && costOf === imageKey(state);
  write(same ? cost : null);
  if (!cost || byId("cost").disabled) return;
  const passes = cost.passes === 1 ? "1 pass" : `${cost.passes} passes`;
  showCostMessage(same ? `${cost.gpu}: ${passes} of ${cost.size.join(" × ")} pixels per round, timed with `
    + `${cost.method === "fence" ? "a fence" : "the GPU's clock"}.`
    : "The cost was measured for another image; you can still save it.");
}

function saveFile(name, text) {
  const link = element("a", {href: URL.createObjectURL(new Blob([text])), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// Returns the position of an event in the image, as fractions of its width and height.
function placeOf(event) {
  const box = viewport.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

// Selects the pixel under a resting pointer.
function watchPointer() {
  let rest = 0;
  canvas.addEventListener("pointermove", event => {
    clearTimeout(rest);
    if (event.buttons) return;
    rest = setTimeout(() => {
      if (!isDrawing()) return;
      pointed = placeOf(event).map((each, i) =>
        clamp(Math.floor(each * drawing.size[i]), 0, drawing.size[i] - 1));
      plotHere();
    }, 120);
  });
  canvas.addEventListener("pointerleave", () => {
    clearTimeout(rest);
    pointed = null;
    plotHere();
  });
}

let commandSide = "b";
const sizeNow = () => drawing?.size ?? [1024, 1024];

function writeCommand() {
  byId("outside").textContent = ["a", "b"].map(which => [SWATCH[which], outsideDomain(state[which])])
    .filter(([, words]) => words).map(([name, words]) => `${name}: ${words}.`).join(" ");
  byId("command").textContent = commandLine(state, commandSide, sizeNow());
}

// Returns a note of the features that the page omits, or "".
function omissions() {
  const {mesh, scene} = facts.omitted;
  const list = names => names.join(", ");
  if (!mesh.length && !scene.length) return "";
  return `This page omits ${list([...mesh, ...scene])}.`
    + (scene.length ? ` Its command omits ${list(scene)}.` : "");
}

function buildControls() {
  byId("omitted").textContent = omissions();
  const set = name => value => {
    state[name] = value;
    changed();
  };
  choice("show", Object.entries(SHOWS), () => state.show, set("show"));
  choice("only", Object.entries(ONLY), () => state.only, set("only"));
  const {cameras} = facts;
  choice("cameras", Object.keys(cameras).map(name => [name, name]), () => {
    const {azimuth, elevation} = state.camera;
    return elevation === 0 ? Object.keys(cameras).find(name => cameras[name] === azimuth) : undefined;
  }, name => {
    Object.assign(state.camera, {azimuth: cameras[name], elevation: 0});
    changed();
  });
  const fit = button("fit", "Fit the gain to the largest error", () => set("gain")(null));
  refreshers.push(() => fit.setAttribute("aria-pressed", state.gain === null));
  const budget = number("budget in 1/255", [0, 255], () => state.budget, set("budget"), {empty: "none"});
  byId("sliders").append(
    slider("gain", {low: 0, high: Math.log2(MOST_GAIN), step: 0.5}, () => Math.log2(gainNow()),
      value => set("gain")(+short(2 ** value)), () => `× ${figure(gainNow())}`),
    fit,
    slider("exposure", {low: -4, high: 4, step: 0.25}, () => state.exposure, set("exposure"),
      value => `${value > 0 ? "+" : ""}${value}`),
    element("label", {className: "budget"}, element("span", {}, "red above"), budget, "/255"),
  );
  byId("terms").append(termTable(still, changed));
  byId("lights").append(lightTable(still, changed));
  refreshers.push(() => {
    const handles = byId("handles");
    while (handles.children.length > state.lights.length) handles.lastChild.remove();
    while (handles.children.length < state.lights.length) handles.append(handleOf(handles.children.length));
  });
  const costs = costTable();
  byId("costs").append(costs.table);
  refreshers.push(() => writeCosts(costs));
  choice("scale", SCALES, () => scale, value => {
    scale = value;
    if (lobes) plotLobes(byId("lobes"), lobes, scale);
  });
  choice("command-of", Object.entries(SWATCH), () => commandSide, value => {
    commandSide = value;
    writeCommand();
  });
  byId("save-scene").addEventListener("click", () =>
    saveFile(`${commandSide}.toml`, sceneFile(state, commandSide, sizeNow())));
  byId("copy").addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(byId("command").textContent);
      byId("copy").textContent = "copied";
    } catch {  // Some browsers allow no clipboard for a local file: the user copies the selection.
      getSelection().selectAllChildren(byId("command"));
      byId("copy").textContent = "selected";
    }
    setTimeout(() => { byId("copy").textContent = "copy"; }, 1500);
  });
}

// Returns a handle to move a light.
function handleOf(i) {
  const label = `Light ${i + 1}: drag it, or use the arrow keys`;
  const handle = button(String(i + 1), label, () => {});
  handle.className = "handle";
  dragged(handle, (dx, dy) => {
    const behind = handle.classList.contains("behind") ? -1 : 1;
    turn(state.lights[i], 0.45 * behind * dx, -0.45 * dy);
  });
  onKeys(handle, (right, down) => turn(state.lights[i], 5 * right, -5 * down));
  return handle;
}

// Turns a light or the camera by angles in degrees.
function turn(direction, right, up) {
  direction.azimuth = (direction.azimuth + right + 540) % 360 - 180;
  direction.elevation = clamp(direction.elevation + up, -90, 90);
  changed();
}

const STEPS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};

// Calls `move` with the step of a pressed arrow key, or calls the function that `others` contains
// for another key.
function onKeys(target, move, others = {}) {
  target.addEventListener("keydown", event => {
    const action = others[event.key] ?? (STEPS[event.key] && (() => move(...STEPS[event.key])));
    if (event.ctrlKey || event.metaKey || !action) return;
    event.preventDefault();
    action();
  });
}

// Calls `move` with the movement of one pointer. With two pointers, calls `pinch` with the ratio of
// their new distance to their old distance.
function dragged(target, move, pinch) {
  const held = new Map();
  const apart = () => {
    const [a, b] = [...held.values()];
    return b ? Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) : null;
  };
  target.addEventListener("pointerdown", event => {
    if (event.button) return;
    held.set(event.pointerId, {x: event.clientX, y: event.clientY});
    target.setPointerCapture(event.pointerId);
  });
  target.addEventListener("pointermove", event => {
    const last = held.get(event.pointerId);
    if (!last) return;
    const before = apart();
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    Object.assign(last, {x: event.clientX, y: event.clientY});
    if (before === null) move(dx, dy, event);
    else pinch?.(apart() / before);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    target.addEventListener(name, event => held.delete(event.pointerId));
  }
}

function zoom(factor) {
  state.camera.zoom = clamp(state.camera.zoom * factor, 0.2, 50);
  changed();
}

function cutAt(fraction) {
  state.cut = clamp(fraction, 0, 1);
  changed();
}

function listen() {
  dragged(canvas, (dx, dy) => {
    const degrees = 0.4 / Math.sqrt(state.camera.zoom);
    turn(state.camera, -degrees * dx, degrees * dy);
  }, zoom);
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)));
  }, {passive: false});
  onKeys(canvas, (right, down) => turn(state.camera, -5 * right, 5 * down), {
    "+": () => zoom(1.1), "=": () => zoom(1.1), "-": () => zoom(1 / 1.1), "0": () => {
      state.camera = {...facts.camera};
      changed();
    }});
  dragged(byId("cut"), (dx, dy, event) => cutAt(placeOf(event)[0]));
  onKeys(byId("cut"), right => cutAt(state.cut + 0.02 * right), {Home: () => cutAt(0), End: () => cutAt(1)});
  canvas.addEventListener("webglcontextlost", event => {
    event.preventDefault();  // Allows the browser to restore the context.
    showMessage("The graphics driver lost the image. The page draws it again when the driver is back.");
  });
  canvas.addEventListener("webglcontextrestored", () => attempt(() => {
    drawing.start();
    showMessage("");
    changed();
  }));
  watchPointer();
  byId("cost").addEventListener("click", () => attempt(measureCost));
  byId("save").addEventListener("click", () =>
    saveFile("explorer-cost.json", JSON.stringify(cost, null, 2)));
  addEventListener("hashchange", () => restore(location.hash));
  new ResizeObserver(changed).observe(byId("viewport"));
}

function restore(fragment) {
  const {state: found, unknown} = stateOf(fragment);
  state = found;
  byId("notes").textContent = unknown.length
    ? `These parts of the URL are invalid and were ignored: ${unknown.join(", ")}.` : "";
  changed();
}

function fail(error) {
  drawing = null;
  awaited.splice(0).forEach(({reject}) => reject(error));
  showMessage(error instanceof Unable ? error.message : `Internal error: ${error.message}`);
  if (!(error instanceof Unable)) throw error;
}

async function attempt(action) {
  try {
    await action();
  } catch (error) {
    fail(error);
  }
}

// For tests and for the browser's console, for example explorer.probe([[x, y]]).
window.explorer = {
  get state() { return state; },
  get size() { return drawing.size; },
  get samples() { return drawing.samples; },
  // error statistics of the current image, or a promise of these statistics
  errors: () => statisticsNow ?? new Promise((resolve, reject) => awaited.push({resolve, reject})),
  probe: places => drawing.probe(state, places),
  pixels: which => drawing.read(drawing.targets[which]),
  lobe: which => ({m: lobes[which].m, values: [...lobes[which].values]}),
  command: which => commandLine(state, which, drawing.size),
  scene: which => sceneFile(state, which, drawing.size),
};

attempt(async () => {
  const unpacks = Boolean(window.DecompressionStream);
  const held = unpacks && Promise.all(
    [meshParts(), mapImages(), inflated("sources").then(found => found.json())]);
  buildControls();  // Runs while the browser unpacks the data.
  restore(location.hash);
  if (!unpacks) {
    throw new Unable("This browser cannot unpack the mesh (no DecompressionStream): use Chrome 80, "
      + "Firefox 113, Safari 16.4 or later.");
  }
  openContext(document.createElement("canvas"));  // Throws if a WebGL feature is missing.
  const [parts, images, texts] = await held;
  sources = texts;
  drawing = new Drawing(canvas, parts, images);
  listen();
  showMessage("");
  changed();
});
