// Cameras and lights in the renderer's space, as in scenes/view.py and scenes/light.py.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaledBy = (a, factor) => a.map(x => x * factor);
const unit = a => scaledBy(a, 1 / Math.hypot(...a));

function directionTo({azimuth, elevation}) {
  const [a, e] = [radians(azimuth), radians(elevation)];
  return [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
}

function framingDistance(elevation, fov, aspect) {
  const [sine, cosine] = [Math.sin(radians(elevation)), Math.cos(radians(elevation))];
  const vertical = Math.tan(radians(fov) / 2);
  return facts.framing_margin * Math.max(...facts.profile.flatMap(([r, y]) => [
    y * (sine + cosine / vertical) + r * Math.abs(cosine - sine / vertical),
    y * (sine - cosine / vertical) + r * Math.abs(cosine + sine / vertical),
    y * sine + r * Math.hypot(1 / (vertical * aspect), cosine)]));
}

const fromTarget = offset => offset.map((x, i) => x + facts.target[i]);

// Returns the camera's position, its distance from the target, and the row-major view-projection
// matrix for row vectors.
function viewOf({azimuth, elevation, zoom, fov}, aspect) {
  const back = directionTo({azimuth, elevation});
  const distance = framingDistance(elevation, fov, aspect) / zoom;
  const position = fromTarget(scaledBy(back, distance));
  const up = Math.abs(back[1]) > 0.9999
    ? scaledBy(directionTo({azimuth, elevation: 0}), -Math.sign(back[1])) : [0, 1, 0];
  const side = unit(cross(up, back));
  const axes = [side, cross(back, side), back];
  const depth = dot(position, back);
  const far = Math.max(depth + 1, 0.02);
  const near = Math.max(depth - 1, far * 1e-3);
  const scale = 1 / Math.tan(radians(fov) / 2);
  const [slope, offset] = [-(far + near) / (far - near), -2 * far * near / (far - near)];
  const column = (axis, factor, more = 0) =>
    [...scaledBy(axis, factor), -dot(position, axis) * factor + more];
  const columns = [  // Y points down.
    column(axes[0], scale / aspect), column(axes[1], -scale), column(axes[2], slope, offset),
    column(axes[2], -1)];
  return {position, distance, matrix: [0, 1, 2, 3].flatMap(row => columns.map(column => column[row]))};
}

// Returns the position of a point in the image, as fractions of the image's width and height from
// the top left. z < 0 if the point is nearer to the camera than the target.
function projected({distance, matrix}, point) {
  const [x, y, , w] = [0, 1, 2, 3].map(column =>
    [...point, 1].reduce((sum, each, row) => sum + each * matrix[4 * row + column], 0));
  return {x: 0.5 + 0.5 * x / w, y: 0.5 + 0.5 * y / w, z: w - distance};
}

function lightKind({radius, distance}) {
  if (distance !== null) return radius ? "sphere" : "point";
  return radius ? "disc" : "directional";
}

// Returns the uniform arrays for lights of one kind.
function lightArrays(kind, lights) {
  const name = kind === "disc" || kind === "sphere" ? kind : "light";
  const sine = light => Math.sin(radians(light.radius));
  const each = (vector, power) =>
    lights.flatMap(light => scaledBy(vector(light), (light.distance ?? 1) ** power));
  return lights[0].distance === null ? {
    [`${name}_direction`]: each(directionTo, 0),
    [`${name}_irradiance`]: each(light => light.irradiance, 0),
    ...kind === "disc"
      && {disc_size: lights.map(sine).flatMap(s => [s, 0.5 + 0.5 * Math.sqrt(1 - s * s)])},
  } : {
    [`${name}_position`]: each(directionTo, 1),
    [`${name}_intensity`]: each(light => light.irradiance, 2),
    ...kind === "sphere" && {sphere_size: lights.map(light => light.distance * sine(light))},
  };
}
