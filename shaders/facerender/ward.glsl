// Ward's isotropic specular BRDF.
// The host selects the lobe (FR_LOBE).
//
//   formula:  E/(4 pi m^2 sqrt((N.L)(N.V))), E = exp(-tan^2(gamma)/m^2)
//   n, l, v:  Unit vectors: normal, direction to the light, direction to the camera.
//   m:        Roughness: RMS slope of the microfacets (Ward's alpha), in the domain of the lobe
//             (FR_LOBE).
//   unit:     1/sr, for a specular reflectance of 1; includes 1/pi, excludes N.L
//   returns:  Finite and >= 0 for finite vectors, also for m below its domain. Exactly 0 if N.L or
//             N.V in float32 is at most 0, or if (N.L)(N.V) is at most 1e-12, the square of
//             FR_MIN_COSINE.
//   error:    As in cook_torrance.glsl, without the factor F.
//   source:   Ward (1992), eq. 4.
#ifndef FR_WARD_GLSL
#define FR_WARD_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"

// Ward's isotropic specular BRDF with the lobe that the argument `lobe` selects.
// Programs with different lobes per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
float fr_ward_terms(vec3 n, vec3 l, vec3 v, float m, int lobe) {
    float n_dot_l = dot(n, l);
    // Clamped, so that the product is at most 0 if both cosines are negative.
    float n_dot_v = clamp(dot(n, v), 0.0, 1.0);
    vec3 h = l + v;  // Not normalised.
    float n_dot_h = n_dot_l + n_dot_v;
    float product = n_dot_l * n_dot_v;
    float m2 = FR_SLOPE(m) * FR_SLOPE(m) + FR_FLOOR;
    float value;
#if FR_COMPILED_LOBE == 1 || FR_COMPILED_LOBE == 91
    if (lobe == FR_LOBE_EXACT) {
        float along = n_dot_h * n_dot_h + FR_FLOOR;
        float w = FR_LN_2 * m2;  // E = 2^-x, x = tan^2(gamma)/w.
        float x = fr_half_vector(n, h, n_dot_h).y / (along * w);
        // The BRDF is ln 2/(4 pi) E/(w sqrt(product)); log2(ln 2/(4 pi)) is -4.1802625.
        value = exp2(-4.1802625 - x) * inversesqrt(w * w * product);
    } else
#endif
    {
        float inverse_m2 = 1.0 / m2;
        float c = n_dot_h * inversesqrt(fr_half_vector_square(h));
        float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
        value = fr_lobe_with_inverse_m2(c, slope, inverse_m2, FR_K_WARD, lobe)
            * (0.25 / FR_PI * inverse_m2 * inversesqrt(product));
    }
    return product > FR_MIN_COSINE * FR_MIN_COSINE ? value : 0.0;
}

// Ward's isotropic specular BRDF with the lobe that the macro FR_LOBE selects.
float fr_ward(vec3 n, vec3 l, vec3 v, float m) {
    return fr_ward_terms(n, l, v, m, FR_DEFAULT_LOBE);
}

#endif

// These files end with comparisons of the macros, which an include guard must not skip.
#include "half_vector.glsl"
#include "lobe.glsl"
