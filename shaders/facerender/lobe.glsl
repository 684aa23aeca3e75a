// The lobe that the host chose at compile time: #define FR_LOBE FR_LOBE_D16. Default: exact.
//
//   formula E/c^k, E = exp(-tan^2(gamma)/m^2), or what the chosen lobe puts in its place
//   c       cosine of the angle between normal and half vector, in [0, 1]
//   m       rms slope, in the domain of the chosen lobe
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   of the chosen lobe: see lobe/*.glsl
//   source  see lobe/*.glsl
#ifndef FR_LOBE_GLSL
#define FR_LOBE_GLSL

#include "facerender/constants.glsl"

#define FR_LOBE_EXACT 1
#define FR_LOBE_COSINE 2
#define FR_LOBE_FITTED 3
#define FR_LOBE_D4 4
#define FR_LOBE_FITTED_FINE 5
#define FR_LOBE_G_POWER 6
#define FR_LOBE_D8 8
#define FR_LOBE_D16 16

#ifndef FR_LOBE
#define FR_LOBE FR_LOBE_EXACT
#endif

#if FR_LOBE == FR_LOBE_EXACT
#include "facerender/lobe/exact.glsl"
#elif FR_LOBE == FR_LOBE_COSINE
#include "facerender/lobe/cosine.glsl"
#elif FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_D16 || FR_LOBE == FR_LOBE_G_POWER
#include "facerender/lobe/g_power.glsl"
#elif FR_LOBE == FR_LOBE_FITTED || FR_LOBE == FR_LOBE_FITTED_FINE
#include "facerender/lobe/fitted.glsl"
#else
#error "FR_LOBE is none of FR_LOBE_EXACT, _COSINE, _D4, _D8, _D16, _FITTED, _FITTED_FINE, _G_POWER"
#endif

// With FR_LOBE_G_POWER the power, in 1 to 31, and the steepness that the host fitted; by default
// those of D8.
#ifndef FR_G
#define FR_G 8
#endif
#ifndef FR_STEEPNESS
#define FR_STEEPNESS(m, k) ((2.0 / ((m) * (m)) - float(k)) / float(FR_G))
#endif

float fr_lobe(float c, float m, int k) {
#if FR_LOBE == FR_LOBE_EXACT
    return fr_lobe_exact(c, m, k);
#elif FR_LOBE == FR_LOBE_COSINE
    return fr_lobe_cosine(c, m, k);
#elif FR_LOBE == FR_LOBE_FITTED
    return fr_lobe_fitted(c, m, k);
#elif FR_LOBE == FR_LOBE_FITTED_FINE
    return fr_lobe_fitted_fine(c, m, k);
#elif FR_LOBE == FR_LOBE_G_POWER
    return fr_lobe_clamped_power(c, FR_STEEPNESS(FR_SLOPE(m), k), FR_G);
#else
    return fr_lobe_g_power(c, m, k, FR_LOBE);
#endif
}

#endif
