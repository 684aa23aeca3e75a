// Masking that cancels the divisor of a BRDF: G/((N.L)(N.V)) = 4/(h.h) for h = l + v.
//
//   formula            G = (N.L)(N.V)/(V.H)^2
//   v_dot_h            cosine of eye and unit half vector, at least (N.L + N.V)/2 as of any
//                      directions
//   n_dot_l, n_dot_v   cosines of light and eye, in (0, 1]
//   unit               none, in [0, 1]
//   error              from half of fr_masking_v_cavity to all of it, which it is in the mirror
//                      direction; facerender plan tells what that makes in a scene
//   source             Kelemen and Szirmay-Kalos (2001); for skin: GPU Gems 3, chapter 14 (2007)
#ifndef FR_MASKING_KELEMEN_GLSL
#define FR_MASKING_KELEMEN_GLSL

#include "../constants.glsl"

float fr_masking_kelemen(float v_dot_h, float n_dot_l, float n_dot_v) {
    float inverse = 1.0 / v_dot_h;  // whose square may overflow
    return n_dot_l * inverse * (n_dot_v * inverse);
}

// Masking that cancels the divisor of a BRDF, as numerator and denominator.
//
//   formula            G/((N.L)(N.V)) = x/(y h.h)
//   n_dot_l, n_dot_v   cosines of light and eye, in [-1, 1]
//   unit               none; x >= 0, and 0 where a cosine is not above FR_MIN_COSINE; y is 1
//   error              none
vec2 fr_masking_kelemen_ratio(float n_dot_l, float n_dot_v) {
    return vec2(min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? 4.0 : 0.0, 1.0);
}

#endif
