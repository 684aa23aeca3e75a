// Cook-Torrance specular BRDF in half precision: exact lobe, Schlick's Fresnel term, V-cavities.
// This function is for GPUs whose mediump has half precision. Operations on vectors use highp. All
// later values are mediump: they have 10-bit precision and stay below 2^14, the range that GLSL ES
// requires of mediump. Where mediump is float32, and in languages other than GLSL, all values are
// float32.
//
//   formula:  F G D/(pi (N.L)(N.V)), D = E/(4 m^2 c^4), E = exp(-tan^2(gamma)/m^2)
//   n, l, v:  Unit vectors: normal, direction to the light, direction to the camera.
//   m:        Roughness: RMS slope of the microfacets; clamped to [0.1, 1].
//   f0:       Fresnel reflectance at normal incidence, in [0, 1).
//   unit:     1/sr, for a specular weight ks = 1; includes 1/pi, excludes N.L
//   returns:  Finite and >= 0; 0 if N.L or N.V is at most FR_MIN_COSINE.
//   error:    If N.L and N.V are at least 0.05: 1 % of the BRDF in the same directions, with the
//             lobe replaced by its highest value. Smaller cosines are raised to 0.05 in the
//             divisor, so that the result is too low.
//   source:   See cook_torrance.glsl. G/((N.L)(N.V)) is min(1/low, 4 n.h/h.h)/high, where low is
//             the smaller and high the larger of N.L and N.V.
#ifndef FR_COOK_TORRANCE_HALF_GLSL
#define FR_COOK_TORRANCE_HALF_GLSL

#include "constants.glsl"

float fr_cook_torrance_half(vec3 n, vec3 l, vec3 v, float m, float f0) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    vec3 h = l + v;
    float n_dot_h = n_dot_l + n_dot_v;
    vec3 across = h - n_dot_h * n;
    float across2 = dot(across, across);
    float along = max(n_dot_h, 0.1);
    float h_dot_h = along * along + across2;

    mediump float tan2 = min(across2 / (along * along), 100.0);  // exp(-100) is 0 in mediump.
    mediump float slope = clamp(FR_SLOPE(m), 0.1, 1.0);
    mediump float m2 = slope * slope;
    mediump float sec2 = 1.0 + tan2;
    mediump float lobe = exp2(-FR_LOG2_E * tan2 / m2) * sec2 * sec2 / m2;
    mediump float u = max(1.0 - 0.5 * sqrt(h_dot_h), 0.0);
    mediump float u2 = u * u;
    mediump float reflectance = f0 + (1.0 - f0) * (u2 * u2 * u);
    mediump float low = max(min(n_dot_l, n_dot_v), 0.05);
    mediump float high = max(max(n_dot_l, n_dot_v), 0.05);
    mediump float masked = min(1.0 / low, 4.0 * along / h_dot_h) / high;
    mediump float value = reflectance * lobe * (0.25 / FR_PI) * masked;
    return min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? value : 0.0;
}

#endif
