// Runs in a page: draws each fragment shader over a float target of Babylon.js. Returns the version
// of Babylon.js and the pixels, as base64 of float32.
async ({fragments, size}) => {
  const script = document.body.appendChild(document.createElement("script"));
  script.src = "/node_modules/babylonjs/babylon.js";
  await new Promise((resolve, reject) => Object.assign(script, {onload: resolve, onerror: reject}));
  const engine = new BABYLON.Engine(document.createElement("canvas"), false);
  const settings = {
    type: BABYLON.Constants.TEXTURETYPE_FLOAT, generateMipMaps: false, generateDepthBuffer: false,
  };
  const target = new BABYLON.RenderTargetTexture("target", size, new BABYLON.Scene(engine), settings);
  const renderer = new BABYLON.EffectRenderer(engine);
  const images = [];
  for (const fragmentShader of fragments) {
    const wrapper = new BABYLON.EffectWrapper({engine, name: `scene${images.length}`, fragmentShader});
    await new Promise((resolve, reject) => {
      wrapper.effect.executeWhenCompiled(resolve);
      wrapper.effect.onError = (_, message) => reject(new Error(message));
    });
    renderer.render(wrapper, target);
    images.push(new Uint8Array((await target.readPixels()).buffer).toBase64());
  }
  return [`Babylon.js ${BABYLON.Engine.Version}`, images];
}
