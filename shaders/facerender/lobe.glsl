// The lobe that the host chose at compile time: #define FR_LOBE FR_LOBE_D16. Default: exact.
//
//   n_dot_h   dot(N, h), > 0; h = L + V of any length
//   h_dot_h   dot(h, h)
//   m         rms slope, in the domain of the chosen lobe
//   k         FR_K_COOK_TORRANCE or FR_K_WARD
//   unit      none: peak 1 at N = H; the caller multiplies by the model's scale
//   error     see lobe/*.glsl
#ifndef FR_LOBE_GLSL
#define FR_LOBE_GLSL

#include "facerender/constants.glsl"

#define FR_LOBE_EXACT 1
#define FR_LOBE_COSINE 2
#define FR_LOBE_D4 4
#define FR_LOBE_D8 8
#define FR_LOBE_D16 16

#ifndef FR_LOBE
#define FR_LOBE FR_LOBE_EXACT
#endif

#if FR_LOBE == FR_LOBE_EXACT
#include "facerender/lobe/exact.glsl"
#elif FR_LOBE == FR_LOBE_COSINE
#include "facerender/lobe/cosine.glsl"
#elif FR_LOBE == FR_LOBE_D4 || FR_LOBE == FR_LOBE_D8 || FR_LOBE == FR_LOBE_D16
#include "facerender/lobe/g_power.glsl"
#else
#error "FR_LOBE is none of FR_LOBE_EXACT, FR_LOBE_COSINE, FR_LOBE_D4, FR_LOBE_D8, FR_LOBE_D16"
#endif

float fr_lobe(float n_dot_h, float h_dot_h, float m, int k) {
#if FR_LOBE == FR_LOBE_EXACT
    return fr_lobe_exact_tan2(h_dot_h / (n_dot_h * n_dot_h) - 1.0, m, k);
#else
    float c = n_dot_h * inversesqrt(h_dot_h);
#if FR_LOBE == FR_LOBE_COSINE
    return fr_lobe_cosine(c, m, k);
#else
    return fr_lobe_g_power(c, m, k, FR_LOBE);
#endif
#endif
}

#endif
