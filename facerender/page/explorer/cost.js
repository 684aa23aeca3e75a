// What A and B cost here: milliseconds by which one more shading of the picture makes drawing longer;
// and the table that has it beside the prices of other GPUs.
const ROUNDS = 7;
const LONG = 40;  // milliseconds that the passes of a round take at least
const MOST_PASSES = 512;
const PRICED = {base: "without highlights", a: "A", b: "B"};
const COSTS = {...PRICED, difference: "B − A"};

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
    link: fragmentOf(state), shadings: {a: shadingWords(state.a), b: shadingWords(state.b)},
    ...Object.fromEntries(Object.keys(PRICED).map(which => [which, quartiles(slopes[which])])),
    difference: quartiles(apart),
  };
}

function shadingWords(term) {
  const factors = modelOf(term).factors ? [term.fresnel, term.masking] : [];
  const own = changedFields(term, ["m", "f0", "ks"]).map(name => `${name} ${short(term[name])}`);
  return [term.model, lobeName(term), ...factors, ...own].join(", ");
}

// A row for this GPU and one for each that there are prices of; a heading stands above each.
function costTable() {
  const row = (name, told) => {
    const cells = Object.keys(COSTS).map(() => element("td"));
    const heading = element("th", {scope: "rowgroup", colSpan: cells.length},
      element("b", {}, name), ` ${told}`);
    const body = element("tbody", {}, element("tr", {}, heading), element("tr", {}, ...cells));
    return {body, write: contents => cells.forEach((cell, i) => cell.replaceChildren(...contents[i]))};
  };
  const here = row("here", "ms a picture; median, and the middle half of the rounds");
  here.body.className = "here";
  const elsewhere = facts.prices.map(({name, unit, source}) => row(name, `${unit}; ${source}`));
  const head = Object.values(COSTS).map(text => element("th", {scope: "col"}, text));
  const table = element("table", {className: "costs"},
    element("caption", {}, "Here a picture of this size; elsewhere a fragment of it, all its terms, by the "
      + "prices that facerender plan has"),
    element("thead", {}, element("tr", {}, ...head)),
    here.body, ...elsewhere.map(({body}) => body));
  return {
    table,
    // found: what was measured of the picture on screen, or null
    write(state, found) {
      here.write(Object.keys(COSTS).map(key => found ? costCell(key, found[key]) : ["–"]));
      elsewhere.forEach(({write}, i) => {
        const each = prices && fragmentPrices(prices[i], state);
        write(Object.keys(COSTS).map(key => [each ? priceWords(key, each[key]) : "–"]));
      });
    },
  };
}

const priceWords = (key, price) =>
  price === null ? "not priced" : signedFigure(price, key === "difference" && price !== 0);

function costCell(key, {median, low, high}) {
  const unsure = key === "difference" && low <= 0 && high >= 0;
  return [
    unsure ? element("small", {}, "not told apart") : signedFigure(median, key === "difference"),
    element("small", {}, `${signedFigure(low, false)} …`), element("small", {}, signedFigure(high, false)),
  ];
}

function signedFigure(x, plus) {
  return `${x < 0 ? "−" : plus ? "+" : ""}${figure(Math.abs(x))}`;
}
