// The controls of the page, which read and write the state, the plots of the lobes, and the measurement
// of the cost.
const byId = id => document.getElementById(id);
const refreshers = [];  // functions that update the controls from the state
const refresh = () => refreshers.forEach(each => each());

function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

// Returns a function that changes the state, and updates the page.
const changing = change => (...values) => {
  change(...values);
  changed();
};

// Returns the functions that read and write a field. owner returns the object that has the field, or
// undefined for a light that does not exist.
const fieldOf = (owner, name) =>
  [() => owner()?.[name] ?? null, changing(value => { owner()[name] = value; })];

// Adds radio buttons side by side, from pairs of value and text.
function choice(id, pairs, read, write) {
  const inputs = pairs.map(([value, text]) => {
    const input = element("input", {type: "radio", name: id, value, onchange: () => write(value)});
    byId(id).append(element("label", {}, input, element("span", {}, text)));
    return input;
  });
  refreshers.push(() => inputs.forEach(input => { input.checked = input.value === read(); }));
}

function selection(label, names, read, write) {
  const options = names.map(([value, text]) => element("option", {value}, text));
  const made = element("select", {"aria-label": label, onchange: () => write(made.value)}, ...options);
  refreshers.push(() => { made.value = read(); });
  return made;
}

// Shows a text below an input, or hides the text if it is empty.
function showRange(input, text) {
  const box = input.getBoundingClientRect();
  const made = byId("range");
  made.hidden = !text;
  made.textContent = text;
  const [left, below] = [innerWidth - made.offsetWidth, innerHeight - made.offsetHeight];
  made.style.left = `${clamp(box.left, 0, Math.max(left - 8, 0))}px`;
  made.style.top = `${box.bottom + 4 > below ? box.top - made.offsetHeight - 4 : box.bottom + 4}px`;
}

// Returns an input for a number in a range. With `empty`, an empty input means null, and the
// placeholder shows `empty`.
function number(label, [min, max], read, write, {step = "any", empty = null} = {}) {
  const made = element("input", {
    type: "number", "aria-label": label, min, max, step, inputMode: "decimal", placeholder: empty ?? "",
  });
  made.addEventListener("input", () => {
    const none = made.value === "" && empty !== null && !made.validity.badInput;
    const wrong = !none && (made.value === "" || !made.validity.valid);
    if (!wrong) write(none ? null : +made.value);
    made.classList.toggle("wrong", wrong);
    showRange(made, wrong ? `${label}: give ${step === 1 ? "a whole number" : "a number"} from `
      + `${short(min)} to ${short(max)}${empty === null ? "" : `, or nothing for ${empty}`}` : "");
  });
  made.addEventListener("blur", () => {
    refresh();
    showRange(made, "");
  });
  refreshers.push(() => {
    if (made === document.activeElement && made.value !== "") return;
    const value = read();
    made.value = value === null ? "" : narrow(value);
    made.classList.remove("wrong");
  });
  return made;
}

function slider(label, {low, high, step}, read, write, text) {
  const input = element("input", {
    type: "range", min: low, max: high, step, "aria-label": label, oninput: () => write(+input.value),
  });
  const output = element("output");
  refreshers.push(() => {
    input.value = read();
    output.textContent = text(read());
    input.setAttribute("aria-valuetext", output.textContent);
  });
  return element("label", {className: "slider"}, element("span", {}, label), input, output);
}

const button = (text, label, onclick = null) =>
  element("button", {type: "button", title: label, "aria-label": label, onclick}, text);

// Returns the mesh file's value of a uniform if all parts have the same value, else "per part".
function fileValue(name) {
  const values = new Set(facts.parts.map(part => short(part.uniforms[name])));
  return values.size === 1 ? [...values][0] : "per part";
}

// Adds a row to the table of shadings. The row is marked if A and B differ.
//   cell   function that returns a control from its label, and its functions that read and write
//   shown  function that returns whether a term needs the row
//   used   function that returns whether a term uses the value
function termRow(label, name, cell, {shown = () => true, used = () => true} = {}) {
  const cells = ["a", "b"].map(which => element("td", {},
    cell(`${label} of ${SWATCH[which]}`, ...fieldOf(() => state[which], name))));
  const made = element("tr", {}, element("th", {scope: "row"}, label), ...cells);
  byId("term-rows").append(made);
  refreshers.push(() => {
    made.hidden = !shown(state.a) && !shown(state.b);
    made.classList.toggle("changed", state.a[name] !== state.b[name]);
    [state.a, state.b].forEach((term, i) => {
      cells[i].classList.toggle("unused", !used(term));
      cells[i].querySelectorAll("input, select").forEach(each => { each.disabled = !used(term); });
    });
  });
}

function buildTerms() {
  const selected = (label, name, names, more) =>
    termRow(label, name, (title, ...access) => selection(title, names, ...access), more);
  const typed = (label, name, options, more) => termRow(label, name,
    (title, ...access) => number(title, ranges.term[name], ...access, options), more);
  const same = names => names.map(name => [name, name]);
  const power = {shown: isPower, used: isPower};
  const factors = {used: term => modelOf(term).factors};
  const mapsSlope = facts.parts.some(part => part.features.includes("ROUGHNESS_MAP"));

  selected("model", "model", Object.entries(registry.models).map(([name, {title}]) => [name, title]));
  selected("lobe", "lobe", same(Object.keys(registry.lobes)));
  typed("power g", "g", {step: 1}, power);
  typed("factor", "factor", {}, power);
  typed("offset", "offset", {}, power);
  selected("Fresnel", "fresnel", same(registry.fresnel), factors);
  selected("masking", "masking", same(registry.masking), factors);
  termRow("m", "m", (title, read, write) => {
    const range = element("input", {
      type: "range", min: 0.05, max: 0.7, step: 0.005, "aria-label": `${title}, slider`,
      oninput: () => write(+range.value),
    });
    refreshers.push(() => { range.value = read() ?? 0.3; });
    return element("div", {className: "ranged"},
      number(title, ranges.term.m, read, write, {empty: mapsSlope ? "map" : fileValue("slope")}), range);
  });
  typed("m of plan", "constant", {empty: "none"}, {shown: term => term.constant !== null});
  typed("f0", "f0", {empty: fileValue("f0")});
  typed("ks", "ks", {empty: fileValue("specular_weight")});
  byId("swap").onclick = changing(() => { [state.a, state.b] = [state.b, state.a]; });
  for (const [which, other] of [["a", "b"], ["b", "a"]]) {
    byId(`copy-${which}`).onclick = changing(() => { state[other] = {...state[which]}; });
  }
}

// Returns an input for the brightness of a colour. 0 keeps the hue: the user may be about to type 0.5.
function brightness(label, owner, name) {
  const [read, write] = fieldOf(owner, name);
  return number(label, ranges.light.irradiance, () => Math.max(...read() ?? [0]), value => {
    const highest = Math.max(...read());
    write(read().map(x => Math.max(value, 1e-9) * (highest ? x / highest : 1)));
  });
}

// Adds the row of a light, and the handle that moves the light in the image. Both are hidden while
// there are fewer lights.
function buildLight(i) {
  const light = () => state.lights[i];
  const typed = name =>
    number(`${name} of light ${i + 1}`, ranges.light[name], ...fieldOf(light, name));
  const swatch = element("i", {className: "swatch"});
  const cells = [
    swatch, typed("azimuth"), typed("elevation"),
    brightness(`irradiance of light ${i + 1}`, light, "irradiance"), typed("radius"),
    button("×", `Remove light ${i + 1}`, changing(() => state.lights.splice(i, 1))),
  ];
  const row = element("tr", {}, ...cells.map(cell => element("td", {}, cell)));
  byId("light-rows").append(row);
  const handle = button(String(i + 1), `Light ${i + 1}: drag it, or use the arrow keys`);
  handle.className = "handle";
  byId("handles").append(handle);
  dragged(handle, (dx, dy) => {
    const behind = handle.classList.contains("behind") ? -1 : 1;
    turn(light(), 0.45 * behind * dx, -0.45 * dy);
  });
  onKeys(handle, (right, down) => turn(light(), 5 * right, -5 * down));
  refreshers.push(() => {
    row.hidden = handle.hidden = !light();
    if (row.hidden) return;
    const highest = Math.max(...light().irradiance, 1e-6);
    swatch.style.background =
      `rgb(${light().irradiance.map(x => Math.round(255 * (x / highest) ** 0.45))})`;
  });
}

function buildLights() {
  for (let i = 0; i < facts.most_lights; ++i) buildLight(i);
  const added = {azimuth: 0, elevation: 30, irradiance: [2, 2, 2], radius: 0, distance: null};
  byId("add").onclick = changing(() => state.lights.push(structuredClone(added)));
  refreshers.push(() => { byId("add").disabled = state.lights.length >= facts.most_lights; });
  byId("ambient").append(brightness("irradiance of the ambient light", () => state, "ambient"));
}

const ANGLES = 361;  // Number of angles from 0 to 90 degrees.
const degrees = i => 90 * i / (ANGLES - 1);
const LOWEST = 1e-4;  // Lower end of the logarithmic scale.
const [PLOT, BELOW] = [{width: 360, height: 190}, {width: 360, height: 90}];

// Returns the values of a term's lobe at all angles. The GLSL of the library evaluates the lobe.
function lobeValues(term, m) {
  const target = floatTarget([ANGLES, 1]);
  const cosines = nearestTexture(gl.R32F, [ANGLES, 1]);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ANGLES, 1, gl.RED, gl.FLOAT,
    Float32Array.from({length: ANGLES}, (_, i) => Math.cos(radians(degrees(i)))));
  const fragment = [termSource(term, m).text, `#define K ${modelOf(term).k}\n`, sources.page["lobe.frag"]];
  drawScreen([ANGLES, 1], fragment, {m, cosines: 0});
  const values = new Float32Array(4 * ANGLES);
  gl.readPixels(0, 0, ANGLES, 1, gl.RGBA, gl.FLOAT, values);
  release(target);
  gl.deleteTexture(cosines);
  return values.filter((_, i) => i % 4 === 0);
}

// Returns `limit`, the largest error of a term's lobe in % of the peak as the registry states it, and
// a text with this error. The registry states some errors only for multiples of 0.1.
function statedError(term, m) {
  const {errors, by_angle: isByAngle} = lobeOf(term);
  const stated = !isByAngle && errors?.[modelOf(term).k] || [];
  const step = Math.round(10 * m);
  const [limit, where] = stated.length === 1 ? [stated[0], "for every m"]
    : Math.abs(10 * m - step) < 0.005 ? [stated[step - 1], `at m = ${short(step / 10)}`] : [];
  return limit === undefined ? {text: ""}
    : {limit, text: `${lobeName(term)}: stated error ${limit} % ${where}`};
}

const pathOf = points => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
const pathTag = (kind, d) => `<path class="${kind}" d="${d}"/>`;
const svgTag = ({width, height}, label, ...content) =>
  `<svg viewBox="0 0 ${width} ${height}" role="img" aria-label="${label}">${content.join("")}</svg>`;

// Returns horizontal lines with labels [y, text], labels [x, text] below, and a title.
function axes({width, height}, title, lines, labels) {
  const textTag = (x, y, anchor, text) =>
    `<text x="${x}" y="${y}" text-anchor="${anchor}">${text.replace("<", "&lt;")}</text>`;
  return [
    ...lines.map(([y, text]) => pathTag("grid", `M42 ${y}H${width - 4}`) + textTag(38, y + 3.5, "end", text)),
    ...labels.map(([x, text]) => textTag(x, height - 2, "middle", text)),
    textTag(42, 10, "start", title),
  ].join("");
}

let lobes = null;  // m and the values of the lobes of A and B, and the lights' angles in degrees
let scale = "linear";

// Draws the plot of both lobes and the plot of their difference.
function plotLobes() {
  const {a, b, angles} = lobes;
  const {width, height} = PLOT;
  const [left, right, top, bottom] = [42, width - 4, 16, height - 14];
  const highest = Math.max(1, ...a.values, ...b.values);
  // The plot ends where both lobes become dark.
  let dark = ANGLES - 1;
  while (dark > 40 && Math.max(a.values[dark], b.values[dark]) < (scale === "log" ? LOWEST : 2e-3)) --dark;
  const x = i => left + (right - left) * i / dark;
  const curves = [];
  let point;  // Function from the index of an angle and a value to a position [x, y] in the plot.
  let numbers = [...Array(dark + 1).keys()];
  if (scale === "polar") {
    const radius = height - 18;
    numbers = Array.from({length: 2 * ANGLES - 1}, (_, i) => i - ANGLES + 1);
    point = (i, v) => {
      const [angle, r] = [radians(degrees(i)), v / highest * radius];
      return [width / 2 + r * Math.sin(angle), height - 6 - r * Math.cos(angle)];
    };
    curves.push(...[0.5 * radius, radius].map(r =>
      pathTag("grid", `M${width / 2 - r} ${height - 6}a1 1 0 0 1 ${2 * r} 0`)));
  } else {
    const part = scale === "log" ? v => Math.log(Math.max(v, LOWEST) / LOWEST) / Math.log(highest / LOWEST)
      : v => Math.max(v, 0) / highest;
    point = (i, v) => [x(i), bottom - (bottom - top) * part(v)];
    const ticks = scale === "log" ? [1, 0.1, 0.01, 0.001, LOWEST] : [0, 0.25, 0.5, 0.75, 1];
    const step = [2, 5, 10, 15, 20].find(each => degrees(dark) / each < 6.5);
    const labels = Array.from({length: 1 + Math.floor((degrees(dark) - 2) / step)},
      (_, i) => [x(i * step / degrees(1)), `${i * step}°`]);
    curves.push(
      axes(PLOT, "E/c^k", ticks.map(v => [point(0, v)[1], v === LOWEST ? "1e-4" : String(v)]), labels),
      ...angles.filter(angle => angle <= degrees(dark))
        .map(angle => pathTag("light", `M${x(angle / degrees(1))} ${top}V${bottom}`)));
  }
  for (const which of ["a", "b"]) {
    const {values} = lobes[which];
    curves.push(pathTag(`curve ${which}`, pathOf(numbers.map(i => point(i, values[Math.abs(i)])))));
  }

  const apart = [...b.values].map((v, i) => 100 * (v - a.values[i]));
  const largest = Math.max(...apart.map(Math.abs));
  const stated = ["a", "b"].map(which => statedError(state[which], lobes[which].m));
  const fromExact = [state.a, state.b].some(term => lobeOf(term).by_angle) && a.m === b.m
    && modelOf(state.a).k === modelOf(state.b).k;
  const limit = fromExact ? Math.max(0, ...stated.map(each => each.limit ?? 0)) : 0;
  const most = Math.max(limit, largest, 1e-3);
  const level = v => BELOW.height / 2 - v / most / 1.1 * (BELOW.height / 2 - 14);
  byId("lobes").innerHTML = svgTag(PLOT,
    `Lobes of A (m = ${figure(a.m)}) and B (m = ${figure(b.m)}) over the angle`, ...curves)
    + svgTag(BELOW, `B minus A: up to ${figure(largest)} % of the peak`,
      axes(BELOW, "B − A, % of the peak",
        [most, 0, -most].map(v => [level(v), `${v < 0 ? "−" : ""}${figure(Math.abs(v))}`]), []),
      ...(limit ? [1, -1] : []).map(sign => pathTag("limit", `M${left} ${level(sign * limit)}H${right}`)),
      pathTag("curve b", pathOf(apart.slice(0, dark + 1).map((v, i) => [x(i), level(v)]))))
    + `<p class="note">${stated.map(each => each.text).filter(Boolean).join("; ")}</p>`;
}

// Plots the lobes for m of the pixel under the resting pointer, or of the pixel with the largest error.
function plotHere() {
  const at = pointed ?? statisticsNow?.display.at;
  if (!isDrawing() || !at) return;
  const [found] = probe([at]);
  const {part, position, normal} = found.a;
  if (part < 0) return;
  const directionFrom = point => unit(point.map((x, i) => x - position[i]));
  const v = directionFrom(viewOf(state.camera, size).position);
  const lights = state.lights.map(light => {
    const l = light.distance === null ? directionTo(light)
      : directionFrom(scaledBy(directionTo(light), light.distance));
    const cosine = dot(normal, unit(l.map((x, i) => x + v[i])));
    return {cosine: dot(normal, l), angle: Math.acos(clamp(cosine, -1, 1)) * 180 / Math.PI};
  });
  lobes = mapped({a: found.a, b: found.b}, ({m}, which) => {
    const slope = state[which].constant ?? m;
    return {m: slope, values: lobeValues(state[which], slope)};
  });
  lobes.angles = lights.filter(light => light.cosine > 0).map(light => light.angle);
  plotLobes();
  const {a, b} = lobes;
  const slopes = a.m === b.m ? `m = ${figure(a.m)}` : `m = ${figure(a.m)} in A, ${figure(b.m)} in B`;
  const cosines = lights.map(light => figure(light.cosine)).join(", ");
  byId("here").textContent = `${pointed ? "Under the pointer" : "At the ring"}: ${slopes}, `
    + `N.V = ${figure(dot(normal, v))}, ${cosines ? `N.L = ${cosines}` : "no lights"}.`;
}

const ROUNDS = 7;
const LONG = 40;  // Minimum time of all passes of one image in a round, in ms.
const MOST_PASSES = 512;
let cost = null;  // The last measurement of costs.
let costOf = "";  // Key of the measured image.

const imageKey = ({a, b, camera, lights, ambient, only} = state) =>
  JSON.stringify([a, b, camera, lights, ambient, only, size]);
const showCostMessage = text => { byId("cost-message").textContent = text; };

// Returns the median, both quartiles, and the values of all seven rounds.
function quartiles(values) {
  const [, b, c, median, e, f] = [...values].sort((x, y) => x - y);
  return {median, low: (b + c) / 2, high: (e + f) / 2, rounds: values};
}

// Returns the milliseconds that 1 + count passes of an image take on the GPU, or null if the GPU's
// clock was disturbed. Without a clock, the function reads a pixel, to wait for all drawing.
async function timed(clock, which, count) {
  if (!clock) {
    const read = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, new Float32Array(4));
    gl.bindFramebuffer(gl.FRAMEBUFFER, targets.error.buffer);
    read();
    const start = performance.now();
    draw(which, targets.error, count);
    read();
    return performance.now() - start;
  }
  const query = gl.createQuery();
  gl.getParameter(clock.GPU_DISJOINT_EXT);  // Resets the flag.
  gl.beginQuery(clock.TIME_ELAPSED_EXT, query);
  draw(which, targets.error, count);
  gl.endQuery(clock.TIME_ELAPSED_EXT);
  await fenced();
  while (!gl.isContextLost() && !gl.getQueryParameter(query, gl.QUERY_RESULT_AVAILABLE)) await pause(2);
  const time = gl.getQueryParameter(query, gl.QUERY_RESULT) / 1e6;
  gl.deleteQuery(query);
  return gl.getParameter(clock.GPU_DISJOINT_EXT) ? null : time;
}

// Measures the images (A, B, and A without highlights) in turns: the milliseconds that each further
// pass takes. The result is null if isStopped returns true.
async function measuredCost(isStopped, clock = gl.getExtension("EXT_disjoint_timer_query_webgl2")) {
  await timed(clock, "a", 1);  // Compiles the programs, and wakes the GPU.
  await timed(clock, "b", 1);
  let count = 1;
  while (count < MOST_PASSES) {
    const time = await timed(clock, "base", count);
    if (isStopped()) return null;
    if (time >= LONG) break;
    count *= 2;
  }
  const slopes = {base: [], a: [], b: []};
  for (let round = 0, disturbed = 0; round < ROUNDS;) {
    showCostMessage(`round ${round + 1} of ${ROUNDS}`);
    const times = {};
    for (const which of Object.keys(slopes)) {
      await pause(0);
      if (isStopped()) return null;
      const [less, more] = [await timed(clock, which, 0), await timed(clock, which, count)];
      times[which] = less === null || more === null ? null : (more - less) / count;
    }
    if (Object.values(times).includes(null)) {
      if (++disturbed < ROUNDS) continue;
      return measuredCost(isStopped, null);  // The clock is disturbed too often.
    }
    for (const which of Object.keys(slopes)) slopes[which].push(times[which]);
    ++round;
  }
  slopes.difference = slopes.b.map((time, i) => time - slopes.a[i]);
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return {
    kind: "facerender explorer cost", version: facts.version,
    gpu: gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER),
    browser: navigator.userAgent, method: clock ? "GPU timer" : "fence", unit: "ms per image",
    mesh: facts.name, size, samples, passes: count, link: fragmentOf(),
    shadings: mapped({a: state.a, b: state.b}, shadingWords), ...mapped(slopes, quartiles),
  };
}

function shadingWords(term) {
  const factors = modelOf(term).factors ? [term.fresnel, term.masking] : [];
  const changes = Object.entries(materialFields(term)).map(([name, value]) => `${name} ${value}`);
  return [term.model, lobeName(term), ...factors, ...changes].join(", ");
}

async function measureCost() {
  if (!isDrawing()) return;
  const began = version;
  byId("cost").disabled = true;
  byId("save").hidden = true;
  showCostMessage("warming up");
  try {
    costOf = imageKey();
    cost = await measuredCost(() => version !== began || !isDrawing());
    if (!cost) showCostMessage("Stopped: the image changed.");
    byId("save").hidden = !cost;
  } finally {
    byId("cost").disabled = false;
  }
  refresh();
  if (began === version) show(gainNow());
}

// Updates the table of costs: a measurement is valid for one image only.
function writeCosts() {
  const same = cost !== null && costOf === imageKey();
  for (const cell of document.querySelectorAll(".costs td")) {
    cell.replaceChildren(...same ? costCell(cell.dataset.cost) : ["–"]);
  }
  if (!cost || byId("cost").disabled) return;
  const passes = cost.passes === 1 ? "1 pass" : `${cost.passes} passes`;
  showCostMessage(same ? `${cost.gpu}: ${passes} of ${cost.size.join(" × ")} pixels per round, timed with `
    + `${cost.method === "fence" ? "a fence" : "the GPU's clock"}.`
    : "The cost was measured for another image; you can still save it.");
}

function costCell(key) {
  const {median, low, high} = cost[key];
  const isDifference = key === "difference";
  const signed = (x, plus = "") => `${x < 0 ? "−" : plus}${figure(Math.abs(x))}`;
  const small = text => element("small", {}, text);
  return [
    isDifference && low <= 0 && high >= 0 ? small("within noise") : signed(median, isDifference ? "+" : ""),
    small(`${signed(low)} …`), small(signed(high)),
  ];
}
