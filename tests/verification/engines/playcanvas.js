// Runs in a page: draws each fragment shader over a float target of PlayCanvas. Returns the version
// of PlayCanvas and the pixels, as base64 of float32.
async ({fragments, size}) => {
  const pc = await import("/node_modules/playcanvas/build/playcanvas.min.mjs");
  const device = new pc.Application(document.createElement("canvas")).graphicsDevice;
  const settings = {width: size, height: size, format: pc.PIXELFORMAT_RGBA32F, mipmaps: false};
  const texture = new pc.Texture(device, settings);
  const renderTarget = new pc.RenderTarget({colorBuffer: texture, depth: false});
  device.setBlendState(pc.BlendState.NOBLEND);
  const images = [];
  for (const fragmentGLSL of fragments) {
    const shader = pc.ShaderUtils.createShader(device, {
      uniqueName: `scene${images.length}`,
      attributes: {corner: pc.SEMANTIC_POSITION},
      vertexGLSL: "attribute vec2 corner; void main() { gl_Position = vec4(corner, 0.0, 1.0); }",
      fragmentGLSL,
    });
    pc.drawQuadWithShader(device, renderTarget, shader);
    const pixels = await texture.read(0, 0, size, size, {renderTarget});
    images.push(new Uint8Array(pixels.buffer).toBase64());
  }
  return [`PlayCanvas ${pc.version}`, images];
}
