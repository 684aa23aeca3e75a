// Exact Fresnel reflectance of a dielectric in air for unpolarised light.
// The code uses q = eta^2 - 1 and g - c = q/(g + c), so that no digits cancel for eta near 1. At q
// = c = 0 the sum g + c is raised to 1e-20. This turns 0/0 into 0, the limit of a
// for q = 0 and c > 0.
//
//   formula:  a^2 (1 + b^2)/2, a = (g - c)/(g + c), b = (c (g + c) - 1)/(c (g - c) + 1), c = V.H,
//             g^2 = eta^2 + c^2 - 1, eta = (1 + sqrt(f0))/(1 - sqrt(f0))
//   f0:       Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin, with index of
//             refraction 1.4.
//   v_dot_h:  Cosine of the angle between the direction to the camera (or to the light) and the
//             unit half vector, in [0, 1].
//   unit:     none
//   returns:  In [0, 1].
//   error:    The formula is exact.
//   source:   Cook and Torrance (1982).
#ifndef FR_FRESNEL_DIELECTRIC_GLSL
#define FR_FRESNEL_DIELECTRIC_GLSL

#include "../constants.glsl"

float fr_fresnel_dielectric(float f0, float v_dot_h) {
    float root = sqrt(f0);
    float q = 4.0 * root / ((1.0 - root) * (1.0 - root));
    float c = min(v_dot_h, 1.0);
    float sum = max(sqrt(q + c * c) + c, 1e-20);
    float difference = q / sum;
    float a = difference / sum;
    float b = (c * sum - 1.0) / (c * difference + 1.0);
    return clamp(0.5 * a * a * (1.0 + b * b), 0.0, 1.0);
}

#endif
