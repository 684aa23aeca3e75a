// Environment lighting. ENVIRONMENT_SAMPLES is the number of samples per lobe. If this macro is
// undefined, there is no specular environment light.
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
