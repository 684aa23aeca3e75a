// g-power lobes D4, D8 and D16: a factor linear in c, clamped and raised to the power g.
// The clamp is necessary: an even power makes a negative base positive. Without a clamp, as
// published by Romanyuk et al. (2020), D16 reaches 2.3e4 times its peak at m = 0.2 and 90 degrees.
//
//   formula:  max((n/g)(c - 1) + 1, 0)^g, n = 2/m^2 - k
//   c:        Cosine of the angle between normal and half vector, in [0, 1].
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 0.707) for Cook-Torrance, in
//             [1e-4, 2] for Ward. Beyond this domain the result is finite but meaningless.
//   k:        Power of 1/c in the lobe: FR_K_COOK_TORRANCE or FR_K_WARD.
//   g:        4, 8 or 16.
//   unit:     none
//   returns:  1 at c = 1, the peak; the caller multiplies by the scale of the model.
//   error:    Largest difference from the exact lobe in % of the peak (tests/test_lobes.py),
//             for m = 0.1, 0.2, 0.3, 0.4, 0.5, 0.6:
//             Cook-Torrance  g = 4:  6.96, 5.54, 2.46, 4.18, 17.8, 45.4;
//                            g = 8:  3.11, 1.68, 1.43, 7.79, 20.9, 46.9;
//                            g = 16: 1.31, 0.13, 3.21, 9.50, 22.3, 47.6;
//             Ward           g = 4:  6.98, 5.78, 3.79, 1.12, 2.55, 6.64;
//                            g = 8:  3.13, 1.92, 0.12, 2.83, 6.25, 10.25;
//                            g = 16: 1.32, 0.12, 1.88, 4.60, 7.99, 11.9.
//   source:   Romanyuk et al. (2020); Lyon (1993) for the clamp.
#ifndef FR_LOBE_G_POWER_GLSL
#define FR_LOBE_G_POWER_GLSL

#include "../constants.glsl"

// Factor linear in c, clamped and raised to a power: the g-power lobe with free g and steepness.
//
//   formula:    max(1 - steepness (1 - c), 0)^g
//   steepness:  Steepness of the linear factor, >= 0; (2/m^2 - k)/g gives D4, D8 and D16.
//   g:          Power, 1 to 31, a constant.
//   error:      The formula is exact. Its difference from E/c^k depends on the steepness, which
//               facerender plan fits to a given m.
//   source:     Lyon (1993).
float fr_lobe_clamped_power(float c, float steepness, int g) {
    // Do not write steepness (c - 1) + 1: Mesa expands this product and loses the digits of small
    // angles.
    float p = clamp(1.0 - steepness * (1.0 - c), 0.0, 1.0);
    float p2 = p * p;
    float p4 = p2 * p2;
    float p8 = p4 * p4;
    float power = (g & 1) != 0 ? p : 1.0;
    if ((g & 2) != 0) power *= p2;
    if ((g & 4) != 0) power *= p4;
    if ((g & 8) != 0) power *= p8;
    if ((g & 16) != 0) power *= p8 * p8;
    return power;
}

// g-power lobe D4, D8 or D16, for g = 4, 8 or 16.
float fr_lobe_g_power(float c, float m, int k, int g) {
    float n = 2.0 / (FR_SLOPE(m) * FR_SLOPE(m)) - float(k);
    return fr_lobe_clamped_power(c, n / float(g), g);
}

#endif
