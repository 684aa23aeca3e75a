// Cosine-power lobe.
//
//   formula c^n, n = 2/m^2 - k
//   c       cosine of the angle between normal and half vector, in [0, 1]; below 1e-30 it counts as
//           that: 0 has no logarithm
//   m       rms slope, from 1e-4 to below 0.707 for Cook-Torrance, to 2 for Ward; beyond, n < 0
//           counts as 0, and the result is finite without meaning
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   in % of the peak (tests/test_lobes.py), for m = 0.1, 0.2, 0.3, 0.4, 0.5, 0.6:
//           Cook-Torrance  0.28, 1.26, 3.42, 8.00, 17.8, 39.7;
//           Ward           0.27, 1.07, 2.37, 4.11, 6.25, 8.70
//   source  Romanyuk et al. (2020), section 3: the first step
#ifndef FR_LOBE_COSINE_GLSL
#define FR_LOBE_COSINE_GLSL

#include "../constants.glsl"

// Power of a cosine.
//
//   formula c^n
//   n       exponent; below 0 it counts as 0
//   error   of the formula none; as an approximation of E/c^k see fr_lobe_cosine
float fr_lobe_power(float c, float n) {
    return exp2(max(n, 0.0) * log2(clamp(c, 1e-30, 1.0)));
}

// Cosine-power lobe.
float fr_lobe_cosine(float c, float m, int k) {
    return fr_lobe_power(c, 2.0 / (FR_SLOPE(m) * FR_SLOPE(m)) - float(k));
}

#endif
