// The lobe that the host chooses: at compile time, #define FR_LOBE FR_LOBE_D16, or call by call,
// with a constant that the compiler folds. Default: exact.
//
//   formula E/c^k, E = exp(-tan^2(gamma)/m^2), or what the chosen lobe puts in its place
//   c       cosine of the angle between normal and half vector, in [0, 1]
//   m       rms slope, in the domain of the chosen lobe
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   lobe    FR_LOBE_EXACT or another of the macros below, a constant. Only the lobe that FR_LOBE
//           says is there: another gives -1. With #define FR_LOBE FR_LOBE_EVERY all are there, and
//           functions without this argument have the exact one
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   of the chosen lobe: see lobe/*.glsl
//   source  see lobe/*.glsl
//
// A lobe of the host's own: declare float my_lobe(float c, float m, int k), and before the include
// #define FR_LOBE_FUNCTION my_lobe.
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

// Numbers: preprocessors that compare macros as text (Babylon.js, PlayCanvas) see through no name.
#if defined(FR_LOBE_FUNCTION) && !defined(FR_LOBE)
#define FR_LOBE 90
#endif
#ifndef FR_LOBE
#define FR_LOBE 1
#endif

#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_COSINE || FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_D16 || FR_LOBE == FR_LOBE_FITTED || FR_LOBE == FR_LOBE_FITTED_FINE || FR_LOBE == FR_LOBE_G_POWER || FR_LOBE == FR_LOBE_OWN || FR_LOBE == FR_LOBE_EVERY
#else
#error FR_LOBE is none of 1 FR_LOBE_EXACT, 2 FR_LOBE_COSINE, 4 FR_LOBE_D4, 8 FR_LOBE_D8, 16 FR_LOBE_D16, 3 FR_LOBE_FITTED, 5 FR_LOBE_FITTED_FINE, 6 FR_LOBE_G_POWER, 90 FR_LOBE_OWN, 91 FR_LOBE_EVERY: give the number where a host compares macros as text
#endif
#if FR_LOBE == FR_LOBE_OWN && !defined(FR_LOBE_FUNCTION)
#error FR_LOBE_OWN is the lobe that FR_LOBE_FUNCTION names: define it too
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

// With FR_LOBE_G_POWER the power, in 1 to 31, and the steepness that the host fitted; by default
// those of D8.
#ifndef FR_G
#define FR_G 8
#endif
#ifndef FR_STEEPNESS
#define FR_STEEPNESS(m, k) ((2.0 / ((m) * (m)) - float(k)) / float(FR_G))
#endif

// Lobe within a BRDF, which has 1/m^2 already, of the kind that the caller names by a constant.
//
//   inverse_m2  1/m^2
float fr_lobe_within(float c, float m, float inverse_m2, int k, int lobe) {
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_EXACT) return fr_lobe_exact(c, m, k);
#endif
#if FR_LOBE == FR_LOBE_COSINE || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_COSINE) return fr_lobe_power(c, 2.0 * inverse_m2 - float(k));
#endif
#if FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D4) return fr_lobe_clamped_power(c, 0.5 * inverse_m2 - 0.25 * float(k), 4);
#endif
#if FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D8) return fr_lobe_clamped_power(c, 0.25 * inverse_m2 - 0.125 * float(k), 8);
#endif
#if FR_LOBE == FR_LOBE_D16 || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_D16) return fr_lobe_clamped_power(c, 0.125 * inverse_m2 - 0.0625 * float(k), 16);
#endif
#if FR_LOBE == FR_LOBE_FITTED || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_FITTED) return fr_lobe_fitted_within(c, m, inverse_m2, k);
#endif
#if FR_LOBE == FR_LOBE_FITTED_FINE || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_FITTED_FINE) return fr_lobe_fitted_fine_within(c, m, inverse_m2, k);
#endif
#if FR_LOBE == FR_LOBE_G_POWER || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_G_POWER) return fr_lobe_clamped_power(c, FR_STEEPNESS(FR_SLOPE(m), k), FR_G);
#endif
#ifdef FR_LOBE_FUNCTION
    if (lobe == FR_LOBE_OWN) return FR_LOBE_FUNCTION(clamp(c, 0.0, 1.0), m, k);
#endif
    return -1.0;
}

// Lobe, of the kind that the caller names by a constant.
float fr_lobe_of(float c, float m, int k, int lobe) {
    return fr_lobe_within(c, m, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k, lobe);
}

// Lobe, as the host chose it: #define FR_LOBE FR_LOBE_D16.
float fr_lobe(float c, float m, int k) {
    return fr_lobe_of(c, m, k, FR_DEFAULT_LOBE);
}

#endif
