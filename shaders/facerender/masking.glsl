// V-cavity masking and shadowing. For hosts that build a BRDF of their own; cook_torrance.glsl has
// it within its one division.
//
//   formula            G = min(1, 2 (N.H)(N.V)/(V.H), 2 (N.H)(N.L)/(V.H))
//   n_dot_h, v_dot_h   cosines with the half vector; only their ratio counts, so that h may have
//                      any length; v_dot_h > 0
//   n_dot_l, n_dot_v   cosines of light and eye, in (0, 1]
//   unit               none, in [0, 1]
//   error              none
//   source             Torrance and Sparrow (1967); Cook and Torrance (1982)
#ifndef FR_MASKING_GLSL
#define FR_MASKING_GLSL

#include "facerender/constants.glsl"

float fr_masking_v_cavity(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v) {
    return min(1.0, 2.0 * n_dot_h * min(n_dot_l, n_dot_v) / v_dot_h);
}

#endif
