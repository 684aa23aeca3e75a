// D4, D8 and D16 as published by Romanyuk et al. (2020): ((n/g)(c - 1) + 1)^g without a clamp.
// The even power makes a negative base positive. The function serves only to measure the claims of
// the paper.
//
//   c:        Cosine of the angle between normal and half vector.
//   n:        2/m^2 - k.
//   g:        4, 8 or 16.
//   unit:     none
//   error:    At m = 0.2 and 90 degrees, D16 reaches 2.3e4 times its peak.
#ifndef FR_PRINTED_G_POWER_GLSL
#define FR_PRINTED_G_POWER_GLSL

float fr_printed_g_power(float c, float n, int g) {
    float power = n / float(g) * (c - 1.0) + 1.0;
    power *= power;
    power *= power;
    if (g >= 8) power *= power;
    if (g >= 16) power *= power;
    return power;
}

#endif
