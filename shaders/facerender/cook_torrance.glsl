// Cook-Torrance specular BRDF, with the lobe, the Fresnel term (FR_FRESNEL) and the masking term
// (FR_MASKING) that the host chose.
//
//   formula   F G D/(pi (N.L)(N.V)), D = E/(4 m^2 c^4), E = exp(-tan^2(gamma)/m^2)
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope, in the domain of the chosen lobe (FR_LOBE)
//   f0        Fresnel reflectance at normal incidence, in [0, 1)
//   unit      1/sr, for a specular weight ks = 1; N.L is not included, 1/pi is
//   result    finite and >= 0; exactly 0 where N.L or N.V is not above FR_MIN_COSINE
//   error     that of the lobe; float32 adds, of what the lobe's highest value gives in the same
//             directions, 1e-5 + 2e-7/(N.L) + 2e-7/(N.V) and, with e = 4e-7 (1 + 1/(N.L + N.V)),
//             e/m for the exact lobe, e/m^2 for the others and where FR_SMALL_SLOPE is 0 (the
//             cosine power: 7e-7/m^2 more, from log2; FR_STEEPNESS a/m^2 - b: e a g/(2 m^2))
//   source    Cook and Torrance (1982), in the normalisation used since: Walter et al. (2007),
//             F G D'/(4 (N.L)(N.V)) with D' = 4 D/pi
#ifndef FR_COOK_TORRANCE_GLSL
#define FR_COOK_TORRANCE_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"

// Cook-Torrance specular BRDF with terms of its own, for programs that treat lights differently, or
// have two lobes.
//
//   lobe      FR_LOBE_EXACT or another macro of lobe.glsl, in place of FR_LOBE; all are there with
//             #define FR_LOBE FR_LOBE_EVERY; a constant, which the compiler folds
//   fresnel   FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, in place of FR_FRESNEL; a constant
//   masking   FR_MASKING_V_CAVITY, _KELEMEN or _NONE, in place of FR_MASKING; a constant
float fr_cook_torrance_terms(
    vec3 n, vec3 l, vec3 v, float m, float f0, int lobe, int fresnel, int masking
) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    vec3 h = l + v;  // keeps its length: V.H = |h|/2
    float n_dot_h = n_dot_l + n_dot_v;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    float m2 = slope * slope;
    vec2 squares = vec2(dot(h, h), 0.0);
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_EXACT) squares = fr_half_vector(n, h, n_dot_h);
#endif
    float h_dot_h = squares.x;
    vec2 masked = fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, masking);

    // 4 D G/((N.L)(N.V)); for the exact lobe, whose 1/c^2 is (h.h)/(N.h)^2, with a single division.
    float value;
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_EXACT) {
        float inverse = 1.0 / (masked.y * (n_dot_h * n_dot_h) * m2);
        float sec2 = h_dot_h * m2 * (masked.y * inverse);
        value = fr_slope_factor(squares.y * (masked.y * inverse)) * sec2 * (masked.x * inverse);
    } else
#endif
    {
        float inverse = 1.0 / (masked.y * h_dot_h);
        float c = n_dot_h * sqrt(h_dot_h) * (masked.y * inverse);
        value = fr_lobe_of(c, slope, FR_K_COOK_TORRANCE, lobe) / m2 * (masked.x * inverse);
    }
    float reflectance = fr_fresnel_of(f0, 0.5 * sqrt(h_dot_h), fresnel);
    bool above = n_dot_l > FR_MIN_COSINE && n_dot_v > FR_MIN_COSINE;
    return above ? reflectance * value * (0.25 / FR_PI) : 0.0;
}

// Cook-Torrance specular BRDF, with the terms that the host chose.
float fr_cook_torrance(vec3 n, vec3 l, vec3 v, float m, float f0) {
    return fr_cook_torrance_terms(n, l, v, m, f0, FR_DEFAULT_LOBE, FR_FRESNEL, FR_MASKING);
}

#endif
