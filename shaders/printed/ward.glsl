// Ward as published by Romanyuk et al. (2020), literally: acos, tan and exp without guards.
// The function serves only to measure the claims of the paper. In all other cases use
// facerender/ward.glsl. facerender/ward_printed.glsl returns the same values as this file.
//
//   n, l, v, m, unit:  See facerender/ward.glsl.
//   FR_LOBE:           Exact, D4, D8 or D16.
//   error:             As in facerender/ward.glsl where the error bound of that file applies;
//                      unbounded elsewhere.
#ifndef FR_PRINTED_WARD_GLSL
#define FR_PRINTED_WARD_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"
#include "printed/g_power.glsl"

#if FR_LOBE != 1 && FR_LOBE != 4 && FR_LOBE != 8 && FR_LOBE != 16
#error FR_LOBE must be a lobe of the paper: FR_LOBE_EXACT, FR_LOBE_D4, FR_LOBE_D8 or FR_LOBE_D16
#endif

float fr_printed_ward(vec3 n, vec3 l, vec3 v, float m) {
    vec3 h = normalize(l + v);
#if FR_LOBE == 1
    float tangent = tan(acos(dot(n, h)));
    float lobe = exp(-tangent * tangent / (m * m));
#else
    float lobe = fr_printed_g_power(dot(n, h), 2.0 / (m * m), FR_LOBE);
#endif
    return lobe / (4.0 * FR_PI * m * m * sqrt(dot(v, n) + dot(l, h)));
}

#endif
