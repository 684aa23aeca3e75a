// Cook-Torrance specular BRDF for GPUs whose mediump is half precision, with the exact lobe,
// Schlick's Fresnel term and V-cavities: products of vectors keep their digits, all that follows does
// with 10 bits and stays below 2^14, which GLSL ES asks of mediump. Where mediump is float, and in
// other languages than GLSL, all of it is.
//
//   formula   F G D/(pi (N.L)(N.V)), D = E/(4 m^2 c^4), E = exp(-tan^2(gamma)/m^2)
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope, in [0.1, 1]; outside it counts as the nearer end
//   f0        Fresnel reflectance at normal incidence, in [0, 1)
//   unit      1/sr, for a specular weight ks = 1; N.L is not included, 1/pi is
//   result    finite and >= 0; 0 where N.L or N.V is not above FR_MIN_COSINE
//   error     for N.L and N.V from 0.05 on 1 % of what the lobe's highest value gives in the same
//             directions; smaller cosines count as 0.05 in the divisor, which is too low there
//   source    as of cook_torrance.glsl; G/((N.L)(N.V)) is min(1/low, 4 n.h/h.h)/high of both cosines
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

    mediump float tan2 = min(across2 / (along * along), 100.0);  // where exp(-tan2/m^2) is 0
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
