// Fresnel reflectance of a dielectric in air, for unpolarised light. The host chooses the one that
// fr_fresnel calls: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC. Default: Schlick.
//
//   formula   that of fr_fresnel_schlick or fr_fresnel_dielectric; with FR_FRESNEL_CONSTANT f0
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   unit      none, in [0, 1]
//   error     of the chosen one; f0 alone is 1 - f0 too low at 90 degrees
//   source    of the chosen one
#ifndef FR_FRESNEL_GLSL
#define FR_FRESNEL_GLSL

#include "facerender/constants.glsl"

#define FR_FRESNEL_SCHLICK 0
#define FR_FRESNEL_DIELECTRIC 1
#define FR_FRESNEL_CONSTANT 2

#ifndef FR_FRESNEL
#define FR_FRESNEL FR_FRESNEL_SCHLICK
#endif

// Fresnel reflectance, Schlick's approximation.
//
//   formula   f0 + (1 - f0)(1 - V.H)^5
//   error     at most 0.046 absolute at f0 = 0.028 (at 84 degrees)
//   source    Schlick (1994), eq. 15
float fr_fresnel_schlick(float f0, float v_dot_h) {
    float u = max(1.0 - v_dot_h, 0.0);
    float u2 = u * u;
    return f0 + (1.0 - f0) * (u2 * u2 * u);
}

// Fresnel reflectance, exact. Written with q = eta^2 - 1 and g - c = q/(g + c), so that nothing
// cancels where eta is near 1; at q = c = 0 the floor 1e-20 (whose square float32 still holds) makes
// 0/0 a 0, the limit for c > 0.
//
//   formula   a^2 (1 + b^2)/2, a = (g - c)/(g + c), b = (c (g + c) - 1)/(c (g - c) + 1), c = V.H,
//             g^2 = eta^2 + c^2 - 1, eta = (1 + sqrt(f0))/(1 - sqrt(f0))
//   error     of the formula none
//   source    Cook and Torrance (1982)
float fr_fresnel_dielectric(float f0, float v_dot_h) {
    float root = sqrt(f0);
    float q = 4.0 * root / ((1.0 - root) * (1.0 - root));
    float c = min(v_dot_h, 1.0);
    float sum = max(sqrt(q + c * c) + c, 1e-20);
    float difference = q / sum;
    float a = difference / sum;
    float b = (c * sum - 1.0) / (c * difference + 1.0);
    return 0.5 * a * a * (1.0 + b * b);
}

// Fresnel reflectance, of the kind that the caller names by a constant.
//
//   kind      FR_FRESNEL_SCHLICK, FR_FRESNEL_DIELECTRIC or FR_FRESNEL_CONSTANT
float fr_fresnel_of(float f0, float v_dot_h, int kind) {
    if (kind == FR_FRESNEL_CONSTANT) return f0;
    if (kind == FR_FRESNEL_DIELECTRIC) return fr_fresnel_dielectric(f0, v_dot_h);
    return fr_fresnel_schlick(f0, v_dot_h);
}

// Fresnel reflectance, as the host chose it: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC.
float fr_fresnel(float f0, float v_dot_h) {
    return fr_fresnel_of(f0, v_dot_h, FR_FRESNEL);
}

#endif
