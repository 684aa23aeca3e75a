import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { FullScreenQuad } from "three/addons/postprocessing/Pass.js";
import headUrl from "../../assets/head.glb?url";
import { SkinMaterial } from "./skin.js";

const $ = (selector) => document.querySelector(selector);
const main = $("main");
const figures = [...document.querySelectorAll("figure")]; // exact, approximation, difference

// Metres and linear colours; the colour of a distant light is its irradiance.
const scene = new THREE.Scene();
scene.background = new THREE.Color(0x24272b);
scene.add(new THREE.AmbientLight(0xffffff, 0.35));
addLight(-50, 42, new THREE.Color(3.6, 3.4, 3.1));
addLight(115, 33, new THREE.Color(0.72, 0.75, 0.81));

const m = { value: 0 };
const exact = new SkinMaterial({ m });
const approximation = new SkinMaterial({ m });
const normals = new THREE.MeshNormalMaterial();
const mesh = new THREE.Mesh();
scene.add(mesh);

const camera = new THREE.PerspectiveCamera(25, 1, 0.1, 5);
camera.position.set(-0.48, 0.05, 0.68);
const controls = new OrbitControls(camera, main);
Object.assign(controls, { enablePan: false, minDistance: 0.3, maxDistance: 2 });

const renderer = new THREE.WebGLRenderer({ canvas: $("canvas"), antialias: false });
renderer.setScissorTest(true);
const pictures = [0, 1].map(
  () => new THREE.WebGLRenderTarget(1, 1, { type: THREE.HalfFloatType, samples: 4 }),
);
const view = new FullScreenQuad(
  new THREE.ShaderMaterial({
    uniforms: {
      exact: { value: pictures[0].texture },
      approximation: { value: pictures[1].texture },
      index: { value: 0 },
    },
    vertexShader: /* glsl */ `
      varying vec2 at;
      void main() {
        at = uv;
        gl_Position = vec4(position.xy, 0.0, 1.0);
      }`,
    fragmentShader: /* glsl */ `
      uniform sampler2D exact, approximation;
      uniform int index;
      varying vec2 at;
      void main() {
        vec3 a = texture2D(exact, at).rgb;
        vec3 b = texture2D(approximation, at).rgb;
        float difference = 8.0 * dot(b - a, vec3(0.2126, 0.7152, 0.0722));
        vec3 brighter = max(difference, 0.0) * vec3(1.0, 0.32, 0.07);
        vec3 darker = max(-difference, 0.0) * vec3(0.1, 0.45, 1.0);
        gl_FragColor = vec4(index == 0 ? a : index == 1 ? b : brighter + darker, 1.0);
        #include <colorspace_fragment>
      }`,
  }),
);

const head = (await new GLTFLoader().loadAsync(headUrl)).scene.getObjectByName("head");
const { map, normalMap, normalScale, aoMap } = head.material;
const shapes = {
  head: {
    // Without morph targets, which would also move the centre of the bounds.
    geometry: Object.assign(head.geometry, { morphAttributes: {} }).center(),
    skin: { map, aoMap, color: new THREE.Color(1, 1, 1) },
    relief: { normalMap, normalScale },
  },
  sphere: {
    geometry: new THREE.SphereGeometry(0.1, 256, 128),
    skin: { map: null, aoMap: null, color: new THREE.Color(0.5, 0.27, 0.2) },
    relief: { normalMap: null },
  },
};

function addLight(azimuth, elevation, irradiance) {
  const light = new THREE.DirectionalLight(irradiance);
  light.position.setFromSphericalCoords(
    1,
    THREE.MathUtils.degToRad(90 - elevation),
    THREE.MathUtils.degToRad(azimuth),
  );
  scene.add(light);
}

function update() {
  const { geometry, skin, relief } = shapes[$("#shape").value];
  mesh.geometry = geometry;
  m.value = $("#m").valueAsNumber;
  approximation.lobe = $("#lobe").value;
  for (const material of [exact, approximation]) {
    material.setValues(skin);
    if ($("#specular").checked) material.color.set(0);
  }
  for (const material of [exact, approximation, normals]) {
    material.setValues(relief);
    material.needsUpdate = true;
  }
  $("output").value = m.value.toFixed(2);
  $("#name").textContent = approximation.lobe;
  redraw();
}

function resize() {
  const { clientWidth: width, clientHeight: height } = figures[0];
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setSize(main.clientWidth, main.clientHeight, false);
  const ratio = renderer.getPixelRatio();
  pictures.forEach((picture) => picture.setSize(width * ratio, height * ratio));
  camera.aspect = width / height;
  camera.zoom = Math.min(1, camera.aspect / 0.7); // fits the head's width in narrow views
  camera.updateProjectionMatrix();
  draw();
}

let frame = 0;
function redraw() {
  frame ||= requestAnimationFrame(draw);
}

function draw() {
  frame = 0;
  render(exact, pictures[0]);
  render(approximation, pictures[1]);
  renderer.setRenderTarget(null);
  figures.forEach(
    ({ offsetLeft: x, offsetTop, clientWidth: width, clientHeight: height }, index) => {
      const y = main.clientHeight - offsetTop - height;
      renderer.setViewport(x, y, width, height);
      renderer.setScissor(x, y, width, height);
      view.material.uniforms.index.value = index;
      view.render(renderer);
    },
  );
  read();
}

function render(material, target) {
  mesh.material = material;
  renderer.setRenderTarget(target);
  renderer.render(scene, camera);
}

const pixel = new THREE.WebGLRenderTarget(1, 1, { type: THREE.FloatType });
const raycaster = new THREE.Raycaster();

/** Return linear radiance, exact and approximated, and world-space geometry at a pixel of a view. */
function probe(x, y) {
  camera.setViewOffset(figures[0].clientWidth, figures[0].clientHeight, x, y, 1, 1);
  raycaster.setFromCamera(new THREE.Vector2(), camera);
  const [hit] = raycaster.intersectObject(mesh);
  const [a, b, c] = [exact, approximation, normals].map((material) => {
    render(material, pixel);
    const rgba = new Float32Array(4);
    renderer.readRenderTargetPixels(pixel, 0, 0, 1, 1, rgba);
    return rgba.slice(0, 3);
  });
  camera.clearViewOffset();
  if (!hit) return null;
  const normal = new THREE.Vector3(...c).subScalar(0.5).transformDirection(camera.matrixWorld);
  return {
    exact: [...a],
    approximation: [...b],
    normal: normal.toArray(),
    position: hit.point.toArray(),
    eye: camera.position.toArray(),
  };
}

let pointer = null;
function point({ offsetX, offsetY }) {
  pointer = [offsetX, offsetY];
  main.style.setProperty("--x", `${offsetX}px`);
  main.style.setProperty("--y", `${offsetY}px`);
  read();
}

function read() {
  const found = pointer && probe(...pointer);
  if (!found) {
    $("#readout").textContent = "Drag to rotate, scroll to zoom, point at the surface to read values.";
    return;
  }
  const [a, b] = [found.exact, found.approximation].map(
    ([red, green, blue]) => 0.2126 * red + 0.7152 * green + 0.0722 * blue,
  );
  const percent = ((100 * (b - a)) / a || 0).toFixed(1);
  const name = approximation.lobe;
  $("#readout").textContent =
    `Luminance here: exact\u00a0${a.toPrecision(3)}, ` +
    `${name}\u00a0${b.toPrecision(3)} (${percent < 0 ? "" : "+"}${percent}\u00a0%)`;
}

$("header").addEventListener("input", update);
controls.addEventListener("change", redraw);
for (const type of ["pointermove", "pointerdown"]) {
  figures.forEach((figure) => figure.addEventListener(type, point));
}
new ResizeObserver(resize).observe(main);
update();
window.probe = probe; // for the browser's console and tests/test_web.py
