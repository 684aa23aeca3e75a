// Exact lobe, for hosts that build their own BRDF.
// The BRDFs of the library do not call these functions but compute the lobe together with the
// other factors in one division: E = 2^-x with x = tan^2(gamma)/(m^2 ln 2), and 1/c^2 = x m^2 ln 2
// + 1.
//
//   formula:  E/c^k, E = exp(-tan^2(gamma)/m^2)
//   x:        tan^2(gamma)/m^2, >= 0.
//   tan2:     Squared tangent of the angle gamma between normal and half vector, >= 0;
//             half_vector.glsl computes it without normalisation and without acos.
//   c:        Cosine of gamma, in [0, 1].
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 2].
//   k:        Power of 1/c in the lobe: FR_K_COOK_TORRANCE or FR_K_WARD.
//   unit:     none
//   returns:  1 at gamma = 0; the caller multiplies by the scale of the model.
//   error:    The formula is exact. In float32 a relative error e of tan2 becomes a relative error
//             e tan2/m^2 of the lobe.
//   source:   Beckmann and Spizzichino (1963), as in Cook and Torrance (1982, k = 4) and Ward
//             (1992, eq. 4, k = 0).
#ifndef FR_LOBE_EXACT_GLSL
#define FR_LOBE_EXACT_GLSL

#include "../constants.glsl"

// Upper limit of tan2. It changes no value: exp(-1e6/m^2) is 0 in float32 for every m <= 2. Without
// the limit (1 + tan2)^2 overflows, and 0 times infinity is NaN.
#define FR_MAX_TAN2 1e6

// Slope factor E of the exact lobe.
//
//   formula:  E = exp(-x)
//   returns:  1 at x = 0.
float fr_slope_factor(float x) {
    return exp2(-FR_LOG2_E * x);
}

// Exact lobe from tan^2(gamma), which keeps the digits of small angles, unlike c.
float fr_lobe_exact_tan2(float tan2, float m, int k) {
    float t = clamp(tan2, 0.0, FR_MAX_TAN2);
    float e = fr_slope_factor(t / (FR_SLOPE(m) * FR_SLOPE(m)));
    if (k == FR_K_COOK_TORRANCE) {
        float sec2 = 1.0 + t;
        e *= sec2 * sec2;
    }
    return e;
}

float fr_lobe_exact(float c, float m, int k) {
    float x = clamp(c, 1e-3, 1.0);  // c = 1e-3 corresponds to FR_MAX_TAN2.
    return fr_lobe_exact_tan2((1.0 - x) * (1.0 + x) / (x * x), m, k);
}

#endif
