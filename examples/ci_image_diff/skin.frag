#version 330 core
// A bumpy sphere with a Cook-Torrance highlight, in orthographic projection along -z. RGB is linear
// radiance, premultiplied by alpha; alpha is the coverage.
#include "facerender/cook_torrance.glsl"

uniform float m;
uniform float specular_weight;
in vec2 p;  // position in the image, in radii of the sphere
out vec4 radiance;

const vec3 light = normalize(vec3(-1.0, 1.0, 1.5));
const vec3 eye = vec3(0.0, 0.0, 1.0);
const float irradiance = 2.5;
const vec3 albedo = vec3(0.46, 0.25, 0.17);

void main() {
    float r = length(p);
    vec3 n = vec3(p / max(r, 1.0), sqrt(max(1.0 - r * r, 0.0)));
    n = normalize(n + 0.06 * n.z * sin(23.0 * n.yzx));
    float received = irradiance * max(dot(n, light), 0.0);
    float specular = specular_weight * fr_cook_torrance(n, light, eye, m, 0.028);
    float coverage = clamp(0.5 + (1.0 - r) / fwidth(p.x), 0.0, 1.0);
    radiance = coverage * vec4(received * (albedo / FR_PI + specular), 1.0);
}
