// A Babylon.js material with facerender's Cook-Torrance term, for directional lights.
import { cookTorrance } from "./node_modules/facerender-shaders/index.js";

// Babylon.js compares macros as text, so FR_LOBE must be the number of a lobe, not its name.
export const LOBES = { exact: 1, cosine: 2, d4: 4, d8: 8, d16: 16, fitted: 3, "fitted-fine": 5 };
const LIGHTS = 2;

BABYLON.Effect.ShadersStore.skinVertexShader = `
attribute vec3 position;
attribute vec3 normal;
uniform mat4 world, worldViewProjection;
varying vec3 place;
varying vec3 across;

void main() {
  place = (world * vec4(position, 1.0)).xyz;
  across = mat3(world) * normal;
  gl_Position = worldViewProjection * vec4(position, 1.0);
}`;

BABYLON.Effect.ShadersStore.skinFragmentShader = `
${cookTorrance}
uniform vec3 eye, albedo;
uniform vec3 towards[${LIGHTS}], irradiance[${LIGHTS}];
uniform float m, f0;
uniform int part;  // output: 0 the image, 1 the specular radiance, 2 the normal, 3 the position
varying vec3 place;
varying vec3 across;

void main() {
  vec3 n = normalize(across);
  vec3 v = normalize(eye - place);
  vec3 diffuse = vec3(0.0), specular = vec3(0.0);
  for (int i = 0; i < ${LIGHTS}; ++i) {
    vec3 received = irradiance[i] * max(dot(n, towards[i]), 0.0);
    diffuse += received * albedo / FR_PI;
    specular += received * fr_cook_torrance(n, towards[i], v, m, f0);
  }
  vec3 shown = pow(clamp(diffuse + specular, 0.0, 1.0), vec3(1.0 / 2.2));
  gl_FragColor = vec4(part == 0 ? shown : part == 1 ? specular : part == 2 ? n : place, 1.0);
}`;

/**
 * Return a skin material.
 *
 * lights   array of LIGHTS objects { towards: unit vector to the light, irradiance: [r, g, b] }
 * lobe     a key of LOBES
 * m, f0    roughness (RMS slope), and reflectance at normal incidence
 */
export function skinMaterial(scene, { lights, lobe = "exact", m = 0.3, f0 = 0.028 }) {
  const material = new BABYLON.ShaderMaterial(`skin ${lobe}`, scene, "skin", {
    attributes: ["position", "normal"],
    uniforms: ["world", "worldViewProjection", "eye", "albedo", "m", "f0", "part"].concat(
      ["towards", "irradiance"]),
    defines: [`#define FR_LOBE ${LOBES[lobe]}`],
  });
  material.setArray3("towards", lights.flatMap(light => light.towards));
  material.setArray3("irradiance", lights.flatMap(light => light.irradiance));
  material.setVector3("albedo", new BABYLON.Vector3(0.46, 0.25, 0.17));
  material.setFloat("m", m);
  material.setFloat("f0", f0);
  material.setInt("part", 0);
  material.onBindObservable.add(() =>
    material.getEffect().setVector3("eye", scene.activeCamera.globalPosition));
  return material;
}
