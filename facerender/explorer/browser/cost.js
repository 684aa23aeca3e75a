// Measures the cost of A and B on this GPU: the milliseconds that each further shading pass takes.
const ROUNDS = 7;
const LONG = 40;  // Minimum time of all passes of one image in a round, in ms.
const MOST_PASSES = 512;
const TIMED = {base: "without highlights", a: "A", b: "B"};
const COSTS = {...TIMED, difference: "B − A"};

function gpuName(gl) {
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}

// Returns the median, both quartiles, and the values of all rounds.
function quartiles(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const at = fraction => {
    const place = fraction * (sorted.length - 1);
    const low = Math.floor(place);
    return sorted[low] + (place - low) * ((sorted[low + 1] ?? sorted[low]) - sorted[low]);
  };
  return {median: at(0.5), low: at(0.25), high: at(0.75), rounds: [...values]};
}

// Returns the milliseconds that `work` takes on the GPU, or null if the GPU's clock was disturbed.
// Without a clock, the function reads a pixel after the work, to wait for all drawing.
async function timed(drawing, clock, work) {
  const {gl} = drawing;
  if (!clock) {
    const pixel = new Float32Array(4);
    const read = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, pixel);
    gl.bindFramebuffer(gl.FRAMEBUFFER, drawing.targets.error.buffer);
    read();
    const start = performance.now();
    work();
    drawing.resolve(drawing.targets.error);
    read();
    return performance.now() - start;
  }
  const query = gl.createQuery();
  gl.getParameter(clock.GPU_DISJOINT_EXT);  // Resets the flag.
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

// Measures the images (A, B, and A without highlights) in turns.
//   report   function that is called with the progress as text
//   stop     function that returns true to cancel the measurement: the result is null
async function measuredCost(
  drawing, state, report, stop, clock = drawing.gl.getExtension("EXT_disjoint_timer_query_webgl2"),
) {
  const {gl} = drawing;
  let disturbed = 0;
  const passes = which => count => timed(drawing, clock, () => drawing.repeat(state, which, count));
  let count = 1;
  await passes("a")(1);  // Compiles the programs, and wakes the GPU.
  await passes("b")(1);
  while (count < MOST_PASSES) {
    const time = await passes("base")(count);
    if (stop()) return null;
    if (time >= LONG) break;
    count *= 2;
  }
  const slopes = {base: [], a: [], b: []};
  for (let round = 0; round < ROUNDS;) {
    report(`round ${round + 1} of ${ROUNDS}`);
    const found = {};
    for (const which of Object.keys(TIMED)) {
      await new Promise(resolve => setTimeout(resolve));
      if (stop()) return null;
      const [less, more] = [await passes(which)(0), await passes(which)(count)];
      found[which] = less === null || more === null ? null : (more - less) / count;
    }
    if (Object.values(found).includes(null)) {
      if (++disturbed < ROUNDS) continue;
      return measuredCost(drawing, state, report, stop, null);  // The clock is disturbed too often.
    }
    for (const which of Object.keys(TIMED)) slopes[which].push(found[which]);
    ++round;
  }
  slopes.difference = slopes.b.map((time, i) => time - slopes.a[i]);
  return {
    kind: "facerender explorer cost", version: facts.version, gpu: gpuName(gl),
    browser: navigator.userAgent, method: clock ? "GPU timer" : "fence", unit: "ms per image",
    mesh: facts.name, size: drawing.size, samples: drawing.samples, passes: count,
    link: fragmentOf(state), shadings: {a: shadingWords(state.a), b: shadingWords(state.b)},
    ...Object.fromEntries(Object.entries(slopes).map(([name, times]) => [name, quartiles(times)])),
  };
}

function shadingWords(term) {
  const factors = modelOf(term).factors ? [term.fresnel, term.masking] : [];
  const own = Object.entries(materialFields(term)).map(([name, value]) => `${name} ${value}`);
  return [term.model, lobeName(term), ...factors, ...own].join(", ");
}

// Returns the table of costs, and a function that writes a measurement into it (null clears it).
function costTable() {
  const cells = Object.keys(COSTS).map(() => element("td"));
  const head = Object.values(COSTS).map(text => element("th", {scope: "col"}, text));
  const table = element("table", {className: "costs"},
    element("caption", {}, "ms per image: median and quartiles of the rounds"),
    element("thead", {}, element("tr", {}, ...head)),
    element("tbody", {}, element("tr", {}, ...cells)));
  return {table, write: found => Object.keys(COSTS).forEach((key, i) =>
    cells[i].replaceChildren(...found ? costCell(key, found[key]) : ["–"]))};
}

function costCell(key, {median, low, high}) {
  const unsure = key === "difference" && low <= 0 && high >= 0;
  return [
    unsure ? element("small", {}, "within noise") : signedFigure(median, key === "difference"),
    element("small", {}, `${signedFigure(low, false)} …`), element("small", {}, signedFigure(high, false)),
  ];
}

const signedFigure = (x, plus) => `${x < 0 ? "−" : plus ? "+" : ""}${figure(Math.abs(x))}`;
