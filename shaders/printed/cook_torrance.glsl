// Cook-Torrance as published by Romanyuk et al. (2020), literally.
// The function normalises the half vector, uses exp, divisions and powers, and has no guards. It
// serves only to measure the claims of the paper: it returns NaN and infinity at the horizon, and
// g-powers have no clamp. In all other cases use facerender/cook_torrance.glsl.
//
//   n, l, v, m, f0, unit:  See facerender/cook_torrance.glsl. The BRDF includes the factor 1/pi,
//                          which the paper omits.
//   FR_LOBE:               Exact, D4, D8 or D16.
//   error:                 As in facerender/cook_torrance.glsl where the error bound of that file
//                          applies; unbounded elsewhere.
#ifndef FR_PRINTED_COOK_TORRANCE_GLSL
#define FR_PRINTED_COOK_TORRANCE_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"
#include "printed/g_power.glsl"

#if FR_LOBE != 1 && FR_LOBE != 4 && FR_LOBE != 8 && FR_LOBE != 16
#error FR_LOBE must be a lobe of the paper: FR_LOBE_EXACT, FR_LOBE_D4, FR_LOBE_D8 or FR_LOBE_D16
#endif

float fr_printed_cook_torrance(vec3 n, vec3 l, vec3 v, float m, float f0) {
    vec3 h = normalize(l + v);
    float n_dot_h = dot(n, h);
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    float v_dot_h = dot(v, h);
#if FR_LOBE == 1
    float c2 = n_dot_h * n_dot_h;
    float d = exp((c2 - 1.0) / (m * m * c2)) / (4.0 * m * m * c2 * c2);
#else
    float d = fr_printed_g_power(n_dot_h, 2.0 / (m * m) - 4.0, FR_LOBE) / (4.0 * m * m);
#endif
    float g = min(1.0, min(2.0 * n_dot_h * n_dot_v / v_dot_h, 2.0 * n_dot_h * n_dot_l / v_dot_h));
    float f = f0 + (1.0 - f0) * pow(1.0 - v_dot_h, 5.0);
    return f * g * d / (FR_PI * n_dot_l * n_dot_v);
}

#endif
