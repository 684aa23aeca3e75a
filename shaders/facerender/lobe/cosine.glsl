// Cosine-power lobe c^n with n = 2/m^2 - k: the first step of Romanyuk et al. (2020), section 3.
//
//   c       cosine of the angle between normal and half vector, in [0, 1]
//   m       rms slope, in [1e-4, sqrt(2/k)): n > 0, so m < 0.707 for Cook-Torrance
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   in % of the peak, Cook-Torrance: 0.28 at m = 0.1, 1.26 at 0.2, 3.42 at 0.3, 8.0 at
//           0.4, 17.8 at 0.5, 39.7 at 0.6 (tests/test_lobes.py)
#ifndef FR_LOBE_COSINE_GLSL
#define FR_LOBE_COSINE_GLSL

float fr_lobe_cosine(float c, float m, int k) {
    float n = 2.0 / (m * m) - float(k);
    float x = min(c, 1.0);
    return x > 0.0 ? exp2(n * log2(x)) : 0.0;
}

#endif
