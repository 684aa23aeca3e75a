// g-power lobe max((n/g)(c - 1) + 1, 0)^g with n = 2/m^2 - k: D4, D8 and D16 of Romanyuk et al.
// (2020), with the clamp of Lyon (1993). Unclamped, the even power turns a negative base back up:
// at m = 0.2 the printed D16 reaches 2.3e4 times its peak at 90 degrees.
//
//   c       cosine of the angle between normal and half vector, in [0, 1]
//   m       rms slope, in [1e-4, sqrt(2/k)): n > 0, so m < 0.707 for Cook-Torrance
//   k       FR_K_COOK_TORRANCE or FR_K_WARD
//   g       4, 8 or 16
//   unit    none: peak 1 at c = 1; the caller multiplies by the model's scale
//   error   in % of the peak, Cook-Torrance, g = 4, 8, 16 (tests/test_lobes.py):
//           m = 0.1  6.96  3.11  1.31     m = 0.4   4.18   7.79   9.50
//           m = 0.2  5.54  1.68  0.13     m = 0.5  17.8   20.9   22.3
//           m = 0.3  2.46  1.43  3.21     m = 0.6  45.4   46.9   47.6
#ifndef FR_LOBE_G_POWER_GLSL
#define FR_LOBE_G_POWER_GLSL

float fr_lobe_g_power(float c, float m, int k, int g) {
    float n = 2.0 / (m * m) - float(k);
    // As 1 - a (1 - c): Mesa multiplies a (c - 1) + 1 out, and loses the digits of a small angle.
    float power = max(1.0 - n / float(g) * (1.0 - min(c, 1.0)), 0.0);
    power *= power;
    power *= power;
    if (g >= 8) power *= power;
    if (g >= 16) power *= power;
    return power;
}

#endif
