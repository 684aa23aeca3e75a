// A three.js material with facerender's specular term. It can replace MeshStandardMaterial in a
// scene, because it keeps the lights, maps and colour management of three.js.
import { MeshStandardMaterial } from "three";
import { cookTorrance } from "facerender-shaders";

const lighting = /* glsl */ `
#include <lights_physical_pars_fragment>
${cookTorrance}
uniform float m;
uniform float f0;

void RE_Direct_Skin(const in IncidentLight light, const in vec3 position, const in vec3 normal,
                    const in vec3 viewDir, const in vec3 clearcoatNormal,
                    const in PhysicalMaterial material, inout ReflectedLight reflected) {
  vec3 irradiance = light.color * saturate(dot(normal, light.direction));
  reflected.directDiffuse += irradiance * BRDF_Lambert(material.diffuseColor);
  reflected.directSpecular += irradiance * fr_cook_torrance(normal, light.direction, viewDir, m, f0);
}
#undef RE_Direct
#define RE_Direct RE_Direct_Skin
`;

/**
 * A material with Lambert's diffuse term and the Cook-Torrance specular term. It ignores
 * roughness, metalness and environment maps.
 *
 * lobe    exact, cosine, d4, d8, d16, fitted or fitted-fine; set needsUpdate after a change
 * m, f0   uniforms { value }, which several materials may share: roughness (RMS slope), in
 *         [1e-4, 0.7] for approximations, and reflectance at normal incidence
 */
export class SkinMaterial extends MeshStandardMaterial {
  constructor({ lobe = "exact", m = { value: 0.3 }, f0 = { value: 0.028 }, ...parameters } = {}) {
    super(parameters);
    this.lobe = lobe;
    this.m = m;
    this.f0 = f0;
  }

  onBeforeCompile(shader) {
    Object.assign(shader.uniforms, { m: this.m, f0: this.f0 });
    shader.fragmentShader =
      `#define FR_LOBE FR_LOBE_${this.lobe.toUpperCase().replace("-", "_")}\n` +
      shader.fragmentShader.replace("#include <lights_physical_pars_fragment>", () => lighting);
  }

  customProgramCacheKey() {
    return `facerender ${this.lobe}`;
  }
}
