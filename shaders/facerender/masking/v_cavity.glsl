// Masking by V-shaped cavities.
//
//   formula            G = min(1, 2 (N.H)(N.V)/(V.H), 2 (N.H)(N.L)/(V.H))
//   n_dot_h, v_dot_h   cosines with the half vector; only their ratio counts, so that h may have
//                      any length; v_dot_h > 0
//   n_dot_l, n_dot_v   cosines of light and eye, in (0, 1]
//   unit               none, in [0, 1]
//   error              none
//   source             Torrance and Sparrow (1967); Cook and Torrance (1982)
#ifndef FR_MASKING_V_CAVITY_GLSL
#define FR_MASKING_V_CAVITY_GLSL

#include "../constants.glsl"

float fr_masking_v_cavity(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v) {
    return min(1.0, 2.0 * n_dot_h * min(n_dot_l, n_dot_v) / v_dot_h);
}

// Masking by V-shaped cavities over the divisor of a BRDF, as numerator and denominator.
//
//   formula            G/((N.L)(N.V)) = x/(y h.h), with FR_FLOOR more in y
//   n_dot_h, h_dot_h   dot(n, h) and dot(h, h) of h = l + v
//   n_dot_l, n_dot_v   cosines of light and eye, in [-1, 1]
//   unit               none; x >= 0, and 0 where a cosine is not above 0; y > 0
//   error              of the formula FR_FLOOR/((N.L)(N.V)), relative
vec2 fr_masking_v_cavity_ratio(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v) {
    float lower = clamp(min(n_dot_l, n_dot_v), 0.0, 1.0);  // on GPUs no instruction of its own
    return vec2(min(h_dot_h, 4.0 * abs(n_dot_h) * lower), abs(n_dot_l * n_dot_v) + FR_FLOOR);
}

#endif
