// Radiance of a fragment: the sum over the lights of irradiance x N.L x BRDF, and the ambient term.
// drawing/program.py writes what stands before: the lights' kinds, ADD_EVERY_LIGHT, which calls
// add_light for each of them with the number of its term, -1 for none, and, where a light has a term,
// SPECULAR and specular_term(term, n, l, v, m, f0).
#include "facerender/constants.glsl"
#include "host/light/light.glsl"
#include "host/surface.glsl"

uniform float diffuse_weight;  // kd
uniform float f0;
#ifdef AMBIENT
uniform vec3 ambient;  // irradiance, the same from every direction
#endif
out vec4 radiance;

vec3 diffuse = vec3(0.0);
vec3 specular = vec3(0.0);

void add_light(Surface s, vec3 v, Light light, int term) {
    vec3 received = light.irradiance * max(dot(s.normal, light.direction), 0.0);
    diffuse += received;
#ifdef SPECULAR
    if (term >= 0) {
        specular += received * specular_term(term, s.normal, light.direction, v, s.m, f0);
    }
#endif
}

void main() {
    Surface s = surface();
    vec3 v = normalize(eye - s.position);
#ifdef AMBIENT
    diffuse += ambient * s.occlusion;
#endif
    ADD_EVERY_LIGHT
    vec3 result = vec3(0.0);
#ifdef DIFFUSE
    result += diffuse_weight / FR_PI * s.albedo * diffuse;
#endif
#ifdef SPECULAR
    result += s.specular_weight * specular;
#endif
    radiance = vec4(result, 1.0);
}
