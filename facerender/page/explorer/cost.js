// What A and B cost here: milliseconds by which one more shading of the picture makes drawing longer.
const ROUNDS = 7;
const LONG = 40;  // milliseconds that the passes of a round take at least
const MOST_PASSES = 512;
const PRICED = {base: "without highlights", a: "A", b: "B"};

function gpuName(gl) {
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}

// Median, and the ends of the middle half.
function quartiles(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const at = share => {
    const place = share * (sorted.length - 1);
    const low = Math.floor(place);
    return sorted[low] + (place - low) * ((sorted[low + 1] ?? sorted[low]) - sorted[low]);
  };
  return {median: at(0.5), low: at(0.25), high: at(0.75), rounds: [...values]};
}

// Milliseconds that work takes on the GPU: by its own clock, or else until a pixel can be read, which
// waits for all that was drawn. null where the clock was disturbed.
async function timed(drawing, clock, work) {
  const {gl} = drawing;
  if (!clock) {
    const pixel = new Float32Array(4);
    const read = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, drawing.targets.error.buffer);
    read();
    const start = performance.now();
    work();
    drawing.resolveForReading();
    read();
    return performance.now() - start;
  }
  const query = gl.createQuery();
  gl.getParameter(clock.GPU_DISJOINT_EXT);  // forget what was before
  gl.beginQuery(clock.TIME_ELAPSED_EXT, query);
  work();
  gl.endQuery(clock.TIME_ELAPSED_EXT);
  await fenced(gl);
  while (!gl.isContextLost() && !gl.getQueryParameter(query, gl.QUERY_RESULT_AVAILABLE)) {
    await new Promise(resolve => setTimeout(resolve, 2));
  }
  const time = gl.getQueryParameter(query, gl.QUERY_RESULT) / 1e6;
  gl.deleteQuery(query);
  return gl.getParameter(clock.GPU_DISJOINT_EXT) ? null : time;
}

// Prices the pictures, in turns. tell: progress as text; stop: whether to end without a result, null.
async function priced(
  drawing, state, tell, stop, clock = drawing.gl.getExtension("EXT_disjoint_timer_query_webgl2"),
) {
  const {gl} = drawing;
  let disturbed = 0;
  const passes = which => count => timed(drawing, clock, () => drawing.repeat(state, which, count));
  let count = 1;
  await passes("a")(1);  // compiles, and wakes the GPU
  await passes("b")(1);
  while (count < MOST_PASSES) {
    const time = await passes("base")(count);
    if (stop()) return null;
    if (time >= LONG) break;
    count *= 2;
  }
  const slopes = {base: [], a: [], b: []};
  for (let round = 0; round < ROUNDS;) {
    tell(`round ${round + 1} of ${ROUNDS}`);
    const found = {};
    for (const which of Object.keys(PRICED)) {
      await new Promise(resolve => setTimeout(resolve));
      if (stop()) return null;
      const [less, more] = [await passes(which)(0), await passes(which)(count)];
      found[which] = less === null || more === null ? null : (more - less) / count;
    }
    if (Object.values(found).includes(null)) {
      if (++disturbed < ROUNDS) continue;
      return priced(drawing, state, tell, stop, null);  // a clock that is always disturbed is none
    }
    for (const which of Object.keys(PRICED)) slopes[which].push(found[which]);
    ++round;
  }
  const apart = slopes.b.map((time, i) => time - slopes.a[i]);
  return {
    kind: "facerender explorer cost", version: facts.version, gpu: gpuName(gl),
    browser: navigator.userAgent, method: clock ? "GPU timer" : "fence", unit: "ms a picture",
    mesh: facts.name, size: drawing.size, samples: drawing.samples, passes: count,
    link: fragmentOf(state),
    ...Object.fromEntries(Object.keys(PRICED).map(which => [which, quartiles(slopes[which])])),
    difference: quartiles(apart),
  };
}

function costTable(found) {
  const rows = [...Object.entries(PRICED), ["difference", "B − A"]].map(([key, name]) => {
    const {median, low, high} = found[key];
    const unsure = key === "difference" && low <= 0 && high >= 0;
    const cells = [unsure ? "not told apart" : signedFigure(median, key === "difference"),
      `${signedFigure(low, false)} … ${signedFigure(high, false)}`];
    return element("tr", {}, element("th", {scope: "row"}, name), ...cells.map(text => element("td", {}, text)));
  });
  return element("table", {className: "costs"},
    element("thead", {}, element("tr", {}, ...["ms a picture", "median", "middle half"]
      .map(text => element("th", {scope: "col"}, text)))),
    element("tbody", {}, ...rows));
}

function signedFigure(x, plus) {
  return `${x < 0 ? "−" : plus ? "+" : ""}${figure(Math.abs(x))}`;
}
