// A three.js page with the same content as the explorer's first image: the head in two shadings, on
// float targets with four samples, in a split view. With #plain, one shading on the canvas.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";

const { size, eye, fov, lights, ambient, background } = JSON.parse(
  document.querySelector("#facts").textContent,
);
const plain = location.hash === "#plain";
const canvas = document.querySelector("canvas");
const renderer = new THREE.WebGLRenderer({ canvas, antialias: plain });
renderer.setSize(...size);

const scene = new THREE.Scene();
scene.background = new THREE.Color(...background);
scene.add(new THREE.AmbientLight(new THREE.Color(...ambient), Math.PI));
for (const { direction, irradiance } of lights) {
  const light = new THREE.DirectionalLight(new THREE.Color(...irradiance));
  light.position.set(...direction);
  scene.add(light);
}

const camera = new THREE.PerspectiveCamera(fov, size[0] / size[1], 0.05, 5);
camera.position.set(...eye);
const controls = new OrbitControls(camera, canvas);
controls.addEventListener("change", () => requestAnimationFrame(draw));

const data = document.querySelector("#head").textContent;
const head = await fetch(`data:model/gltf-binary;base64,${data}`);
const loaded = await new GLTFLoader().parseAsync(await head.arrayBuffer(), "");
scene.add(loaded.scene);
const skin = loaded.scene.getObjectByName("head");
skin.geometry.center();
const materials = [1, 0.9].map((factor) => {
  const material = skin.material.clone();
  material.roughness *= factor;
  return material;
});

const targets = materials.map(
  () => new THREE.WebGLRenderTarget(...size, { type: THREE.FloatType, samples: 4 }),
);
const cut = new FullScreenQuad(
  new THREE.ShaderMaterial({
    uniforms: { a: { value: targets[0].texture }, b: { value: targets[1].texture } },
    vertexShader: /* glsl */ `
      varying vec2 at;
      void main() {
        at = uv;
        gl_Position = vec4(position.xy, 0.0, 1.0);
      }`,
    fragmentShader: /* glsl */ `
      uniform sampler2D a, b;
      varying vec2 at;
      void main() {
        gl_FragColor = at.x < 0.5 ? texture2D(a, at) : texture2D(b, at);
        #include <colorspace_fragment>
      }`,
  }),
);

function draw() {
  controls.update();
  if (plain) {
    skin.material = materials[0];
    renderer.render(scene, camera);
    return;
  }
  targets.forEach((target, i) => {
    skin.material = materials[i];
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
  });
  renderer.setRenderTarget(null);
  cut.render(renderer);
}
requestAnimationFrame(draw);
