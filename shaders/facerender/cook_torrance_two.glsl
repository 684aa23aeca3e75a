// Cook-Torrance specular BRDF with two lobes that share half vector, Fresnel term and masking.
// Examples: a broad and a sharp lobe of skin, or a sharp lobe of oil or sweat on skin.
//
//   formula:  F G (w D(m0) + (1 - w) D(m1))/(pi (N.L)(N.V)), with F, G and D of cook_torrance.glsl
//   n, l, v:  Unit vectors: normal, direction to the light, direction to the camera.
//   m0, m1:   Roughness of the two lobes: RMS slopes, in the domain of the lobe (FR_LOBE).
//   weight:   Fraction w of the first lobe, in [0, 1]; the second lobe has the fraction 1 - w.
//   f0:       Fresnel reflectance at normal incidence, in [0, 1).
//   unit:     1/sr, for a specular weight ks = 1; includes 1/pi, excludes N.L
//   returns:  See cook_torrance.glsl.
//   error:    w times the error of fr_cook_torrance at m0, plus 1 - w times the error of
//             fr_cook_torrance at m1.
//   source:   Jimenez et al. (2015), "Next-generation character rendering", GDC (two skin lobes).
#ifndef FR_COOK_TORRANCE_TWO_GLSL
#define FR_COOK_TORRANCE_TWO_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"

// Cook-Torrance specular BRDF with two lobes and the terms that the arguments select.
// Programs with different terms per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl for both lobes, a
//             constant that the compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes
//             available.
//   fresnel:  Replaces FR_FRESNEL: FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   masking:  Replaces FR_MASKING: FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
float fr_cook_torrance_two_terms(
    vec3 n, vec3 l, vec3 v, float m0, float m1, float weight, float f0,
    int lobe, int fresnel, int masking
) {
    float n_dot_l = clamp(dot(n, l), 0.0, 1.0);
    float n_dot_v = clamp(dot(n, v), 0.0, 1.0);
    vec3 h = l + v;  // Not normalised: V.H = |h|/2.
    float n_dot_h = n_dot_l + n_dot_v;
    vec2 slope = vec2(FR_SLOPE(m0), FR_SLOPE(m1));
    vec2 inverse_m2 = 1.0 / (slope * slope + FR_FLOOR);
    vec2 lobes;
    float v_dot_h;
    float masked_over;  // G/((N.L)(N.V)), times 1/c^4 for the exact lobes.
#if FR_COMPILED_LOBE == 1 || FR_COMPILED_LOBE == 91
    if (lobe == FR_LOBE_EXACT) {
        vec2 squares = fr_half_vector(n, h, n_dot_h);
        vec2 masked = fr_masking_of(n_dot_h, squares.x, n_dot_l, n_dot_v, masking);
        float inverse = 1.0 / (masked.y * (n_dot_h * n_dot_h + FR_FLOOR));
        float tan2 = squares.y * (masked.y * inverse);
        vec2 x = (FR_LOG2_E * tan2) * inverse_m2;
        lobes = vec2(exp2(-x.x), exp2(-x.y));
        masked_over = (tan2 + 1.0) * (masked.x * inverse);
        v_dot_h = 0.5 * sqrt(squares.x);
    } else
#endif
    {
        float h_dot_h = fr_half_vector_square(h);
        vec2 masked = fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, masking);
        float inverse_length = inversesqrt(h_dot_h);
        float c = n_dot_h * inverse_length;
        slope = max(slope, vec2(FR_MIN_SLOPE));
        lobes.x = fr_lobe_with_inverse_m2(c, slope.x, inverse_m2.x, FR_K_COOK_TORRANCE, lobe);
        lobes.y = fr_lobe_with_inverse_m2(c, slope.y, inverse_m2.y, FR_K_COOK_TORRANCE, lobe);
        masked_over = masked.x / (masked.y * h_dot_h);
        v_dot_h = 0.5 * h_dot_h * inverse_length;
    }
    // Do not use mix(): if a driver computes it as x + a (y - x), a high lobe of weight 0 cancels
    // the digits of the other lobe.
    vec2 shares = vec2(weight * inverse_m2.x, inverse_m2.y - weight * inverse_m2.y);
    float value = dot(shares, lobes) * masked_over;
    return value * fr_fresnel_times(0.25 / FR_PI, f0, v_dot_h, fresnel);
}

// Cook-Torrance specular BRDF with two lobes and the terms that the host's macros select.
float fr_cook_torrance_two(
    vec3 n, vec3 l, vec3 v, float m0, float m1, float weight, float f0
) {
    return fr_cook_torrance_two_terms(
        n, l, v, m0, m1, weight, f0, FR_DEFAULT_LOBE, FR_FRESNEL, FR_MASKING);
}

#endif

// These files end with comparisons of the macros, which an include guard must not skip.
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"
