// Masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
// The macro FR_MASKING selects the term of fr_cook_torrance: #define FR_MASKING FR_MASKING_KELEMEN.
// The default is FR_MASKING_V_CAVITY. With FR_MASKING_NONE, G = 1; the BRDF then grows as 1/(N.V)
// towards the silhouette.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h) for the selected term
//   n_dot_h, h_dot_h:  dot(n, h) and dot(h, h) for the half vector h = l + v, not normalised.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   masking:           FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
//   unit:              none
//   returns:           x >= 0 and y > 0. x is 0 if N.L or N.V is at most 0. With FR_MASKING_KELEMEN
//                      or FR_MASKING_NONE, x is 0 if N.L or N.V is at most FR_MIN_COSINE.
//   error:             See masking/*.glsl.
//   source:            See masking/*.glsl.
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

// Number of FR_MASKING, for the comparison at the end of this file. Undefined if FR_MASKING is a name
// and the host compares macros as text, as Babylon.js does.
#if FR_MASKING == FR_MASKING_V_CAVITY
#define FR_COMPILED_MASKING 0
#elif FR_MASKING == FR_MASKING_KELEMEN
#define FR_COMPILED_MASKING 1
#elif FR_MASKING == FR_MASKING_NONE
#define FR_COMPILED_MASKING 2
#endif

// Masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h. The
// argument `masking` selects the term.
vec2 fr_masking_of(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v, int masking) {
    if (masking == FR_MASKING_NONE) return vec2(min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? h_dot_h : 0.0, abs(n_dot_l * n_dot_v) + FR_FLOOR);
    if (masking == FR_MASKING_KELEMEN) return fr_masking_kelemen_ratio(n_dot_l, n_dot_v);
    return fr_masking_v_cavity_ratio(n_dot_h, h_dot_h, n_dot_l, n_dot_v);
}

#endif

#if !defined(FR_COMPILED_MASKING) || FR_MASKING == FR_COMPILED_MASKING
#else
#error FR_MASKING differs from its value at the first include: call the functions that end in _terms
#endif
