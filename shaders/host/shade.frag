// Radiance of a fragment: the sum over the lights of irradiance x N.L x BRDF, and the ambient term.
// The program that includes this defines SPECULAR_BRDF(n, l, v, m, f0) and includes its model.
#include "facerender/constants.glsl"
#include "host/surface.glsl"

uniform float diffuse_weight;  // kd
uniform float f0;
#ifdef AMBIENT
uniform vec3 ambient;  // irradiance, the same from every direction
#endif
// Of either kind, lights with a whole specular term stand first (_SPECULAR of them), then those with
// that of frontal light (_FRONTAL), then those without.
#if DIRECTIONAL_LIGHTS > 0
uniform vec3 light_direction[DIRECTIONAL_LIGHTS];  // towards the light
uniform vec3 light_irradiance[DIRECTIONAL_LIGHTS];
#endif
#if POINT_LIGHTS > 0
uniform vec3 light_position[POINT_LIGHTS];
uniform vec3 light_intensity[POINT_LIGHTS];  // irradiance at distance 1
#endif
out vec4 radiance;

vec3 diffuse = vec3(0.0);
vec3 specular = vec3(0.0);

const int SPECULAR = 2, FRONTAL = 1, DULL = 0;

void add_light(Surface s, vec3 v, vec3 l, vec3 irradiance, int kind) {
    vec3 received = irradiance * max(dot(s.normal, l), 0.0);
    diffuse += received;
#ifdef SPECULAR_BRDF
    if (kind == SPECULAR) specular += received * SPECULAR_BRDF(s.normal, l, v, s.m, f0);
    if (kind == FRONTAL) specular += received * FRONTAL_BRDF(s.normal, l, v, s.m, f0);
#endif
}

#if DIRECTIONAL_LIGHTS > 0
void add_directional(Surface s, vec3 v, int first, int end, int kind) {
    for (int i = first; i < end; ++i) {
        add_light(s, v, light_direction[i], light_irradiance[i], kind);
    }
}
#endif

#if POINT_LIGHTS > 0
void add_points(Surface s, vec3 v, int first, int end, int kind) {
    for (int i = first; i < end; ++i) {
        vec3 to_light = light_position[i] - s.position;
        float distance2 = dot(to_light, to_light);
        vec3 l = to_light * inversesqrt(distance2);
        add_light(s, v, l, light_intensity[i] / distance2, kind);
    }
}
#endif

void main() {
    Surface s = surface();
    vec3 v = normalize(eye - s.position);
#ifdef AMBIENT
    diffuse += ambient * s.occlusion;
#endif
#if DIRECTIONAL_LIGHTS > 0
    int frontal_end = DIRECTIONAL_SPECULAR + DIRECTIONAL_FRONTAL;
    add_directional(s, v, 0, DIRECTIONAL_SPECULAR, SPECULAR);
    add_directional(s, v, DIRECTIONAL_SPECULAR, frontal_end, FRONTAL);
    add_directional(s, v, frontal_end, DIRECTIONAL_LIGHTS, DULL);
#endif
#if POINT_LIGHTS > 0
    int frontal_points_end = POINT_SPECULAR + POINT_FRONTAL;
    add_points(s, v, 0, POINT_SPECULAR, SPECULAR);
    add_points(s, v, POINT_SPECULAR, frontal_points_end, FRONTAL);
    add_points(s, v, frontal_points_end, POINT_LIGHTS, DULL);
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
