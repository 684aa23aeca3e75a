// Masking and shadowing of microfacets. The host chooses the one that fr_cook_torrance has within its
// one division: #define FR_MASKING FR_MASKING_KELEMEN, or FR_MASKING_NONE, which is 1 and lets the
// BRDF grow as 1/(N.V) towards the silhouette. Default: V-cavities. The functions are for hosts that
// build a BRDF of their own.
//
//   n_dot_l, n_dot_v   cosines of light and eye, in (0, 1]
//   unit               none, in [0, 1]
//   error              of each: see there
#ifndef FR_MASKING_GLSL
#define FR_MASKING_GLSL

#include "facerender/constants.glsl"

#define FR_MASKING_V_CAVITY 0
#define FR_MASKING_KELEMEN 1
#define FR_MASKING_NONE 2

#ifndef FR_MASKING
#define FR_MASKING FR_MASKING_V_CAVITY
#endif

// Masking by V-shaped cavities.
//
//   formula            G = min(1, 2 (N.H)(N.V)/(V.H), 2 (N.H)(N.L)/(V.H))
//   n_dot_h, v_dot_h   cosines with the half vector; only their ratio counts, so that h may have
//                      any length; v_dot_h > 0
//   error              none
//   source             Torrance and Sparrow (1967); Cook and Torrance (1982)
float fr_masking_v_cavity(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v) {
    return min(1.0, 2.0 * n_dot_h * min(n_dot_l, n_dot_v) / v_dot_h);
}

// Masking that cancels the divisor of the BRDF.
//
//   formula            G = (N.L)(N.V)/(V.H)^2
//   v_dot_h            cosine of eye and unit half vector, at least (N.L + N.V)/2 as of any
//                      directions
//   error              from half of fr_masking_v_cavity to all of it, which it is in the mirror
//                      direction; facerender plan tells what that makes in a scene
//   source             Kelemen and Szirmay-Kalos (2001); for skin: GPU Gems 3, chapter 14 (2007)
float fr_masking_kelemen(float v_dot_h, float n_dot_l, float n_dot_v) {
    float inverse = 1.0 / v_dot_h;  // whose square may overflow
    return n_dot_l * inverse * (n_dot_v * inverse);
}

#endif
