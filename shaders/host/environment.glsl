// Environment lighting. ENVIRONMENT_SAMPLES is the number of samples per lobe. If this macro is
// undefined, there is no specular environment light. ENVIRONMENT_LIGHTS is the number of the
// environment's lights, which EVERY_LIGHT adds; environment_sh is then the remainder without them.
#ifdef ENVIRONMENT_SAMPLES
#define FR_ENVIRONMENT_SAMPLES ENVIRONMENT_SAMPLES
#endif
#include "facerender/environment.glsl"

uniform vec3 environment_sh[9];
uniform mat3 environment_turn;  // Rotation from mesh space to map space.
uniform float environment_scale;

vec3 environment_irradiance(vec3 n) {
    return environment_scale * fr_environment_irradiance(environment_sh, environment_turn * n);
}

#ifdef ENVIRONMENT_LIGHTS
// Integral of the remainder's radiance over the area of each light.
uniform vec3 environment_around[ENVIRONMENT_LIGHTS];

// Visible fractions of the remainder's irradiance and of the specular light, as weighted sums of the
// visible fractions of the lights, and the sums of the weights.
vec3 irradiance_seen = vec3(0.0);
vec3 irradiance_weights = vec3(0.0);
vec3 specular_seen = vec3(0.0);
vec3 specular_weights = vec3(0.0);

// Add the visible fraction of a light. For the irradiance, its weight is the remainder's light from
// its area; the 0.01 decides where no light is above the horizon. For the specular light, the weight
// is all light of the area times a Gaussian around the mirrored view with the width of the lobe and
// of the light; 0.02 is the width of an area between lights.
void add_fractions(Surface s, Disc light, int i, float seen) {
    vec3 l = light.center.direction, around = environment_around[i];
    vec3 weight = (max(dot(s.normal, l), 0.0) + 0.01) * around;
    irradiance_seen += seen * weight;
    irradiance_weights += weight;
    float width = 2.0 * s.m * s.m + 0.5 * light.size.x * light.size.x + 0.02;
    float lobe = exp((dot(reflect(-s.view, s.normal), l) - 1.0) / width) + 1e-4;
    weight = lobe * (light.center.irradiance + around);
    specular_seen += seen * weight;
    specular_weights += weight;
}

// Return the visible fractions of the remainder's irradiance and of the specular light. The specular
// fraction is reduced where little irradiance arrives: a shadow map has one surface per texel, so
// that light from behind the head leaks into the slit of the mouth.
vec3[2] environment_fractions() {
    vec3 whole = irradiance_seen / max(irradiance_weights, 1e-30);
    vec3 reflected = specular_seen / max(specular_weights, 1e-30);
    return vec3[2](whole, reflected * smoothstep(0.0, 1.0, whole));
}
#endif

#ifdef ENVIRONMENT_SAMPLES
uniform sampler2D environment_map;
uniform int environment_size;

#ifdef TWO_LOBES
vec3 environment_specular(vec3 n, vec3 v, float m, float second_m, float lobe_weight, float f0) {
#else
vec3 environment_specular(vec3 n, vec3 v, float m, float f0) {
#endif
    n = environment_turn * n;
    v = environment_turn * v;
    return environment_scale * (ENVIRONMENT_RADIANCE);
}
#endif
