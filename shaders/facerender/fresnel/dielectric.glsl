// Fresnel reflectance of a dielectric in air for unpolarised light, exact. Written with q = eta^2 - 1
// and g - c = q/(g + c), so that nothing cancels where eta is near 1; at q = c = 0 the floor 1e-20
// (whose square float32 still holds) makes 0/0 a 0, the limit for c > 0.
//
//   formula   a^2 (1 + b^2)/2, a = (g - c)/(g + c), b = (c (g + c) - 1)/(c (g - c) + 1), c = V.H,
//             g^2 = eta^2 + c^2 - 1, eta = (1 + sqrt(f0))/(1 - sqrt(f0))
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   unit      none, in [0, 1]
//   error     of the formula none
//   source    Cook and Torrance (1982)
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
