// Draws images A and B and their error into float targets, and the visible image on the canvas.
const MOST_SAMPLES = 4;

class Drawing {
  constructor(canvas, parts, images) {
    Object.assign(this, {canvas, parts, images});
    this.start();
  }

  // Opens the context and uploads all data; called again after a lost context is restored.
  start() {
    const gl = this.gl = openContext(this.canvas);
    this.programs = new Map();
    this.targets = null;
    this.size = [0, 0];
    const counts = gl.getInternalformatParameter(gl.RENDERBUFFER, gl.RGBA32F, gl.SAMPLES) ?? [];
    this.samples = Math.max(1, ...[...counts].filter(count => count <= MOST_SAMPLES));
    this.arrays = this.parts.map(part => this.uploaded(part));
    this.screen = gl.createVertexArray();
    this.textures = this.images.map(each =>
      mapTexture(gl, each, (...level) => this.halve(...level)));
  }

  uploaded({attributes, triangles}) {
    const {gl} = this;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (const [name, [width, values]] of Object.entries(attributes)) {
      const place = ATTRIBUTES.indexOf(name);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return array;
  }

  program(vertex, fragment) {
    const key = vertex + fragment;
    if (!this.programs.has(key)) this.programs.set(key, compiled(this.gl, vertex, fragment));
    const found = this.programs.get(key);
    this.gl.useProgram(found.program);
    return found;
  }

  onScreen(...fragment) {
    const head = "#version 300 es\n";
    return this.program(head + sources.host["screen.vert"], head + fragment.join(""));
  }

  triangle() {
    this.gl.bindVertexArray(this.screen);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  // Computes the mip levels of a normal map. Alpha stores the standard deviation of the slopes in a
  // texel, which is 0 in the finest level.
  halve(texture, levels, {width, height}) {
    const {gl} = this;
    const buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    const level = i => gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, i);
    level(0);
    gl.colorMask(false, false, false, true);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.colorMask(true, true, true, true);
    const program = this.onScreen(sources.variance, sources.page["level.frag"]);
    gl.disable(gl.DEPTH_TEST);
    for (let i = 1; i < levels; ++i) {
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_BASE_LEVEL, i - 1);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, i - 1);
      level(i);
      const side = (length, by) => Math.max(length >> by, 1);
      const last = [width, height].map(length => side(length, i - 1) - 1);
      setUniforms(gl, program, {finer: 0, finest: i === 1, last});
      gl.viewport(0, 0, side(width, i), side(height, i));
      this.triangle();
    }
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_BASE_LEVEL, 0);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, levels - 1);
    gl.deleteFramebuffer(buffer);
  }

  resize(width, height) {
    const {gl} = this;
    if (this.targets && this.size[0] === width && this.size[1] === height) return;
    Object.values(this.targets ?? {}).forEach(target => release(gl, target));
    Object.assign(this.canvas, {width, height});
    this.size = [width, height];
    const {samples} = this;
    const single = () => floatTarget(gl, this.size, {depth: samples === 1});
    this.targets = {
      a: single(), b: single(), error: single(),
      ...samples > 1 && {sampled: floatTarget(gl, this.size, {depth: true, samples})},
    };
  }

  // Draws all parts into the bound target; fragmentOf returns the fragment shader of a part.
  drawParts(state, term, fragmentOf) {
    const {gl} = this;
    const [width, height] = this.size;
    const view = viewOf(state.camera, width / height);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.cullFace(gl.FRONT);  // The image is drawn upside down, so front and back swap.
    this.parts.forEach((part, i) => {
      const program = this.program(vertexSource(part, term), fragmentOf(part));
      const values = {
        ...part.uniforms, ambient: state.ambient, part: i + 1,
        view_projection: view.matrix, camera_position: view.position,
      };
      for (const kind of Object.keys(sources.lights)) {
        const lights = state.lights.filter(light => lightKind(light) === kind);
        if (lights.length) Object.assign(values, lightArrays(kind, lights));
      }
      const {m, f0, ks} = termOf(part, term);
      for (const [name, own] of [["slope", m], ["f0", f0], ["specular_weight", ks]]) {
        if (own !== null) values[name] = own;
      }
      Object.entries(part.maps).forEach(([name, texture], unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, this.textures[texture]);
        values[name] = unit;
      });
      setUniforms(gl, program, values);
      gl.bindVertexArray(this.arrays[i]);
      gl[part.doubleSided ? "disable" : "enable"](gl.CULL_FACE);
      gl.drawElements(gl.TRIANGLES, part.triangles.length, gl.UNSIGNED_INT, 0);
    });
    gl.bindVertexArray(null);
    gl.disable(gl.CULL_FACE);
    gl.activeTexture(gl.TEXTURE0);
  }

  // Draws image "a" or "b".
  draw(which, state) {
    const target = this.targets[which];
    this.begin(target);
    this.drawParts(state, state[which], part => shadeSource(part, state[which], state));
    this.resolve(target);
  }

  // Binds and clears the multisampled target if there is one, otherwise `target`.
  begin(target) {
    const {gl} = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, (this.targets.sampled ?? target).buffer);
    gl.clearColor(...facts.background, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  resolve(target) {
    const {gl, targets: {sampled}} = this;
    if (!sampled) return;
    const whole = [0, 0, ...this.size];
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, sampled.buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, target.buffer);
    gl.blitFramebuffer(...whole, ...whole, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    // With this call, tiled GPUs need not store the samples. Without this call, ANGLE on SwiftShader
    // clears the multisampled target for B before it resolves the samples of A.
    gl.invalidateFramebuffer(gl.READ_FRAMEBUFFER, [gl.COLOR_ATTACHMENT0, gl.DEPTH_ATTACHMENT]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
  }

  // Shades the visible pixels of "a", "b" or "base" (no highlights) 1 + count times.
  repeat(state, which, count) {
    const {gl} = this;
    const term = state[which === "base" ? "a" : which];
    this.begin(this.targets.error);
    gl.depthFunc(gl.LEQUAL);
    for (let i = 0; i <= count; ++i) {
      this.drawParts(state, term, part => shadeSource(part, term, state, which !== "base"));
    }
    gl.depthFunc(gl.LESS);
  }

  // Binds images A and B as textures of a program that contains error.glsl.
  compare(program, exposure) {
    const {gl, targets} = this;
    [targets.a, targets.b].forEach((target, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, target.textures[0]);
    });
    setUniforms(gl, program, {a: 0, b: 1, exposure: 2 ** exposure});
    gl.activeTexture(gl.TEXTURE0);
    gl.disable(gl.DEPTH_TEST);
    gl.viewport(0, 0, ...this.size);
  }

  show({show, cut, budget, exposure}, gain) {
    const {gl} = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const program = this.onScreen(sources.page["error.glsl"], sources.page["show.frag"]);
    this.compare(program, exposure);
    const [width, height] = this.size;
    const left = {wipe: Math.round(cut * width), a: width, b: 0, difference: 0}[show];
    setUniforms(gl, program, {
      height, cut: left, difference: show === "difference", gain, budget: budget ?? -1,
    });
    this.triangle();
  }

  // Draws the error image, and returns a promise of its pixels.
  measure({exposure}) {
    const {gl} = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.error.buffer);
    this.compare(this.onScreen(sources.page["error.glsl"], sources.page["error.frag"]), exposure);
    this.triangle();
    return this.read(this.targets.error);
  }

  // Reads a target asynchronously as float32 RGBA, row 0 on top; null if the context was lost.
  async read(target) {
    const {gl} = this;
    const [width, height] = this.size;
    const buffer = gl.createBuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, 16 * width * height, gl.STREAM_READ);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    if (!await fenced(gl)) return null;
    const pixels = new Float32Array(4 * width * height);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, pixels);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.deleteBuffer(buffer);
    return pixels;
  }

  // Returns the surface values and the radiance of A and B at the centres of the pixels [x, y].
  probe(state, places) {
    const {gl} = this;
    const found = places.map(() => ({}));
    for (const which of ["a", "b"]) {
      const term = state[which];
      // Draws the mesh, then reads a pixel of each attachment at each place.
      const drawn = (attachments, background, fragmentOf) => {
        const target = floatTarget(gl, this.size, {attachments, depth: true});
        gl.bindFramebuffer(gl.FRAMEBUFFER, target.buffer);
        gl.clearColor(...background, 0);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
        this.drawParts(state, term, fragmentOf);
        const values = places.map(([x, y]) => target.textures.map((_, i) => {
          const pixel = new Float32Array(4);
          gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
          gl.readPixels(x, y, 1, 1, gl.RGBA, gl.FLOAT, pixel);
          return [...pixel];
        }));
        release(gl, target);
        return values;
      };
      const surface = drawn(4, [0, 0, 0], part => gbufferSource(part, term));
      const image = drawn(1, facts.background, part => shadeSource(part, term, state));
      surface.forEach(([position, normal, albedo, other], i) => {
        found[i][which] = {
          part: position[3] - 1, position: position.slice(0, 3), normal: normal.slice(0, 3),
          m: normal[3], albedo: albedo.slice(0, 3), specular_weight: albedo[3],
          occlusion: other[2], radiance: image[i][0].slice(0, 3),
        };
      });
    }
    return found;
  }
}

// Waits until the GPU has finished all commands. Resolves to false if the context is lost.
function fenced(gl) {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  return new Promise((resolve, reject) => {
    const look = () => {
      if (gl.isContextLost()) return resolve(false);
      const found = gl.clientWaitSync(fence, 0, 0);
      if (found === gl.TIMEOUT_EXPIRED) return setTimeout(look, 4);
      gl.deleteSync(fence);
      return found === gl.WAIT_FAILED ? reject(new Error("the GPU failed")) : resolve(true);
    };
    look();
  });
}
