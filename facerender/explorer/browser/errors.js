// Statistics of the current image's error, over the pixels that the mesh covers.
const WITHIN = 0.999;  // Percentile, as a fraction of the covered pixels.

// Returns for each kind of error the largest error, the 99.9th percentile, the mean, and the pixel of the
// largest error. pixels: (N, 4), as error.glsl returns them.
function statistics(pixels, width) {
  const covered = [];
  for (let i = 3; i < pixels.length; i += 4) if (pixels[i] > 0) covered.push(i - 3);
  const spared = covered.length - Math.ceil(WITHIN * covered.length);
  const measures = ["linear", "display", "relative"].map((name, channel) => {
    const values = Float32Array.from(covered, start => pixels[start + channel]);
    let [sum, place] = [0, 0];
    values.forEach((value, i) => {
      sum += value;
      if (!(value <= values[place])) place = i;
    });
    const worst = covered[place] / 4;
    values.sort();
    const count = values.length;
    return [name, {
      largest: count ? values[count - 1] : 0,
      most: count ? values[count - 1 - spared] : 0,
      mean: count ? sum / count : 0,
      at: count ? [worst % width, Math.floor(worst / width)] : null,
    }];
  });
  return {covered: covered.length, ...Object.fromEntries(measures)};
}

// Returns the fraction of the covered pixels whose error is over a budget in 8-bit levels.
function fractionOver(pixels, budget) {
  let [covered, over] = [0, 0];
  for (let i = 0; i < pixels.length; i += 4) {
    if (!(pixels[i + 3] > 0)) continue;
    covered += 1;
    over += !(pixels[i + 1] <= budget);
  }
  return covered ? over / covered : 0;
}
