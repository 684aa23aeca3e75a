// Masking and shadowing by V-shaped cavities.
//
//   formula:           G = min(1, 2 (N.H)(N.V)/(V.H), 2 (N.H)(N.L)/(V.H))
//   n_dot_h, v_dot_h:  dot(n, h) and dot(v, h) > 0. The result depends only on their ratio, so that
//                      h may have any length.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in (0, 1].
//   unit:              none
//   returns:           In [0, 1].
//   error:             None.
//   source:            Torrance and Sparrow (1967); Cook and Torrance (1982).
#ifndef FR_MASKING_V_CAVITY_GLSL
#define FR_MASKING_V_CAVITY_GLSL

#include "../constants.glsl"

float fr_masking_v_cavity(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v) {
    return min(1.0, 2.0 * n_dot_h * min(n_dot_l, n_dot_v) / v_dot_h);
}

// V-cavity masking G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h), with FR_FLOOR added to y
//   n_dot_h, h_dot_h:  dot(n, h) and dot(h, h) for the half vector h = l + v.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   unit:              none
//   returns:           x >= 0 and y > 0; x is 0 if N.L or N.V is at most 0.
//   error:             FR_FLOOR in y lowers x/y by at most the fraction FR_FLOOR/((N.L)(N.V)).
vec2 fr_masking_v_cavity_ratio(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v) {
    float lower = clamp(min(n_dot_l, n_dot_v), 0.0, 1.0);  // A clamp to [0, 1] is free on GPUs.
    return vec2(min(h_dot_h, 4.0 * abs(n_dot_h) * lower), abs(n_dot_l * n_dot_v) + FR_FLOOR);
}

#endif
