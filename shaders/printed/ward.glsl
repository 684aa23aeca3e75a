// Ward as Romanyuk et al. (2020) print it, in the literal form: acos, tan, exp, no guard. To measure
// the paper's claims, and for nothing else. Use facerender/ward.glsl, or for the same values
// facerender/ward_printed.glsl.
//
//   n, l, v, m, unit   as there
//   FR_LOBE            exact, D4, D8 or D16
//   error              as there where that one is accurate; unbounded elsewhere
#ifndef FR_PRINTED_WARD_GLSL
#define FR_PRINTED_WARD_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"
#include "printed/g_power.glsl"

#if FR_LOBE != FR_LOBE_EXACT && FR_LOBE != 4 && FR_LOBE != 8 && FR_LOBE != 16
#error the paper prints FR_LOBE_EXACT, FR_LOBE_D4, FR_LOBE_D8, FR_LOBE_D16
#endif

float fr_printed_ward(vec3 n, vec3 l, vec3 v, float m) {
    vec3 h = normalize(l + v);
#if FR_LOBE == FR_LOBE_EXACT
    float tangent = tan(acos(dot(n, h)));
    float lobe = exp(-tangent * tangent / (m * m));
#else
    float lobe = fr_printed_g_power(dot(n, h), 2.0 / (m * m), FR_LOBE);
#endif
    return lobe / (4.0 * FR_PI * m * m * sqrt(dot(v, n) + dot(l, h)));
}

#endif
