// Lobe that the macro FR_LOBE or the argument `lobe` selects at compile time. FR_LOBE is the exact
// lobe by default.
//
//   formula:  E/c^k, E = exp(-tan^2(gamma)/m^2), or its approximation by the selected lobe
//   c:        Cosine of the angle between normal and half vector, in [0, 1].
//   m:        Roughness: RMS slope of the microfacets, in the domain of the selected lobe.
//   k:        Power of 1/c in the lobe: FR_K_COOK_TORRANCE or FR_K_WARD.
//   lobe:     FR_LOBE_EXACT or another macro below, a constant that the compiler folds. Only the
//             lobe that FR_LOBE names is available: the macros of other lobes are undefined, and
//             for other numbers the functions return 0. #define FR_LOBE FR_LOBE_EVERY makes all
//             lobes available; functions without this argument then use the exact lobe.
//   unit:     none
//   returns:  1 at c = 1; the caller multiplies by the scale of the model.
//   error:    See lobe/*.glsl.
//   source:   See lobe/*.glsl.
//
// To use your own lobe, write two lines before the include: the declaration
// float my_lobe(float c, float m, int k); and #define FR_LOBE_FUNCTION my_lobe.
#ifndef FR_LOBE_GLSL
#define FR_LOBE_GLSL

#include "constants.glsl"

#define FR_LOBE_EXACT 1
#define FR_LOBE_COSINE 2
#define FR_LOBE_D4 4
#define FR_LOBE_D8 8
#define FR_LOBE_D16 16
#define FR_LOBE_FITTED 3
#define FR_LOBE_FITTED_FINE 5
#define FR_LOBE_G_POWER 6
#define FR_LOBE_OWN 90
#define FR_LOBE_EVERY 91

// FR_LOBE is a number here, because Babylon.js compares macros as text and does not expand names.
#if defined(FR_LOBE_FUNCTION) && !defined(FR_LOBE)
#define FR_LOBE 90
#endif
#ifndef FR_LOBE
#define FR_LOBE 1
#endif

// Number of the lobe whose code this file contains. All files of a program share this code, so a
// later include with another FR_LOBE is an error (end of this file). This macro is always a number.
#if FR_LOBE == FR_LOBE_EXACT
#define FR_COMPILED_LOBE 1
#elif FR_LOBE == FR_LOBE_COSINE
#define FR_COMPILED_LOBE 2
#elif FR_LOBE == FR_LOBE_D4
#define FR_COMPILED_LOBE 4
#elif FR_LOBE == FR_LOBE_D8
#define FR_COMPILED_LOBE 8
#elif FR_LOBE == FR_LOBE_D16
#define FR_COMPILED_LOBE 16
#elif FR_LOBE == FR_LOBE_FITTED
#define FR_COMPILED_LOBE 3
#elif FR_LOBE == FR_LOBE_FITTED_FINE
#define FR_COMPILED_LOBE 5
#elif FR_LOBE == FR_LOBE_G_POWER
#define FR_COMPILED_LOBE 6
#elif FR_LOBE == FR_LOBE_OWN
#define FR_COMPILED_LOBE 90
#elif FR_LOBE == FR_LOBE_EVERY
#define FR_COMPILED_LOBE 91
#else
#error FR_LOBE is none of 1 FR_LOBE_EXACT, 2 FR_LOBE_COSINE, 4 FR_LOBE_D4, 8 FR_LOBE_D8, 16 FR_LOBE_D16, 3 FR_LOBE_FITTED, 5 FR_LOBE_FITTED_FINE, 6 FR_LOBE_G_POWER, 90 FR_LOBE_OWN, 91 FR_LOBE_EVERY: use the number if your host compares macros as text
#endif
#if FR_LOBE == FR_LOBE_OWN && !defined(FR_LOBE_FUNCTION)
#error FR_LOBE_OWN needs FR_LOBE_FUNCTION: define it as the name of your lobe function
#endif
#if FR_LOBE == FR_LOBE_EVERY
#define FR_DEFAULT_LOBE FR_LOBE_EXACT
#else
#define FR_DEFAULT_LOBE FR_LOBE
#endif

#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
#include "lobe/exact.glsl"
#endif
#if FR_LOBE == FR_LOBE_COSINE || FR_LOBE == FR_LOBE_EVERY
#include "lobe/cosine.glsl"
#endif
#if FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_D16 || FR_LOBE == FR_LOBE_G_POWER || FR_LOBE == FR_LOBE_EVERY
#include "lobe/g_power.glsl"
#endif
#if FR_LOBE == FR_LOBE_FITTED || FR_LOBE == FR_LOBE_FITTED_FINE || FR_LOBE == FR_LOBE_EVERY
#include "lobe/fitted.glsl"
#endif

// Power (1 to 31) and steepness of FR_LOBE_G_POWER. The host sets both; the default is D8.
#ifndef FR_G
#define FR_G 8
#endif
#ifndef FR_STEEPNESS
#define FR_STEEPNESS(m, k) ((2.0 / ((m) * (m)) - float(k)) / float(FR_G))
#endif

// Lobe that the argument `lobe` selects, for callers, such as a BRDF, that already have 1/m^2.
//
//   inverse_m2:  1/m^2.
float fr_lobe_with_inverse_m2(float c, float m, float inverse_m2, int k, int lobe) {
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_EXACT) return fr_lobe_exact(c, m, k);
#else
#undef FR_LOBE_EXACT
#endif
#if FR_LOBE == FR_LOBE_COSINE || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_COSINE) return fr_lobe_power(c, 2.0 * inverse_m2 - float(k));
#else
#undef FR_LOBE_COSINE
#endif
#if FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D4) return fr_lobe_clamped_power(c, 0.5 * inverse_m2 - 0.25 * float(k), 4);
#else
#undef FR_LOBE_D4
#endif
#if FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D8) return fr_lobe_clamped_power(c, 0.25 * inverse_m2 - 0.125 * float(k), 8);
#else
#undef FR_LOBE_D8
#endif
#if FR_LOBE == FR_LOBE_D16 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D16) return fr_lobe_clamped_power(c, 0.125 * inverse_m2 - 0.0625 * float(k), 16);
#else
#undef FR_LOBE_D16
#endif
#if FR_LOBE == FR_LOBE_FITTED || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_FITTED) return fr_lobe_fitted_with_inverse_m2(c, m, inverse_m2, k);
#else
#undef FR_LOBE_FITTED
#endif
#if FR_LOBE == FR_LOBE_FITTED_FINE || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_FITTED_FINE) return fr_lobe_fitted_fine_with_inverse_m2(c, m, inverse_m2, k);
#else
#undef FR_LOBE_FITTED_FINE
#endif
#if FR_LOBE == FR_LOBE_G_POWER || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_G_POWER) return fr_lobe_clamped_power(c, FR_STEEPNESS(FR_SLOPE(m), k), FR_G);
#else
#undef FR_LOBE_G_POWER
#endif
#ifdef FR_LOBE_FUNCTION
    if (lobe == FR_LOBE_OWN) return FR_LOBE_FUNCTION(clamp(c, 0.0, 1.0), m, k);
#endif
    return 0.0;
}

// Lobe that the argument `lobe` selects.
float fr_lobe_of(float c, float m, int k, int lobe) {
    return fr_lobe_with_inverse_m2(c, m, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k, lobe);
}

// Lobe that the macro FR_LOBE selects, for example by #define FR_LOBE FR_LOBE_D16.
float fr_lobe(float c, float m, int k) {
    return fr_lobe_of(c, m, k, FR_DEFAULT_LOBE);
}

#endif

#if FR_LOBE == FR_COMPILED_LOBE
#else
#error FR_LOBE differs from its value at the first include: define FR_LOBE FR_LOBE_EVERY and call the functions that end in _terms
#endif
