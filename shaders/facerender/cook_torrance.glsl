// Cook-Torrance specular BRDF.
// The host selects the lobe (FR_LOBE), the Fresnel term (FR_FRESNEL) and masking (FR_MASKING).
//
//   formula:  F G D/(pi (N.L)(N.V)), D = E/(4 m^2 c^4), E = exp(-tan^2(gamma)/m^2)
//   n, l, v:  Unit vectors: normal, direction to the light, direction to the camera.
//   m:        Roughness: RMS slope of the microfacets, in the domain of the lobe (FR_LOBE).
//   f0:       Fresnel reflectance at normal incidence, in [0, 1).
//   unit:     1/sr, for a specular weight ks = 1; includes 1/pi, excludes N.L
//   returns:  Finite and >= 0 for finite vectors, also for m below its domain. Exactly 0 if N.L or
//             N.V in float32 is at most 0. With FR_MASKING_KELEMEN or FR_MASKING_NONE, exactly 0 if
//             N.L or N.V is at most FR_MIN_COSINE. NaN if a vector is NaN.
//   error:    Error of the lobe, plus float32 rounding: r times a reference value. The reference
//             value is the BRDF in the same directions, with the lobe replaced by its highest
//             value, and with F replaced by F + 2e-6.
//             r = 1e-5 + 2e-7/(N.L) + 2e-7/(N.V) + s, with e = 4e-7 (1 + 1/(N.L + N.V)) and:
//             s = e/m for the exact lobe with FR_SMALL_SLOPE 1;
//             s = e/m^2 for the exact lobe with FR_SMALL_SLOPE 0;
//             s = e/m^2 for all other lobes, except the cosine power and a g-power:
//             s = (e + 7e-7)/m^2 for the cosine power, because of log2;
//             s = e a g/(2 m^2) for a g-power with FR_STEEPNESS a/m^2 - b.
//             The bound applies if N.L and N.V are above 1.3e-6. It excludes the rounding of the
//             vectors to float32, which adds a quarter of the bound. A vector whose length differs
//             from 1 by d > 1e-7 adds 2 d to e, and 3 d/(f0 + 2e-6)^0.2 to r.
//   source:   Cook and Torrance (1982), normalised as in Walter et al. (2007):
//             F G D'/(4 (N.L)(N.V)) with D' = 4 D/pi.
#ifndef FR_COOK_TORRANCE_GLSL
#define FR_COOK_TORRANCE_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"

// Constant factor of the Cook-Torrance BRDF: the argument `scale` of the Fresnel functions.
//
//   formula:  ln 2/(4 pi) for the exact lobe, where fr_cook_torrance_parts divides by m^2 ln 2
//             instead of m^2; 1/(4 pi) for other lobes
//   lobe:     FR_LOBE_EXACT or another macro of lobe.glsl, a constant.
//   unit:     1/sr
//   returns:  In (0, 1).
//   error:    None.
float fr_cook_torrance_scale(int lobe) {
#if FR_COMPILED_LOBE == 1 || FR_COMPILED_LOBE == 91
    if (lobe == FR_LOBE_EXACT) return 0.25 * FR_LN_2 / FR_PI;
#endif
    return 0.25 / FR_PI;
}

// Pair (x, y): x is the Cook-Torrance BRDF without Fresnel term and constant factor, y is V.H.
//
//   formula:  x = G D/(pi (N.L)(N.V)) divided by fr_cook_torrance_scale, y = V.H
//   lobe:     FR_LOBE_EXACT or another macro of lobe.glsl, a constant.
//   masking:  FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
//   unit:     none
//   returns:  x and y, both >= 0; x is finite, 0 or NaN in the same cases as fr_cook_torrance.
vec2 fr_cook_torrance_parts(vec3 n, vec3 l, vec3 v, float m, int lobe, int masking) {
    float n_dot_l = clamp(dot(n, l), 0.0, 1.0);
    float n_dot_v = clamp(dot(n, v), 0.0, 1.0);
    vec3 h = l + v;  // Not normalised: V.H = |h|/2.
    float n_dot_h = n_dot_l + n_dot_v;
    float slope2 = FR_SLOPE(m) * FR_SLOPE(m);
#if FR_COMPILED_LOBE == 1 || FR_COMPILED_LOBE == 91
    if (lobe == FR_LOBE_EXACT) {
        vec2 squares = fr_half_vector(n, h, n_dot_h);
        vec2 masked = fr_masking_of(n_dot_h, squares.x, n_dot_l, n_dot_v, masking);
        float along = n_dot_h * n_dot_h + FR_FLOOR;
        float w = FR_LN_2 * slope2 + FR_FLOOR;  // E = 2^-x, x = tan^2(gamma)/w.
        float inverse = 1.0 / (masked.y * along * w);
        float x = squares.y * masked.y * inverse;
        float sec2 = x * w + 1.0;
        // Multiply by E first: where E is 0, the product of the other factors may overflow.
        return vec2(exp2(-x) * sec2 * (masked.x * inverse), 0.5 * sqrt(squares.x));
    }
#endif
    float m2 = slope2 + FR_FLOOR;
    float h_dot_h = fr_half_vector_square(h);
    vec2 masked = fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, masking);
    float divisor = masked.y * h_dot_h;
#if FR_CONSTANT_SLOPE == 1
    float inverse_m2 = 1.0 / m2;
    float inverse = inverse_m2 / divisor;
#else
    float inverse = 1.0 / (divisor * m2);
    float inverse_m2 = divisor * inverse;
#endif
    float inverse_length = inversesqrt(h_dot_h);
    float c = n_dot_h * inverse_length;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    float value = fr_lobe_with_inverse_m2(c, slope, inverse_m2, FR_K_COOK_TORRANCE, lobe);
    return vec2(value * (masked.x * inverse), 0.5 * h_dot_h * inverse_length);
}

// Cook-Torrance specular BRDF with the terms that the arguments select.
// Programs with different terms per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
//   fresnel:  Replaces FR_FRESNEL: FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   masking:  Replaces FR_MASKING: FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
float fr_cook_torrance_terms(
    vec3 n, vec3 l, vec3 v, float m, float f0, int lobe, int fresnel, int masking
) {
    vec2 parts = fr_cook_torrance_parts(n, l, v, m, lobe, masking);
    return parts.x * fr_fresnel_times(fr_cook_torrance_scale(lobe), f0, parts.y, fresnel);
}

// Cook-Torrance specular BRDF with the terms that the host's macros select.
float fr_cook_torrance(vec3 n, vec3 l, vec3 v, float m, float f0) {
    return fr_cook_torrance_terms(n, l, v, m, f0, FR_DEFAULT_LOBE, FR_FRESNEL, FR_MASKING);
}

// Cook-Torrance specular BRDF in RGB, with Schlick's Fresnel term and a given reflectance at 90
// degrees.
//
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
vec3 fr_cook_torrance_rgb(vec3 n, vec3 l, vec3 v, float m, vec3 f0, vec3 f90) {
    vec2 parts = fr_cook_torrance_parts(n, l, v, m, FR_DEFAULT_LOBE, FR_MASKING);
    float scale = fr_cook_torrance_scale(FR_DEFAULT_LOBE);
    return parts.x * fr_fresnel_schlick_rgb(scale, f0, f90, parts.y);
}

#endif

// These files end with comparisons of the macros, which an include guard must not skip.
#include "half_vector.glsl"
#include "lobe.glsl"
#include "fresnel.glsl"
#include "masking.glsl"
