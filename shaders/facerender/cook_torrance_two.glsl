// Cook-Torrance specular BRDF with two lobes, such as a broad and a sharp one of skin, or a sharp
// one of oil or sweat on it. They share half vector, Fresnel and masking term.
//
//   formula   F G (w D(m0) + (1 - w) D(m1))/(pi (N.L)(N.V)), with F, G and D of cook_torrance.glsl
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m0, m1    rms slopes of the lobes, in the domain of the chosen lobe (FR_LOBE)
//   weight    share w of the first lobe, in [0, 1]; the second one has 1 - w
//   f0        Fresnel reflectance at normal incidence, in [0, 1)
//   unit      1/sr, for a specular weight ks = 1; N.L is not included, 1/pi is
//   result    as of cook_torrance.glsl
//   error     the sum of fr_cook_torrance's at m0, times w, and at m1, times 1 - w
//   source    Jimenez et al. (2015), "Next-generation character rendering", GDC: two lobes for skin
#ifndef FR_COOK_TORRANCE_TWO_GLSL
#define FR_COOK_TORRANCE_TWO_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"

// Cook-Torrance specular BRDF with two lobes and terms of its own, for programs that treat lights
// differently.
//
//   lobe      FR_LOBE_EXACT or another macro of lobe.glsl, of both lobes, in place of FR_LOBE; all
//             are there with #define FR_LOBE FR_LOBE_EVERY; a constant, which the compiler folds
//   fresnel   FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, in place of FR_FRESNEL; a constant
//   masking   FR_MASKING_V_CAVITY, _KELEMEN or _NONE, in place of FR_MASKING; a constant
float fr_cook_torrance_two_terms(
    vec3 n, vec3 l, vec3 v, float m0, float m1, float weight, float f0,
    int lobe, int fresnel, int masking
) {
    float n_dot_l = clamp(dot(n, l), 0.0, 1.0);
    float n_dot_v = clamp(dot(n, v), 0.0, 1.0);
    vec3 h = l + v;  // keeps its length: V.H = |h|/2
    float n_dot_h = n_dot_l + n_dot_v;
    vec2 slope = vec2(FR_SLOPE(m0), FR_SLOPE(m1));
    vec2 inverse_m2 = 1.0 / (slope * slope + FR_FLOOR);
    vec2 lobes;
    float v_dot_h;
    float masked_over;  // G/((N.L)(N.V)), times 1/c^4 for the exact lobes
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
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
        lobes.x = fr_lobe_within(c, slope.x, inverse_m2.x, FR_K_COOK_TORRANCE, lobe);
        lobes.y = fr_lobe_within(c, slope.y, inverse_m2.y, FR_K_COOK_TORRANCE, lobe);
        masked_over = masked.x / (masked.y * h_dot_h);
        v_dot_h = 0.5 * h_dot_h * inverse_length;
    }
    // not mix: where it is x + a (y - x), a high lobe of share 0 would take the digits of the other
    vec2 shares = vec2(weight * inverse_m2.x, inverse_m2.y - weight * inverse_m2.y);
    float value = dot(shares, lobes) * masked_over;
    return value * fr_fresnel_times(0.25 / FR_PI, f0, v_dot_h, fresnel);
}

// Cook-Torrance specular BRDF with two lobes, with the terms that the host chose.
float fr_cook_torrance_two(
    vec3 n, vec3 l, vec3 v, float m0, float m1, float weight, float f0
) {
    return fr_cook_torrance_two_terms(
        n, l, v, m0, m1, weight, f0, FR_DEFAULT_LOBE, FR_FRESNEL, FR_MASKING);
}

#endif
