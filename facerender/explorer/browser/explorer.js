// The page: drawing, errors, pointer and keyboard input, and the URL fragment.
const SETTLED = 180;  // Milliseconds without a change before errors, command and URL are updated.
const HANDLE = 32;    // Size of a light's handle with its outline, in CSS pixels.
const WITHIN = 0.999;  // Percentile of the errors, as a fraction of the covered pixels.

let isReady = false;  // False before the start and after a failure.
let statisticsNow = null;  // Errors of the current image, once they are measured.
let awaited = [];    // Promises for the errors of the current image.
let [frame, timer, version] = [0, 0, 0];
let fittedGain = 1;  // Gain at which the largest error of the last measured image is white.
let pointed = null;  // Pixel under the resting pointer, or null.
let commandSide = "b";
const viewport = byId("image");
const gainNow = () => state.gain ?? fittedGain;
const isDrawing = () => isReady && !gl.isContextLost();

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
  return [width, height].map(side => Math.round(side * Math.min(devicePixelRatio, 2)));
}

function paint() {
  frame = 0;
  if (!isDrawing()) return;
  try {
    resize(fitImage());
    draw("a");
    draw("b");
    show(gainNow());
  } catch (error) {
    fail(error);
  }
  placeOverlays();
}

async function settle() {
  history.replaceState(null, "", `#${fragmentOf()}`);
  writeCommand();
  if (!isDrawing()) return;
  if (frame) {
    cancelAnimationFrame(frame);
    paint();
  }
  const now = version;
  drawErrors(targets.error.buffer, sources.page["error.frag"]);
  const pixels = await read(targets.error);
  if (now !== version || !pixels) return;
  statisticsNow = statistics(pixels);
  const {largest} = statisticsNow.display;
  fittedGain = largest > 0 ? clamp(255 / largest, 1, MOST_GAIN) : 1;
  if (state.gain === null) {
    refresh();
    show(fittedGain);
    placeOverlays();
  }
  showOld(false);
  readout();
  plotHere();
  awaited.splice(0).forEach(({resolve}) => resolve(statisticsNow));
}

// Returns the largest error, the 99.9th percentile, the mean, and the pixel of the largest error for
// each kind of error, and the fraction of the covered pixels whose display error exceeds the budget.
// pixels: (N, 4), as error.glsl returns them.
function statistics(pixels) {
  const covered = [];
  for (let i = 0; i < pixels.length; i += 4) if (pixels[i + 3] > 0) covered.push(i);
  const count = covered.length;
  const measures = mapped({linear: 0, display: 1, relative: 2}, channel => {
    const values = Float32Array.from(covered, start => pixels[start + channel]);
    const sorted = values.slice().sort();  // NaN is the largest value.
    const largest = sorted[count - 1] ?? 0;
    const worst = covered[values.findIndex(value => Object.is(value, largest))] / 4;
    return {
      largest, most: sorted[Math.ceil(WITHIN * count) - 1] ?? 0,
      mean: count ? values.reduce((sum, value) => sum + value, 0) / count : 0,
      at: count ? [worst % size[0], Math.floor(worst / size[0])] : null,
    };
  });
  const over = covered.filter(start => !(pixels[start + 1] <= (state.budget ?? Infinity))).length;
  return {covered: count, over: count ? over / count : 0, ...measures};
}

// Places the overlays of the image: handles of lights, split line, names and legend.
function placeOverlays() {
  const [width, height] = [viewport.clientWidth, viewport.clientHeight];
  const view = viewOf(state.camera, [width, height]);
  const reach = 0.9 * Math.max(...facts.profile.map(each => Math.hypot(...each)));
  [...byId("handles").children].slice(0, state.lights.length).forEach((handle, i) => {
    const at = projected(view, fromTarget(scaledBy(directionTo(state.lights[i]), reach)));
    const inside = (fraction, side) =>  // the whole handle stays visible
      `${clamp(fraction * side, HANDLE / 2, Math.max(side - HANDLE / 2, HANDLE / 2))}px`;
    handle.style.left = inside(at.x, width);
    handle.style.top = inside(at.y, height);
    handle.classList.toggle("behind", at.z > 0);
  });
  const isSplit = state.show === "wipe";
  byId("cut").hidden = !isSplit;
  byId("cut").style.left = `${100 * state.cut}%`;
  byId("cut").setAttribute("aria-valuenow", Math.round(100 * state.cut));
  for (const which of ["a", "b"]) {
    const tag = byId(`tag-${which}`);
    tag.hidden = !isSplit && state.show !== which;
    tag.replaceChildren(element("b", {}, SWATCH[which]), ` ${lobeName(state[which])}`);
  }
  byId("legend").hidden = state.show !== "difference";
  byId("legend-middle").textContent = figure(255 / gainNow() / 4);
  byId("legend-end").textContent = `${figure(255 / gainNow())} of 255`;
}

function readout() {
  for (const [measure, factor] of [["display", 1], ["relative", 100], ["linear", 255]]) {
    const {largest, most, mean} = statisticsNow[measure];
    document.querySelectorAll(`[data-measure=${measure}] td`).forEach((cell, i) => {
      cell.textContent = figure(factor * [largest, most, mean][i]);
    });
  }
  const {covered, over, display: {at, largest}} = statisticsNow;
  const differs = at !== null && largest > 0;
  byId("mark").hidden = !differs;
  if (differs) {
    byId("mark").style.left = `${100 * (at[0] + 0.5) / size[0]}%`;
    byId("mark").style.top = `${100 * (at[1] + 0.5) / size[1]}%`;
  }
  const [many, width, height] = [covered, ...size].map(x => x.toLocaleString("en"));
  byId("where").textContent
    = (differs ? `Largest error at ${at[0]}, ${at[1]} (ring). ` : "A and B are identical. ")
    + `${many} of ${width} × ${height} pixels covered, ${samples > 1 ? `${samples} samples` : "1 sample"}.`;
  byId("over").textContent = state.budget === null ? ""
    : `Over ${short(state.budget)}/255: ${figure(100 * over)} % of these.`;
}

function saveFile(name, text) {
  const link = element("a", {href: URL.createObjectURL(new Blob([text])), download: name});
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// Returns the position of an event in the image, as fractions of its width and height.
function positionOf(event) {
  const box = viewport.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

function writeCommand() {
  byId("outside").textContent = ["a", "b"].map(which => [SWATCH[which], outsideDomain(state[which])])
    .filter(([, reason]) => reason).map(([name, reason]) => `${name}: ${reason}.`).join(" ");
  byId("command").textContent = commandLine(commandSide);
}

function buildControls() {
  const field = name => fieldOf(() => state, name);
  const [, setGain] = field("gain");
  byId("omitted").textContent = facts.note;
  choice("show", Object.entries(SHOWS), ...field("show"));
  choice("only", Object.entries(ONLY), ...field("only"));
  const {cameras} = facts;
  choice("cameras", Object.keys(cameras).map(name => [name, name]), () => {
    const {azimuth, elevation} = state.camera;
    return elevation === 0 ? Object.keys(cameras).find(name => cameras[name] === azimuth) : undefined;
  }, changing(name => Object.assign(state.camera, {azimuth: cameras[name], elevation: 0})));
  const fit = button("fit", "Fit the gain to the largest error", () => setGain(null));
  refreshers.push(() => fit.setAttribute("aria-pressed", state.gain === null), writeCosts);
  byId("sliders").append(
    slider("gain", {low: 0, high: Math.log2(MOST_GAIN), step: 0.5}, () => Math.log2(gainNow()),
      value => setGain(rounded(2 ** value)), () => `× ${figure(gainNow())}`),
    fit,
    slider("exposure", {low: -4, high: 4, step: 0.25}, ...field("exposure"),
      value => `${value > 0 ? "+" : ""}${value}`),
    element("label", {className: "budget"}, element("span", {}, "red above"),
      number("budget in 1/255", [0, 255], ...field("budget"), {empty: "none"}), "/255"),
  );
  buildTerms();
  buildLights();
  choice("scale", ["linear", "log", "polar"].map(name => [name, name]), () => scale, value => {
    scale = value;
    if (lobes) plotLobes();
  });
  choice("command-of", Object.entries(SWATCH), () => commandSide, value => {
    commandSide = value;
    writeCommand();
  });
  byId("save-scene").onclick = () => saveFile(`${commandSide}.toml`, sceneFile(commandSide));
  byId("copy").onclick = async () => {
    try {
      await navigator.clipboard.writeText(byId("command").textContent);
      byId("copy").textContent = "copied";
    } catch {  // Some browsers allow no clipboard for a local file: the user copies the selection.
      getSelection().selectAllChildren(byId("command"));
      byId("copy").textContent = "selected";
    }
    setTimeout(() => { byId("copy").textContent = "copy"; }, 1500);
  };
}

// Turns a light or the camera by angles in degrees.
const turn = changing((direction, right, up) => {
  direction.azimuth = (direction.azimuth + right + 540) % 360 - 180;
  direction.elevation = clamp(direction.elevation + up, -90, 90);
});

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

const zoom = changing(factor => { state.camera.zoom = clamp(state.camera.zoom * factor, 0.2, 50); });
const cutAt = changing(fraction => { state.cut = clamp(fraction, 0, 1); });

function listen() {
  dragged(canvas, (dx, dy) => {
    const angle = 0.4 / Math.sqrt(state.camera.zoom);
    turn(state.camera, -angle * dx, angle * dy);
  }, zoom);
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY * (event.deltaMode ? 30 : 1)));
  }, {passive: false});
  onKeys(canvas, (right, down) => turn(state.camera, -5 * right, 5 * down), {
    "+": () => zoom(1.1), "=": () => zoom(1.1), "-": () => zoom(1 / 1.1),
    "0": changing(() => { state.camera = firstState().camera; })});
  dragged(byId("cut"), (dx, dy, event) => cutAt(positionOf(event)[0]));
  onKeys(byId("cut"), right => cutAt(state.cut + 0.02 * right), {Home: () => cutAt(0), End: () => cutAt(1)});
  canvas.addEventListener("webglcontextlost", event => {
    event.preventDefault();  // Allows the browser to restore the context.
    showMessage("The graphics driver lost the image. The page draws it again when the driver is back.");
  });
  canvas.addEventListener("webglcontextrestored", () => attempt(() => {
    startDrawing();
    showMessage("");
    changed();
  }));
  let rest = 0;  // Timer that selects the pixel under a resting pointer.
  canvas.addEventListener("pointermove", event => {
    clearTimeout(rest);
    if (event.buttons) return;
    rest = setTimeout(() => {
      pointed = positionOf(event).map((each, i) => clamp(Math.floor(each * size[i]), 0, size[i] - 1));
      plotHere();
    }, 120);
  });
  canvas.addEventListener("pointerleave", () => {
    clearTimeout(rest);
    pointed = null;
    plotHere();
  });
  byId("cost").onclick = () => attempt(measureCost);
  byId("save").onclick = () => saveFile("explorer-cost.json", JSON.stringify(cost, null, 2));
  addEventListener("hashchange", () => restore(location.hash));
  new ResizeObserver(changed).observe(byId("viewport"));
}

function restore(fragment) {
  const found = stateOf(fragment);
  state = found.state;
  byId("notes").textContent = found.unknown.length
    ? `These parts of the URL are invalid and were ignored: ${found.unknown.join(", ")}.` : "";
  changed();
}

function fail(error) {
  isReady = false;
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
  get size() { return size; },
  // error statistics of the current image, or a promise of these statistics
  errors: () => statisticsNow ?? new Promise((resolve, reject) => awaited.push({resolve, reject})),
  pixels: which => read(targets[which]),
  lobe: which => ({m: lobes[which].m, values: [...lobes[which].values]}),
  probe, command: commandLine, scene: sceneFile,
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
  [parts, images, sources] = await held;
  startDrawing();
  isReady = true;
  listen();
  showMessage("");
  changed();
});
