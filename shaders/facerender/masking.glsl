// Masking and shadowing of microfacets. The host chooses the one that fr_cook_torrance has within
// its one division: #define FR_MASKING FR_MASKING_KELEMEN, or FR_MASKING_NONE, which is 1 and lets
// the BRDF grow as 1/(N.V) towards the silhouette. Default: V-cavities.
//
//   formula            G/((N.L)(N.V)) = x/(y h.h), of the chosen one
//   n_dot_h, h_dot_h   dot(n, h) and dot(h, h) of h = l + v, which keeps its length
//   n_dot_l, n_dot_v   cosines of light and eye, in [-1, 1]
//   masking            FR_MASKING_V_CAVITY, _KELEMEN, _NONE, a constant
//   unit               none; x >= 0, and 0 where a cosine is not above 0 (with FR_MASKING_KELEMEN
//                      and _NONE, FR_MIN_COSINE); y > 0
//   error              of each: see masking/*.glsl
//   source             of each: see there
#ifndef FR_MASKING_GLSL
#define FR_MASKING_GLSL

#include "constants.glsl"
#include "masking/v_cavity.glsl"
#include "masking/kelemen.glsl"

#define FR_MASKING_V_CAVITY 0
#define FR_MASKING_KELEMEN 1
#define FR_MASKING_NONE 2

#ifndef FR_MASKING
#define FR_MASKING FR_MASKING_V_CAVITY
#endif

// Masking over the divisor of a BRDF, as numerator and denominator, of the kind that the caller
// names by a constant.
vec2 fr_masking_of(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v, int masking) {
    if (masking == FR_MASKING_NONE) return vec2(min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? h_dot_h : 0.0, abs(n_dot_l * n_dot_v) + FR_FLOOR);
    if (masking == FR_MASKING_KELEMEN) return fr_masking_kelemen_ratio(n_dot_l, n_dot_v);
    return fr_masking_v_cavity_ratio(n_dot_h, h_dot_h, n_dot_l, n_dot_v);
}

#endif
