// Helpers for WebGL 2: contexts, programs, textures, float targets. drawing.js uses them.
class Unable extends Error {}  // a feature is missing in this browser; the page shows the message

function openContext(canvas) {
  const wanted = {alpha: false, antialias: false, depth: false, powerPreference: "high-performance"};
  const gl = canvas.getContext("webgl2", wanted);
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
  return gl;
}

function compiled(gl, vertex, fragment) {
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

const ATTRIBUTES = ["in_position", "in_normal", "in_uv", "in_occlusion", "in_color"];

// Sets uniforms from a table of numbers, lists and booleans; names that the program lacks are skipped.
function setUniforms(gl, {uniforms}, values) {
  for (const [name, value] of Object.entries(values)) {
    if (!uniforms[name]) continue;
    const [location, type] = uniforms[name];
    const list = [value].flat();
    const setters = {
      [gl.FLOAT]: "uniform1fv", [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv",
      [gl.INT_VEC2]: "uniform2iv",
    };
    if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(location, false, list);
    else if (setters[type]) gl[setters[type]](location, list);
    else gl.uniform1i(location, +list[0]);  // int, bool, sampler
  }
}

function mapTexture(gl, {kind, image, wrap, nearest}, halve) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  const format = kind === "color" ? gl.SRGB8_ALPHA8 : gl.RGBA8;
  const levels = 1 + Math.floor(Math.log2(Math.max(image.width, image.height)));
  gl.texStorage2D(gl.TEXTURE_2D, levels, format, image.width, image.height);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, gl.RGBA, gl.UNSIGNED_BYTE, image);
  const modes = {repeat: gl.REPEAT, clamp: gl.CLAMP_TO_EDGE, mirror: gl.MIRRORED_REPEAT};
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, modes[wrap[0]]);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, modes[wrap[1]]);
  const filter = nearest ? gl.NEAREST_MIPMAP_NEAREST : gl.LINEAR_MIPMAP_LINEAR;
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  if (nearest) gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  if (kind !== "normal") gl.generateMipmap(gl.TEXTURE_2D);
  else halve(texture, levels, image);
  return texture;
}

function nearestTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

// Creates a float32 RGBA target with textures. If `samples` is not 0, the target instead has
// a multisampled renderbuffer, which the caller resolves into another target.
function floatTarget(gl, [width, height], {attachments = 1, depth = false, samples = 0} = {}) {
  const buffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
  const renderbuffer = (attachment, format) => {
    const made = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, made);
    gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, made);
    return made;
  };
  const textures = Array.from({length: samples ? 0 : attachments}, (_, i) => {
    const texture = nearestTexture(gl, gl.RGBA32F, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
    return texture;
  });
  if (textures.length) gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
  const renderbuffers = [
    ...samples ? [renderbuffer(gl.COLOR_ATTACHMENT0, gl.RGBA32F)] : [],
    ...depth ? [renderbuffer(gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24)] : [],
  ];
  return {buffer, textures, renderbuffers};
}

function release(gl, {buffer, textures, renderbuffers}) {
  gl.deleteFramebuffer(buffer);
  textures.forEach(texture => gl.deleteTexture(texture));
  renderbuffers.forEach(renderbuffer => gl.deleteRenderbuffer(renderbuffer));
}
