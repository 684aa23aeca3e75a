// Plots the lobes of A and B over the angle of the half vector, with m of a pixel. The GLSL of the
// library evaluates the lobes.
const ANGLES = 361;  // Number of angles from 0 to 90 degrees.
const COSINES = Float32Array.from({length: ANGLES}, (_, i) => Math.cos(Math.PI / 2 * i / (ANGLES - 1)));
const SCALES = [["linear", "linear"], ["log", "log"], ["polar", "polar"]];
const LOWEST = 1e-4;  // Lower end of the logarithmic scale.
const [PLOT, BELOW] = [{width: 360, height: 190}, {width: 360, height: 90}];

// Returns the values of a term's lobe at all angles.
function lobeValues(drawing, term, m) {
  const {gl} = drawing;
  const target = floatTarget(gl, [ANGLES, 1]);
  const program = drawing.onScreen(
    termSource(term, m).text, `#define K ${modelOf(term).k}\n`, sources.page["lobe.frag"]);
  const cosines = nearestTexture(gl, gl.R32F, ANGLES, 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ANGLES, 1, gl.RED, gl.FLOAT, COSINES);
  setUniforms(gl, program, {m, cosines: 0});
  gl.disable(gl.DEPTH_TEST);
  gl.viewport(0, 0, ANGLES, 1);
  drawing.triangle();
  const values = new Float32Array(4 * ANGLES);
  gl.readPixels(0, 0, ANGLES, 1, gl.RGBA, gl.FLOAT, values);
  release(gl, target);
  gl.deleteTexture(cosines);
  return values.filter((_, i) => i % 4 === 0);
}

// Returns `limit`, the largest error of a term's lobe in % of the peak as the registry states it, and
// a text with this error. The registry states some errors only for multiples of 0.1.
function statedError(term, m) {
  const stated = lobeOf(term).errors?.[modelOf(term).k];
  if (!stated || lobeOf(term).by_angle) return {text: ""};
  if (stated.length === 1) {
    return {limit: stated[0], text: `${lobeName(term)}: stated error ${stated[0]} % for every m`};
  }
  const step = Math.round(10 * m) - 1;
  const known = step >= 0 && step < stated.length && Math.abs(10 * m - step - 1) < 0.005;
  if (!known) return {text: ""};
  const text = `${lobeName(term)}: stated error ${stated[step]} % at m = ${short((step + 1) / 10)}`;
  return {limit: stated[step], text};
}

function svg(tag, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

const pathOf = points => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");

function axes({width, height}, across, up, grid) {
  const text = (x, y, anchor, words) => svg("text", {x, y, "text-anchor": anchor}, words);
  return [
    ...grid.map(([y, words]) => svg("g", {},
      svg("path", {class: "grid", d: `M42 ${y}H${width - 4}`}), text(38, y + 3.5, "end", words))),
    ...across.map(([x, words]) => text(x, height - 2, "middle", words)),
    text(42, 10, "start", up),
  ];
}

// Draws the plot of both lobes and the plot of their difference. a and b each contain m, the values
// of the lobe, and the angles of the lights' half vectors in degrees.
function plotLobes(box, {a, b}, scale) {
  const {width, height} = PLOT;
  const [left, right, top, bottom] = [42, width - 4, 16, height - 14];
  const highest = Math.max(1, ...a.values, ...b.values);
  const curves = svg("svg", {viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": `Lobes of A (m = ${figure(a.m)}) and B (m = ${figure(b.m)}) over the angle`});
  const degrees = i => 90 * i / (ANGLES - 1);
  // The plot ends where both lobes become dark.
  let dark = ANGLES - 1;
  while (dark > 40 && Math.max(a.values[dark], b.values[dark]) < (scale === "log" ? LOWEST : 2e-3)) --dark;
  const x = i => left + (right - left) * i / dark;
  const step = [2, 5, 10, 15, 20].find(each => degrees(dark) / each < 6.5);
  const ticks = Array.from({length: 1 + Math.floor((degrees(dark) - 2) / step)},
    (_, i) => [x(i * step / 90 * (ANGLES - 1)), `${i * step}°`]);
  let point;  // Function from the index of an angle and a value to a position [x, y] in the plot.
  let numbers = [...Array(dark + 1).keys()];
  if (scale === "polar") {
    const radius = height - 18;
    numbers = Array.from({length: 2 * ANGLES - 1}, (_, i) => i - ANGLES + 1);
    point = (i, v) => {
      const angle = radians(degrees(i));
      return [width / 2 + v / highest * radius * Math.sin(angle), height - 6 - v / highest * radius * Math.cos(angle)];
    };
    for (const r of [0.5 * radius, radius]) {
      const d = `M${width / 2 - r} ${height - 6}a1 1 0 0 1 ${2 * r} 0`;
      curves.append(svg("path", {class: "grid", d}));
    }
  } else {
    const y = scale === "log"
      ? v => bottom - (bottom - top) * Math.log(Math.max(v, LOWEST) / LOWEST) / Math.log(highest / LOWEST)
      : v => bottom - (bottom - top) * Math.max(v, 0) / highest;
    point = (i, v) => [x(i), y(v)];
    const grid = (scale === "log" ? [1, 0.1, 0.01, 0.001, 1e-4] : [0, 0.25, 0.5, 0.75, 1])
      .map(v => [y(v), v === 1e-4 ? "1e-4" : String(v)]);
    curves.append(...axes(PLOT, ticks, "E/c^k", grid), ...a.angles.map(angle => angle / 90 * (ANGLES - 1))
      .filter(i => i <= dark).map(i => svg("path", {class: "light", d: `M${x(i)} ${top}V${bottom}`})));
  }
  for (const [which, {values}] of [["a", a], ["b", b]]) {
    const d = pathOf(numbers.map(i => point(i, values[Math.abs(i)])));
    curves.append(svg("path", {class: `curve ${which}`, d}));
  }

  const apart = [...b.values].map((v, i) => 100 * (v - a.values[i]));
  const limits = [statedError(state.a, a.m), statedError(state.b, b.m)];
  const fromExact = [state.a, state.b].some(term => lobeOf(term).by_angle) && a.m === b.m
    && modelOf(state.a).k === modelOf(state.b).k;
  const limit = fromExact ? Math.max(0, ...limits.map(each => each.limit ?? 0)) : 0;
  const most = Math.max(limit, ...apart.map(Math.abs), 1e-3) * 1.1;
  const level = v => BELOW.height / 2 - v / most * (BELOW.height / 2 - 14);
  const below = svg("svg", {viewBox: `0 0 ${BELOW.width} ${BELOW.height}`, role: "img",
    "aria-label": `B minus A: up to ${figure(Math.max(...apart.map(Math.abs)))} % of the peak`});
  below.append(...axes(BELOW, [], "B − A, % of the peak",
    [most / 1.1, 0, -most / 1.1].map(v => [level(v), `${v < 0 ? "−" : ""}${figure(Math.abs(v))}`])));
  for (const sign of limit ? [1, -1] : []) {
    below.append(svg("path", {class: "limit", d: `M${left} ${level(sign * limit)}H${right}`}));
  }
  below.append(svg("path", {class: "curve b", d: pathOf(apart.slice(0, dark + 1).map((v, i) => [x(i), level(v)]))}));
  box.replaceChildren(curves, below, element("p", {className: "note"},
    limits.map(each => each.text).filter(Boolean).join("; ")));
}

// Returns N.V of a probed pixel, and for each light N.L and the angle between the normal and the
// half vector, in degrees.
function geometryAt({position, normal}, camera, lights) {
  const v = unit(camera.map((x, i) => x - position[i]));
  const each = lights.map(light => {
    const direction = directionTo(light);
    const l = light.distance === null ? direction
      : unit(scaledBy(direction, light.distance).map((x, i) => x - position[i]));
    return {
      lit: dot(normal, l) > 0, cosine: dot(normal, l),
      angle: Math.acos(clamp(dot(normal, unit(l.map((x, i) => x + v[i]))), -1, 1)) * 180 / Math.PI,
    };
  });
  return {facing: dot(normal, v), lights: each};
}
