// Cook-Torrance as Romanyuk et al. (2020) print it, in the literal form: normalised half vector,
// exp, divisions, powers, no guard. To measure the paper's claims, and for nothing else: NaN and
// infinity at the horizon, and with a g-power no clamp. Use facerender/cook_torrance.glsl.
//
//   n, l, v, m, f0, unit   as there, with the 1/pi that the paper leaves out
//   FR_LOBE                exact, D4, D8 or D16
//   error                  as there where that one is accurate; unbounded elsewhere
#ifndef FR_PRINTED_COOK_TORRANCE_GLSL
#define FR_PRINTED_COOK_TORRANCE_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"
#include "printed/g_power.glsl"

#if FR_LOBE != FR_LOBE_EXACT && FR_LOBE != 4 && FR_LOBE != 8 && FR_LOBE != 16
#error the paper prints FR_LOBE_EXACT, FR_LOBE_D4, FR_LOBE_D8, FR_LOBE_D16
#endif

float fr_printed_cook_torrance(vec3 n, vec3 l, vec3 v, float m, float f0) {
    vec3 h = normalize(l + v);
    float n_dot_h = dot(n, h);
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    float v_dot_h = dot(v, h);
#if FR_LOBE == FR_LOBE_EXACT
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
