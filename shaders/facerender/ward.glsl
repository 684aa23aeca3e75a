// Ward's isotropic specular BRDF.
//
//   formula   E/(4 pi m^2 sqrt((N.L)(N.V))), E = exp(-tan^2(gamma)/m^2)
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope (Ward's alpha), in the domain of the chosen lobe (FR_LOBE)
//   unit      1/sr, for a specular reflectance of 1; N.L is not included, 1/pi is
//   result    of finite vectors finite and >= 0, also for m below its domain; exactly 0 where N.L or
//             N.V, as float32 rounds it, is not above 0, or their product not above 1e-12, the
//             square of FR_MIN_COSINE
//   error     as of cook_torrance.glsl, without F
//   source    Ward (1992), eq. 4
#ifndef FR_WARD_GLSL
#define FR_WARD_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "lobe.glsl"

// Ward's isotropic specular BRDF with a lobe of its own, for programs that treat lights differently.
//
//   lobe      FR_LOBE_EXACT or another macro of lobe.glsl, in place of FR_LOBE; all are there with
//             #define FR_LOBE FR_LOBE_EVERY; a constant, which the compiler folds
float fr_ward_terms(vec3 n, vec3 l, vec3 v, float m, int lobe) {
    float n_dot_l = dot(n, l);
    float n_dot_v = clamp(dot(n, v), 0.0, 1.0);  // so that the product is not above 0 below the surface
    vec3 h = l + v;  // keeps its length
    float n_dot_h = n_dot_l + n_dot_v;
    float product = n_dot_l * n_dot_v;
    float m2 = FR_SLOPE(m) * FR_SLOPE(m) + FR_FLOOR;
    float value;
#if FR_LOBE == FR_LOBE_EXACT || FR_LOBE == FR_LOBE_EVERY
    if (lobe == FR_LOBE_EXACT) {
        float along = n_dot_h * n_dot_h + FR_FLOOR;
        float w = FR_LN_2 * m2;  // E = 2^-x, x = tan^2(gamma)/w
        float x = fr_half_vector(n, h, n_dot_h).y / (along * w);
        // log2(ln 2/(4 pi)) is the scale
        value = exp2(-4.1802625 - x) * inversesqrt(w * w * product);
    } else
#endif
    {
        float inverse_m2 = 1.0 / m2;
        float c = n_dot_h * inversesqrt(fr_half_vector_square(h));
        float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
        value = fr_lobe_within(c, slope, inverse_m2, FR_K_WARD, lobe)
            * (0.25 / FR_PI * inverse_m2 * inversesqrt(product));
    }
    return product > FR_MIN_COSINE * FR_MIN_COSINE ? value : 0.0;
}

// Ward's isotropic specular BRDF, with the lobe that the host chose.
float fr_ward(vec3 n, vec3 l, vec3 v, float m) {
    return fr_ward_terms(n, l, v, m, FR_DEFAULT_LOBE);
}

#endif
