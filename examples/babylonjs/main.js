// A sphere under two lights, with controls for the lobe and m.
import { LOBES, skinMaterial } from "./skin.js";

const unit = vector => vector.map(each => each / Math.hypot(...vector));
const lights = [
  { towards: unit([-1, 1, 1.5]), irradiance: [3.1, 3.0, 2.8] },
  { towards: unit([1.5, 0.4, -0.5]), irradiance: [1.2, 1.5, 2.0] },
];

const canvas = document.querySelector("#canvas");
const engine = new BABYLON.Engine(canvas, true);
const scene = new BABYLON.Scene(engine);
scene.useRightHandedSystem = true;
scene.clearColor = new BABYLON.Color4(0, 0, 0, 1);
const { Vector3 } = BABYLON;
const camera = new BABYLON.ArcRotateCamera("eye", Math.PI / 2, Math.PI / 2, 4, Vector3.Zero(), scene);
camera.attachControl(canvas);
const sphere = BABYLON.MeshBuilder.CreateSphere("sphere", { diameter: 2, segments: 64 }, scene);

const lobe = document.querySelector("#lobe");
const slope = document.querySelector("#m");
lobe.append(...Object.keys(LOBES).map(name => new Option(name)));

function choose() {
  sphere.material?.dispose();
  sphere.material = skinMaterial(scene, { lights, lobe: lobe.value, m: slope.valueAsNumber });
}
lobe.addEventListener("change", choose);
slope.addEventListener("input", choose);
window.addEventListener("resize", () => engine.resize());
choose();
engine.runRenderLoop(() => scene.render());

/** Return specular radiance, normal and position at a pixel of the canvas, in float. */
window.probe = async (x, y) => {
  const size = { width: engine.getRenderWidth(), height: engine.getRenderHeight() };
  const target = new BABYLON.RenderTargetTexture("probe", size, scene, {
    type: BABYLON.Constants.TEXTURETYPE_FLOAT, generateMipMaps: false,
  });
  target.renderList = [sphere];
  target.activeCamera = camera;
  await sphere.material.forceCompilationAsync(sphere);
  const found = { eye: camera.globalPosition.asArray(), lights };
  for (const [part, name] of [[1, "specular"], [2, "normal"], [3, "place"]]) {
    sphere.material.setInt("part", part);
    target.render();
    const pixel = await target.readPixels(0, 0, null, true, false, x, size.height - 1 - y, 1, 1);
    found[name] = [...pixel.slice(0, 3)];
  }
  sphere.material.setInt("part", 0);
  target.dispose();
  return found;
};
