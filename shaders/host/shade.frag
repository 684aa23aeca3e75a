// Radiance of a fragment: the sum over the lights of irradiance x N.L x BRDF, and the ambient term.
// The program that includes this defines SPECULAR_BRDF(n, l, v, m, f0) and includes its model.
#include "facerender/constants.glsl"
#include "host/surface.glsl"

uniform float diffuse_weight;  // kd
uniform float f0;
#ifdef AMBIENT
uniform vec3 ambient;  // irradiance, the same from every direction
#endif
#if DIRECTIONAL_LIGHTS > 0
uniform vec3 light_direction[DIRECTIONAL_LIGHTS];  // towards the light
uniform vec3 light_irradiance[DIRECTIONAL_LIGHTS];
#endif
#if POINT_LIGHTS > 0
uniform vec3 light_position[POINT_LIGHTS];
uniform vec3 light_intensity[POINT_LIGHTS];  // irradiance at distance 1
#endif
out vec4 radiance;

void add_light(Surface s, vec3 v, vec3 l, vec3 irradiance, inout vec3 diffuse, inout vec3 specular) {
    vec3 received = irradiance * max(dot(s.normal, l), 0.0);
    diffuse += received;
#ifdef SPECULAR_BRDF
    specular += received * SPECULAR_BRDF(s.normal, l, v, s.m, f0);
#endif
}

void main() {
    Surface s = surface();
    vec3 v = normalize(eye - s.position);
    vec3 diffuse = vec3(0.0);
    vec3 specular = vec3(0.0);
#ifdef AMBIENT
    diffuse += ambient * s.occlusion;
#endif
#if DIRECTIONAL_LIGHTS > 0
    for (int i = 0; i < DIRECTIONAL_LIGHTS; ++i) {
        add_light(s, v, light_direction[i], light_irradiance[i], diffuse, specular);
    }
#endif
#if POINT_LIGHTS > 0
    for (int i = 0; i < POINT_LIGHTS; ++i) {
        vec3 to_light = light_position[i] - s.position;
        float distance2 = dot(to_light, to_light);
        vec3 l = to_light * inversesqrt(distance2);
        add_light(s, v, l, light_intensity[i] / distance2, diffuse, specular);
    }
#endif
    vec3 result = vec3(0.0);
#ifdef DIFFUSE
    result += diffuse_weight / FR_PI * s.albedo * diffuse;
#endif
#ifdef SPECULAR_BRDF
    result += s.specular_weight * specular;
#endif
    radiance = vec4(result, 1.0);
}
