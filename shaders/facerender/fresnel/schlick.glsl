// Fresnel reflectance, Schlick's approximation.
//
//   formula   f0 + (1 - f0)(1 - V.H)^5
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   unit      none, in [0, 1]
//   error     at most 0.046 absolute at f0 = 0.028 (at 84 degrees)
//   source    Schlick (1994), eq. 15
#ifndef FR_FRESNEL_SCHLICK_GLSL
#define FR_FRESNEL_SCHLICK_GLSL

#include "../constants.glsl"

float fr_fresnel_schlick(float f0, float v_dot_h) {
    float u = max(1.0 - v_dot_h, 0.0);
    float u2 = u * u;
    return f0 + (1.0 - f0) * (u2 * u2 * u);
}

#endif
