#version 330 core
// A diffuse sphere with a Cook-Torrance highlight, in orthographic projection
// along -z. RGB is linear radiance; alpha is the specular radiance alone.
#include "facerender/cook_torrance.glsl"

in vec2 p;
out vec4 radiance;

const vec3 light = normalize(vec3(-1.0, 1.0, 1.5));
const vec3 eye = vec3(0.0, 0.0, 1.0);
const float irradiance = FR_PI;  // gives a white diffuse surface the radiance 1
const float ambient = 0.05;
const vec3 albedo = vec3(0.46, 0.25, 0.17);
const float m = 0.2;
const float f0 = 0.04;

void main() {
    float r = length(p);
    vec3 n = vec3(p / max(r, 1.0), sqrt(max(1.0 - r * r, 0.0)));
    float received = irradiance * max(dot(n, light), 0.0);
    float specular = received * fr_cook_torrance(n, light, eye, m, f0);
    float coverage = clamp(0.5 + (1.0 - r) / fwidth(p.x), 0.0, 1.0);
    vec3 diffuse = albedo * (received / FR_PI + ambient);
    radiance = coverage * vec4(diffuse + specular, specular);
}
