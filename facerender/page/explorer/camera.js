// Cameras and lights in the renderer's space: what scenes/view.py and scenes/light.py compute.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaledBy = (a, factor) => a.map(x => x * factor);
const unit = a => scaledBy(a, 1 / Math.hypot(...a));

function directionTo(azimuth, elevation) {
  const [a, e] = [radians(azimuth), radians(elevation)];
  return [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
}

function framingDistance(elevation, fov, aspect) {
  const [sine, cosine] = [Math.sin(radians(elevation)), Math.cos(radians(elevation))];
  const vertical = Math.tan(radians(fov) / 2);
  const horizontal = vertical * aspect;
  let distance = 0;
  for (const [r, y] of facts.profile) {
    distance = Math.max(distance,
      y * (sine + cosine / vertical) + r * Math.abs(cosine - sine / vertical),
      y * (sine - cosine / vertical) + r * Math.abs(cosine + sine / vertical),
      y * sine + r * Math.hypot(1 / horizontal, cosine));
  }
  return 1.04 * distance;
}

// The eye, and view times projection for row vectors, row by row.
function viewOf({azimuth, elevation, zoom, fov}, aspect) {
  const back = directionTo(azimuth, elevation);
  const eye = scaledBy(back, framingDistance(elevation, fov, aspect) / zoom);
  const up = Math.abs(back[1]) > 0.9999
    ? scaledBy(directionTo(azimuth, 0), -Math.sign(back[1])) : [0, 1, 0];
  const side = unit(cross(up, back));
  const axes = [side, cross(back, side), back];
  const depth = Math.hypot(...eye);
  const far = Math.max(depth + 1, 0.02);
  const near = Math.max(depth - 1, far * 1e-3);
  const scale = 1 / Math.tan(radians(fov) / 2);
  const columns = [  // of view times projection, y downwards
    [...scaledBy(axes[0], scale / aspect), -dot(eye, axes[0]) * scale / aspect],
    [...scaledBy(axes[1], -scale), dot(eye, axes[1]) * scale],
  ];
  const [slope, offset] = [-(far + near) / (far - near), -2 * far * near / (far - near)];
  columns.push([...scaledBy(axes[2], slope), -dot(eye, axes[2]) * slope + offset]);
  columns.push([...scaledBy(axes[2], -1), dot(eye, axes[2])]);
  return {eye, matrix: [0, 1, 2, 3].flatMap(row => columns.map(column => column[row]))};
}

// Where a point lies in a picture, as shares of its width and height from the top left; z < 0 where
// it is nearer to the eye than the mesh's centre.
function projected(view, [x, y, z]) {
  const [px, py, , w] = [0, 1, 2, 3].map(column =>
    x * view.matrix[column] + y * view.matrix[4 + column] + z * view.matrix[8 + column]
      + view.matrix[12 + column]);
  return {x: 0.5 + 0.5 * px / w, y: 0.5 + 0.5 * py / w, z: w - Math.hypot(...view.eye)};
}

function lightKind({radius, distance}) {
  if (distance !== null) return radius ? "sphere" : "point";
  return radius ? "disc" : "directional";
}

// The uniform arrays of the lights of a kind.
function lightArrays(kind, lights) {
  const directions = lights.map(light => directionTo(light.azimuth, light.elevation));
  const sines = lights.map(light => Math.sin(radians(light.radius)));
  if (kind === "directional" || kind === "disc") {
    const name = kind === "disc" ? "disc" : "light";
    return {
      [`${name}_direction`]: [3, directions.flat()],
      [`${name}_irradiance`]: [3, lights.flatMap(light => light.irradiance)],
      ...kind === "disc"
        && {disc_size: [2, sines.flatMap(s => [s, 0.5 + 0.5 * Math.sqrt(1 - s * s)])]},
    };
  }
  const name = kind === "sphere" ? "sphere" : "light";
  return {
    [`${name}_position`]: [3, lights.flatMap((light, i) => scaledBy(directions[i], light.distance))],
    [`${name}_intensity`]:
      [3, lights.flatMap(light => scaledBy(light.irradiance, light.distance ** 2))],
    ...kind === "sphere" && {sphere_size: [1, lights.map((light, i) => light.distance * sines[i])]},
  };
}
