// Fitted lobes: polynomials in 1 - c, clamped and raised to a power, that approximate E/c^k.
// fr_lobe_fitted is a cubic to the power 5, fr_lobe_fitted_fine a quartic to the power 8. Both are
// best uniform approximations over all angles and slopes under three conditions. The polynomial
// decreases monotonically; it is exact at c = 1; the numerators of its coefficients are cubic in
// m^2 for fr_lobe_fitted, quartic in m^2 for fr_lobe_fitted_fine.
//
//   formula:  max(1 + a1 u + a2 u^2 + ..., 0)^g, u = 1 - c
//   c:        Cosine of the angle between normal and half vector, in [0, 1].
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 0.7] for Cook-Torrance, in
//             [1e-4, 1] for Ward; larger values are clamped.
//   k:        Power of 1/c in the lobe: FR_K_COOK_TORRANCE or FR_K_WARD.
//   unit:     none
//   returns:  1 at c = 1, the peak; the caller multiplies by the scale of the model.
//   error:    Largest difference from the exact lobe over all angles and the domain of m, in % of
//             the peak (tests/test_lobes.py).
//   source:   tools/fits/lobes.py computes the constants; the clamped power is from Lyon (1993).
//
// If all fragments share one m, a host may define the coefficients before the include:
// #define FR_FITTED_COEFFICIENTS(m, k) vec3(...)
// #define FR_FITTED_FINE_COEFFICIENTS(m, k) vec4(...)
// The module facerender.lobes and the command facerender shaders flatten --m compute the
// coefficients. Constant coefficients save up to a third of the cost of the specular term
// (docs/measurements/trade.md).
#ifndef FR_LOBE_FITTED_GLSL
#define FR_LOBE_FITTED_GLSL

#include "../constants.glsl"

#ifndef FR_FITTED_COEFFICIENTS
#define FR_FITTED_COEFFICIENTS(m, k) fr_lobe_fitted_numerators(m, k)
#define FR_FITTED_VARIABLE(u, inverse_m2, k) fr_lobe_fitted_variable(u, inverse_m2, k)
#else
#define FR_FITTED_VARIABLE(u, inverse_m2, k) (u)
#endif

#ifndef FR_FITTED_FINE_COEFFICIENTS
#define FR_FITTED_FINE_COEFFICIENTS(m, k) fr_lobe_fitted_fine_numerators(m, k)
#define FR_FITTED_FINE_VARIABLE(u, inverse_m2, k) fr_lobe_fitted_variable(u, inverse_m2, k)
#else
#define FR_FITTED_FINE_VARIABLE(u, inverse_m2, k) (u)
#endif

// Variable of the polynomials, u/m^2, with m clamped to the lobe's domain.
//
//   formula:     u/m^2
//   u:           1 - c, in [0, 1].
//   inverse_m2:  1/m^2; clamped to at least 1/m^2 at the largest m of the domain.
//   returns:     >= 0.
//   error:       The formula is exact.
float fr_lobe_fitted_variable(float u, float inverse_m2, int k) {
    return u * max(inverse_m2, k == FR_K_COOK_TORRANCE ? 1.0 / 0.49 : 1.0);
}

// Numerators of the polynomial coefficients in fr_lobe_fitted.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6; each is a cubic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted.
vec3 fr_lobe_fitted_numerators(float m, int k) {
    float w = FR_SLOPE(m) * FR_SLOPE(m);
    vec3 a;
    if (k == FR_K_COOK_TORRANCE) {
        w = min(w, 0.49);
        a = vec3(-0.39700398, 0.07498738, -0.0060935954)
          + w * (vec3(0.6738297, -0.58629695, 0.0026217349)
          + w * (vec3(0.71936623, -1.6754473, 1.1615276)
          + w * vec3(-1.0351326, 4.1195317, -5.0082767)));
    } else {
        w = min(w, 1.0);
        a = vec3(-0.40198098, 0.083526049, -0.010091574)
          + w * (vec3(-0.020725706, -0.49894731, 0.08771378)
          + w * (vec3(0.077372606, -0.42975123, 0.18764888)
          + w * vec3(-0.067503089, 0.51304211, -1.5410764)));
    }
    return a;
}

// Coefficients of fr_lobe_fitted, for hosts that define FR_FITTED_COEFFICIENTS.
//
//   formula:  a1, a2, a3; each a_i m^(2i) is a cubic in m^2
//   returns:  Factors of u, u^2, u^3.
//   error:    See fr_lobe_fitted.
vec3 fr_lobe_fitted_coefficients(float m, int k) {
    float r = fr_lobe_fitted_variable(1.0, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k);
    return fr_lobe_fitted_numerators(m, k) * vec3(r, r * r, r * r * r);
}

// Fitted lobe for callers that already have 1/m^2: the fifth power of a clamped cubic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
float fr_lobe_fitted_with_inverse_m2(float c, float m, float inverse_m2, int k) {
    vec3 a = FR_FITTED_COEFFICIENTS(m, k);
    float v = FR_FITTED_VARIABLE(1.0 - c, inverse_m2, k);
    float p = clamp(1.0 + v * (a.x + v * (a.y + v * a.z)), 0.0, 1.0);
    float p2 = p * p;
    return p2 * p2 * p;
}

// Fitted lobe: the fifth power of a clamped cubic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   error:    At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
float fr_lobe_fitted(float c, float m, int k) {
    return fr_lobe_fitted_with_inverse_m2(c, m, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k);
}

// Numerators of the polynomial coefficients in fr_lobe_fitted_fine.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6, a4 m^8; each is a quartic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted_fine.
vec4 fr_lobe_fitted_fine_numerators(float m, int k) {
    float w = FR_SLOPE(m) * FR_SLOPE(m);
    vec4 a;
    if (k == FR_K_COOK_TORRANCE) {
        w = min(w, 0.49);
        a = vec4(-0.24963107, 0.030319915, -0.0020734921, 0.0)
          + w * (vec4(0.50360702, -0.52566283, 0.15216287, -0.017956779)
          + w * (vec4(-0.013824908, 0.50565452, -0.92452698, 0.030042244)
          + w * (vec4(-0.081719136, 0.47515006, -1.4199605, 1.6944034)
          + w * vec4(0.19363848, -1.434821, 4.5145226, -5.6548034))));
    } else {
        w = min(w, 1.0);
        a = vec4(-0.24950537, 0.029811221, -0.0017648837, 0.0)
          + w * (vec4(0.0018034024, -0.38853178, 0.14142554, -0.024093986)
          + w * (vec4(-0.0076809275, 0.078399249, -0.74785186, 0.058197197)
          + w * (vec4(-0.0071770924, 0.063575568, -0.40797551, 1.0990611)
          + w * vec4(0.015975844, -0.20239128, 1.087785, -2.6305629))));
    }
    return a;
}

// Coefficients of fr_lobe_fitted_fine, for hosts that define FR_FITTED_FINE_COEFFICIENTS.
//
//   formula:  a1, a2, a3, a4; each a_i m^(2i) is a quartic in m^2
//   returns:  Factors of u, u^2, u^3, u^4.
//   error:    See fr_lobe_fitted_fine.
vec4 fr_lobe_fitted_fine_coefficients(float m, int k) {
    float r = fr_lobe_fitted_variable(1.0, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k);
    return fr_lobe_fitted_fine_numerators(m, k) * vec4(r, r * r, r * r * r, (r * r) * (r * r));
}

// Finer fitted lobe for callers that have 1/m^2: the eighth power of a clamped quartic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.04 % of the peak for both models.
float fr_lobe_fitted_fine_with_inverse_m2(float c, float m, float inverse_m2, int k) {
    vec4 a = FR_FITTED_FINE_COEFFICIENTS(m, k);
    float v = FR_FITTED_FINE_VARIABLE(1.0 - c, inverse_m2, k);
    float p = clamp(1.0 + v * (a.x + v * (a.y + v * (a.z + v * a.w))), 0.0, 1.0);
    float p2 = p * p;
    float p4 = p2 * p2;
    return p4 * p4;
}

// Finer fitted lobe: the eighth power of a clamped quartic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   error:    At most 0.04 % of the peak for both models.
float fr_lobe_fitted_fine(float c, float m, int k) {
    return fr_lobe_fitted_fine_with_inverse_m2(c, m, 1.0 / (FR_SLOPE(m) * FR_SLOPE(m)), k);
}

#endif
