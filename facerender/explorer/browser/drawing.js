// Draws images A and B and their error into float targets, and the visible image on the canvas:
// mesh, maps and GLSL of the page's data, cameras and lights as in scene/view.py and scene/light.py,
// and WebGL 2.
const MOST_SAMPLES = 4;
const ATTRIBUTES = ["in_position", "in_normal", "in_uv", "in_occlusion", "in_color"];

class Unable extends Error {}  // a feature is missing in this browser; the page shows the message

const canvas = document.getElementById("canvas");
let gl = null;       // Context of the canvas, which startDrawing sets.
let sources = null;  // GLSL texts, keyed by role; null until the texts are unpacked.
let parts = [];      // Parts of the mesh, with vertex arrays.
let images = [];     // Maps of the mesh.
let textures = [];   // The maps' textures.
let programs = new Map();
let targets = {};    // For images A and B, their error, and samples.
let size = [1024, 1024];  // Of the targets, in pixels.
let samples = 1;     // Per pixel.

async function stored(id, kind) {
  const text = document.getElementById(id).textContent;
  return (await fetch(`data:${kind};base64,${text}`)).blob();
}

async function inflated(id) {
  const blob = await stored(id, "application/octet-stream");
  return new Response(blob.stream().pipeThrough(new DecompressionStream("deflate")));
}

// Decodes integers (N, K); explorer/mesh.py encodes them.
function unpacked(bytes, [rows, width]) {
  const count = rows * width;
  const values = new Int32Array(count);
  const [low, second, third, high] =
    [0, 1, 2, 3].map(plane => bytes.subarray(plane * count, (plane + 1) * count));
  for (let i = 0; i < count; ++i) {
    const folded = low[i] | second[i] << 8 | third[i] << 16 | high[i] << 24;
    values[i] = (folded >>> 1 ^ -(folded & 1)) + (i < width ? 0 : values[i - width]);
  }
  return values;
}

// Returns each part with the arrays for the renderer's vertex shader, and the part's triangles.
async function meshParts() {
  const bytes = new Uint8Array(await (await inflated("geometry")).arrayBuffer());
  let end = 0;
  const columns = facts.columns.map(shape =>
    unpacked(bytes.subarray(end, end += 4 * shape[0] * shape[1]), shape));
  return facts.parts.map(part => {
    const attributes = mapped(part.arrays, ({column, scale, offset}) => {
      const width = scale.length;
      const value = (x, i) => x * scale[i % width] + offset[i % width];
      return [width, Float32Array.from(columns[column], value)];
    });
    return {...part, attributes, triangles: Uint32Array.from(columns[part.faces])};
  });
}

async function mapImages() {
  const asStored = {colorSpaceConversion: "none", premultiplyAlpha: "none"};
  return Promise.all(facts.maps.map(async (map, i) =>
    ({...map, image: await createImageBitmap(await stored(`map-${i}`, "image/*"), asStored)})));
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaledBy = (a, factor) => a.map(x => x * factor);
const unit = a => scaledBy(a, 1 / Math.hypot(...a));
const fromTarget = offset => offset.map((x, i) => x + facts.target[i]);

function directionTo({azimuth, elevation}) {
  const [a, e] = [radians(azimuth), radians(elevation)];
  return [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
}

// Returns the camera's position, its distance from the target, and the row-major view-projection
// matrix for row vectors.
function viewOf({azimuth, elevation, zoom, fov}, [width, height]) {
  const [aspect, scale] = [width / height, 1 / Math.tan(radians(fov) / 2)];
  const [sine, cosine] = [Math.sin(radians(elevation)), Math.cos(radians(elevation))];
  const distance = facts.framing_margin / zoom * Math.max(...facts.profile.flatMap(([r, y]) => [
    y * (sine + cosine * scale) + r * Math.abs(cosine - sine * scale),
    y * (sine - cosine * scale) + r * Math.abs(cosine + sine * scale),
    y * sine + r * Math.hypot(scale / aspect, cosine)]));
  const back = directionTo({azimuth, elevation});
  const position = fromTarget(scaledBy(back, distance));
  const up = Math.abs(back[1]) > 0.9999
    ? scaledBy(directionTo({azimuth, elevation: 0}), -Math.sign(back[1])) : [0, 1, 0];
  const side = unit(cross(up, back));
  const depth = dot(position, back);
  const far = Math.max(depth + 1, 0.02);
  const near = Math.max(depth - 1, far * 1e-3);
  const column = (axis, factor, more = 0) =>
    [...scaledBy(axis, factor), -dot(position, axis) * factor + more];
  const columns = [  // Y points down.
    column(side, scale / aspect), column(cross(back, side), -scale),
    column(back, -(far + near) / (far - near), -2 * far * near / (far - near)), column(back, -1)];
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

// Returns the elements of a light in the uniform arrays of the light's kind.
function lightElements(light) {
  const [distance, sine] = [light.distance ?? 1, Math.sin(radians(light.radius))];
  return [
    scaledBy(directionTo(light), distance), scaledBy(light.irradiance, distance ** 2),
    light.distance === null ? [sine, 0.5 + 0.5 * Math.sqrt(1 - sine * sine)] : distance * sine,
  ];
}

// Returns a term's function call, and its GLSL without #include, valid for m >= smallest.
function termSource(term, smallest) {
  const plain = lobeOf(term).by_angle && smallest >= registry.small_slope;
  const factors = modelOf(term).factors ? [term.fresnel, term.masking] : [];
  const key = [term.model, term.lobe, ...factors, ...plain ? ["plain"] : []].join(" ");
  const {lines, call} = sources.terms[key];
  const text = lines.map(i => sources.lines[i]).join("\n") + "\n";
  if (!isPower(term)) return {text, call};
  const offset = term.offset ? ` - ${literal(term.offset)}` : "";
  const steepness = `(${literal(term.factor)} / ((m) * (m))${offset})`;
  return {call, text: text.replace(/(?<=^#define FR_G ).*/m, term.g)
    .replace(/(?<=^#define FR_STEEPNESS\(m, k\) ).*/m, steepness)};
}

// Returns the first lines of the renderer's programs for a part: the part's features as macros.
const surfaceHead = (part, term) => "#version 300 es\n" + part.features
  .filter(name => termOf(part, term).m === null || name !== "ROUGHNESS_MAP")
  .map(name => `#define ${name}\n`).join("");

function shadeSource(part, term, specular = true) {
  const {lights, ambient, only} = state;
  const head = [surfaceHead(part, term)];
  if (only === "all" && part.uniforms.diffuse_brdf > 0) head.push("#define DIFFUSE\n");
  if (only === "all" && ambient.some(Boolean)) head.push("#define AMBIENT\n");
  if (specular) {
    const {text, call} = termSource(term, termOf(part, term).m ?? part.slopes[0]);
    head.push(text, "#define SPECULAR\n",
      "float specular_term(vec3 n, vec3 l, vec3 v, float m, float f0) {\n",
      term.constant === null ? "" : `    m = ${literal(term.constant)};\n`,
      `    return ${call};\n}\n`);
  } else {
    head.push("precision highp float;\n");
  }
  const loops = [];
  for (const [kind, {text}] of Object.entries(sources.lights)) {
    const count = lights.filter(light => lightKind(light) === kind).length;
    if (!count) continue;
    head.push(`#define ${kind.toUpperCase()}_LIGHTS ${count}\n`, text);
    loops.push(`for (int i = 0; i < ${count}; ++i) add_light(s, v, ${kind}_light(i, s.position), true);`);
  }
  return [...head, `#define EVERY_LIGHT ${loops.join(" ")}\n`, sources.host["shade.frag"]].join("");
}

// Opens the context of the canvas and uploads parts and maps; called again after a lost context is
// restored.
function startDrawing() {
  gl = canvas.getContext("webgl2",
    {alpha: false, antialias: false, depth: false, powerPreference: "high-performance"});
  if (!gl) {
    throw new Unable("This browser has no WebGL 2, or it is turned off. All browsers since 2021 "
      + "support it: turn on hardware acceleration in the settings, and see chrome://gpu or about:support.");
  }
  if (gl.isContextLost()) {
    throw new Unable("The graphics driver did not create a WebGL context: reload the page.");
  }
  if (!gl.getExtension("EXT_color_buffer_float")) {
    throw new Unable("This GPU cannot draw to float targets (EXT_color_buffer_float), which the page "
      + "needs for errors below 1/255: open the page on another machine.");
  }
  programs = new Map();
  targets = {};
  const counts = gl.getInternalformatParameter(gl.RENDERBUFFER, gl.RGBA32F, gl.SAMPLES) ?? [];
  samples = Math.max(1, ...[...counts].filter(count => count <= MOST_SAMPLES));
  parts.forEach(uploadPart);
  textures = images.map(mapTexture);
}

function uploadPart(part) {
  part.array = gl.createVertexArray();
  gl.bindVertexArray(part.array);
  for (const [name, [width, values]] of Object.entries(part.attributes)) {
    const location = ATTRIBUTES.indexOf(name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, width, gl.FLOAT, false, 0, 0);
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, part.triangles, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
}

function mapTexture({kind, image, wrap, nearest}) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  const format = kind === "color" ? gl.SRGB8_ALPHA8 : gl.RGBA8;
  const levels = 1 + Math.floor(Math.log2(Math.max(image.width, image.height)));
  gl.texStorage2D(gl.TEXTURE_2D, levels, format, image.width, image.height);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, image);
  const modes = {repeat: gl.REPEAT, clamp: gl.CLAMP_TO_EDGE, mirror: gl.MIRRORED_REPEAT};
  const parameter = (name, value) => gl.texParameteri(gl.TEXTURE_2D, name, value);
  parameter(gl.TEXTURE_WRAP_S, modes[wrap[0]]);
  parameter(gl.TEXTURE_WRAP_T, modes[wrap[1]]);
  parameter(gl.TEXTURE_MIN_FILTER, nearest ? gl.NEAREST_MIPMAP_NEAREST : gl.LINEAR_MIPMAP_LINEAR);
  if (nearest) parameter(gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  if (kind === "normal") halveNormals(texture, levels, image);
  else gl.generateMipmap(gl.TEXTURE_2D);
  return texture;
}

// Computes the mip levels of a normal map. Alpha stores the standard deviation of the slopes in a
// texel, which is 0 in the finest level.
function halveNormals(texture, levels, {width, height}) {
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  const drawTo = level => gl.framebufferTexture2D(
    gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, level);
  const readFrom = (first, last) => {
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_BASE_LEVEL, first);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, last);
  };
  drawTo(0);
  gl.colorMask(false, false, false, true);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.colorMask(true, true, true, true);
  const sides = level => [width, height].map(length => Math.max(length >> level, 1));
  for (let i = 1; i < levels; ++i) {
    readFrom(i - 1, i - 1);
    drawTo(i);
    drawScreen(sides(i), [sources.variance, sources.page["level.frag"]],
      {finer: 0, finest: i === 1, last: sides(i - 1).map(side => side - 1)});
  }
  readFrom(0, levels - 1);
  gl.deleteFramebuffer(buffer);
}

function compiled(vertex, fragment) {
  const program = gl.createProgram();
  const shaders = [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]].map(([kind, text]) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    return shader;
  });
  ATTRIBUTES.forEach((name, i) => gl.bindAttribLocation(program, i, name));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = shaders.map(shader => gl.getShaderInfoLog(shader));
    const log = logs.join(" ") || gl.getProgramInfoLog(program);
    throw new Unable(`The graphics driver cannot compile a shader: ${log}`);
  }
  shaders.forEach(shader => gl.deleteShader(shader));
  const uniforms = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let i = 0; i < count; ++i) {
    const {name, type} = gl.getActiveUniform(program, i);
    uniforms[name.replace("[0]", "")] = [gl.getUniformLocation(program, name), type];
  }
  return {program, uniforms};
}

// Selects a program, and sets its uniforms from a table of numbers, lists and booleans; names that
// the program lacks are skipped.
function useProgram(vertex, fragment, values) {
  const key = vertex + fragment;
  if (!programs.has(key)) programs.set(key, compiled(vertex, fragment));
  const {program, uniforms} = programs.get(key);
  gl.useProgram(program);
  const setters = {
    [gl.FLOAT]: "uniform1fv", [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv",
    [gl.FLOAT_VEC4]: "uniform4fv", [gl.INT_VEC2]: "uniform2iv",
  };
  for (const [name, value] of Object.entries(values)) {
    if (!uniforms[name]) continue;
    const [location, type] = uniforms[name];
    const list = [value].flat();
    if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(location, false, list);
    else if (setters[type]) gl[setters[type]](location, list);
    else gl.uniform1i(location, +list[0]);  // int, bool, sampler
  }
}

// Runs a fragment program, given as texts, at all pixels of the bound target.
function drawScreen(sides, fragment, values) {
  const head = "#version 300 es\n";
  useProgram(head + sources.host["screen.vert"], head + fragment.join(""), values);
  gl.disable(gl.DEPTH_TEST);
  gl.viewport(0, 0, ...sides);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
}

function nearestTexture(format, sides) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, ...sides);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

// Creates a float32 RGBA target with textures. If `count` is not 0, the target instead has a
// renderbuffer with `count` samples, which the caller resolves into another target.
function floatTarget(sides, {attachments = 1, depth = false, count = 0} = {}) {
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  const renderbuffer = (attachment, format) => {
    const made = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, made);
    gl.renderbufferStorageMultisample(gl.RENDERBUFFER, count, format, ...sides);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, made);
    return made;
  };
  const textures = Array.from({length: count ? 0 : attachments}, (_, i) => {
    const texture = nearestTexture(gl.RGBA32F, sides);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    return texture;
  });
  if (textures.length) gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  const renderbuffers = [
    ...count ? [renderbuffer(gl.COLOR_ATTACHMENT0, gl.RGBA32F)] : [],
    ...depth ? [renderbuffer(gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24)] : [],
  ];
  return {buffer, textures, renderbuffers};
}

function release({buffer, textures, renderbuffers}) {
  gl.deleteFramebuffer(buffer);
  textures.forEach(texture => gl.deleteTexture(texture));
  renderbuffers.forEach(renderbuffer => gl.deleteRenderbuffer(renderbuffer));
}

function resize(sides) {
  if (targets.a && String(sides) === String(size)) return;
  Object.values(targets).forEach(release);
  [canvas.width, canvas.height] = size = sides;
  const single = () => floatTarget(size, {depth: samples === 1});
  targets = {a: single(), b: single(), error: single()};
  if (samples > 1) targets.sampled = floatTarget(size, {depth: true, count: samples});
}

function bindCleared(target, background) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  gl.clearColor(...background, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
}

// Draws all parts into the bound target; sourceOf returns the fragment shader of a part.
function drawParts(term, sourceOf) {
  const {matrix, position} = viewOf(state.camera, size);
  const scene = {ambient: state.ambient, view_projection: matrix, camera_position: [...position, 1]};
  for (const [kind, {arrays}] of Object.entries(sources.lights)) {
    const elements = state.lights.filter(light => lightKind(light) === kind).map(lightElements);
    arrays.forEach((name, i) => { scene[name] = elements.flatMap(each => each[i]); });
  }
  gl.viewport(0, 0, ...size);
  gl.enable(gl.DEPTH_TEST);
  gl.cullFace(gl.FRONT);  // The image is drawn upside down, so front and back swap.
  parts.forEach((part, i) => {
    const {m, f0, ks} = termOf(part, term);
    const values = {...part.uniforms, ...scene, part: i + 1};
    for (const [name, factor] of [["slope", m], ["f0", f0], ["specular_weight", ks]]) {
      if (factor !== null) values[name] = factor;
    }
    Object.entries(part.maps).forEach(([name, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, textures[texture]);
      values[name] = unit;
    });
    useProgram(surfaceHead(part, term) + sources.host["surface.vert"], sourceOf(part), values);
    gl.bindVertexArray(part.array);
    gl[part.doubleSided ? "disable" : "enable"](gl.CULL_FACE);
    gl.drawElements(gl.TRIANGLES, part.triangles.length, gl.UNSIGNED_INT, 0);
  });
  gl.bindVertexArray(null);
  gl.disable(gl.CULL_FACE);
  gl.activeTexture(gl.TEXTURE0);
}

// Draws image "a" or "b", or "base" (A without highlights), into a target, and resolves the multisampled
// target if there is one. The visible pixels are shaded 1 + count times.
function draw(which, target = targets[which], count = 0) {
  const term = state[which === "base" ? "a" : which];
  bindCleared(targets.sampled ?? target, facts.background);
  gl.depthFunc(count ? gl.LEQUAL : gl.LESS);
  for (let i = 0; i <= count; ++i) drawParts(term, part => shadeSource(part, term, which !== "base"));
  gl.depthFunc(gl.LESS);
  if (!targets.sampled) return;
  const whole = [0, 0, ...size];
  gl.bindFramebuffer(gl.READ_FRAMEBUFFER, targets.sampled.buffer);
  gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, target.buffer);
  gl.blitFramebuffer(...whole, ...whole, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  // With this call, tiled GPUs need not store the samples. Without this call, ANGLE on SwiftShader
  // clears the multisampled target for B before it resolves the samples of A.
  gl.invalidateFramebuffer(gl.READ_FRAMEBUFFER, [gl.COLOR_ATTACHMENT0, gl.DEPTH_ATTACHMENT]);
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
}

// Runs a fragment program that reads the errors of B against A into a target, or the canvas (null).
function drawErrors(buffer, fragment, values) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  [targets.a, targets.b].forEach((target, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, target.textures[0]);
  });
  gl.activeTexture(gl.TEXTURE0);
  drawScreen(size, [sources.page["error.glsl"], fragment],
    {a: 0, b: 1, exposure: 2 ** state.exposure, background: facts.background, ...values});
}

function show(gain) {
  const [width, height] = size;
  const cut = {wipe: Math.round(state.cut * width), a: width, b: 0, difference: 0}[state.show];
  drawErrors(null, sources.page["show.frag"],
    {height, cut, gain, difference: state.show === "difference", budget: state.budget ?? -1});
}

// Reads a target asynchronously as float32 RGBA, row 0 on top; null if the context was lost.
async function read(target) {
  const pixels = new Float32Array(4 * size[0] * size[1]);
  const buffer = gl.createBuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
  gl.bufferData(gl.PIXEL_PACK_BUFFER, pixels.byteLength, gl.STREAM_READ);
  gl.readPixels(0, 0, ...size, gl.RGBA, gl.FLOAT, 0);
  gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
  if (!await fenced()) return null;
  gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
  gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, pixels);
  gl.deleteBuffer(buffer);  // Unbinds it, too.
  return pixels;
}

const pause = milliseconds => new Promise(resolve => setTimeout(resolve, milliseconds));

// Waits until the GPU has finished all commands. Resolves to false if the context is lost.
async function fenced() {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  for (;;) {
    if (gl.isContextLost()) return false;
    const status = gl.clientWaitSync(fence, 0, 0);
    if (status === gl.WAIT_FAILED) throw new Error("the GPU failed");
    if (status !== gl.TIMEOUT_EXPIRED) break;
    await pause(4);
  }
  gl.deleteSync(fence);
  return true;
}

// Returns the surface values and the radiance of A and B at the centres of the pixels [x, y].
function probe(places) {
  // Draws the mesh, then reads a pixel of each attachment at each place.
  const sampled = (attachments, background, term, sourceOf) => {
    const target = floatTarget(size, {attachments, depth: true});
    bindCleared(target, background);
    drawParts(term, sourceOf);
    const values = places.map(([x, y]) => target.textures.map((_, i) => {
      const pixel = new Float32Array(4);
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
      gl.readPixels(x, y, 1, 1, gl.RGBA, gl.FLOAT, pixel);
      return [...pixel];
    }));
    release(target);
    return values;
  };
  const [a, b] = [state.a, state.b].map(term => {
    const image = sampled(1, facts.background, term, part => shadeSource(part, term));
    const images = ["POSITION", "NORMAL", "ALBEDO", "UV"].map(
      (name, i) => `#define ${name}_IMAGE ${i}\n`).join("");
    return sampled(4, [0, 0, 0], term, part =>
      surfaceHead(part, term) + images + sources.host["gbuffer.frag"]).map(
      ([position, normal, albedo, other], i) => ({
        part: position[3] - 1, position: position.slice(0, 3), normal: normal.slice(0, 3),
        m: normal[3], albedo: albedo.slice(0, 3), specular_weight: albedo[3],
        occlusion: other[2], radiance: image[i][0].slice(0, 3),
      }));
  });
  return places.map((_, i) => ({a: a[i], b: b[i]}));
}
