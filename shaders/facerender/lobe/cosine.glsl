// Cosine-power lobe.
//
//   formula:  c^n, n = 2/m^2 - k
//   c:        Cosine of the angle between normal and half vector, in [0, 1]; clamped to at least
//             1e-30, because 0 has no logarithm.
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 0.707) for Cook-Torrance, in
//             [1e-4, 2] for Ward. Beyond this domain the negative n is clamped to 0; the result is
//             finite but meaningless.
//   k:        Power of 1/c in the lobe: FR_K_COOK_TORRANCE or FR_K_WARD.
//   unit:     none
//   returns:  1 at c = 1, the peak; the caller multiplies by the scale of the model.
//   error:    Largest difference from the exact lobe in % of the peak (tests/test_lobes.py),
//             for m = 0.1, 0.2, 0.3, 0.4, 0.5, 0.6:
//             Cook-Torrance  0.28, 1.26, 3.42, 8.00, 17.8, 39.7;
//             Ward           0.27, 1.07, 2.37, 4.11, 6.25, 8.70.
//   source:   Romanyuk et al. (2020), section 3: first step of their approximation.
#ifndef FR_LOBE_COSINE_GLSL
#define FR_LOBE_COSINE_GLSL

#include "../constants.glsl"

// Power of a cosine.
//
//   formula:  c^n
//   n:        Exponent; clamped to at least 0.
//   error:    The formula is exact. For the difference between c^n and E/c^k see fr_lobe_cosine.
float fr_lobe_power(float c, float n) {
    return exp2(max(n, 0.0) * log2(clamp(c, 1e-30, 1.0)));
}

// Cosine-power lobe.
float fr_lobe_cosine(float c, float m, int k) {
    return fr_lobe_power(c, 2.0 / (FR_SLOPE(m) * FR_SLOPE(m)) - float(k));
}

#endif
