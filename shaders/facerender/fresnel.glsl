// Fresnel reflectance of a dielectric in air, for unpolarised light. The host chooses the one that
// fr_fresnel calls: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC. Default: Schlick.
//
//   formula   of the chosen one: see fresnel/*.glsl; with FR_FRESNEL_CONSTANT f0
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   fresnel   FR_FRESNEL_SCHLICK, _DIELECTRIC, _CONSTANT, a constant
//   unit      none, in [0, 1]
//   error     of the chosen one; f0 alone is 1 - f0 too low at 90 degrees
//   source    of the chosen one
#ifndef FR_FRESNEL_GLSL
#define FR_FRESNEL_GLSL

#include "constants.glsl"
#include "fresnel/schlick.glsl"
#include "fresnel/dielectric.glsl"

#define FR_FRESNEL_SCHLICK 0
#define FR_FRESNEL_DIELECTRIC 1
#define FR_FRESNEL_CONSTANT 2

#ifndef FR_FRESNEL
#define FR_FRESNEL FR_FRESNEL_SCHLICK
#endif

// Fresnel reflectance, of the kind that the caller names by a constant.
float fr_fresnel_of(float f0, float v_dot_h, int fresnel) {
    if (fresnel == FR_FRESNEL_CONSTANT) return f0;
    if (fresnel == FR_FRESNEL_DIELECTRIC) return fr_fresnel_dielectric(f0, v_dot_h);
    return fr_fresnel_schlick(f0, v_dot_h);
}

// Fresnel reflectance times a constant, of the kind that the caller names by another.
//
//   scale     in (0, 1], a constant
//   unit      none, in [0, scale]
float fr_fresnel_times(float scale, float f0, float v_dot_h, int fresnel) {
    if (fresnel == FR_FRESNEL_CONSTANT) return scale * f0;
    if (fresnel == FR_FRESNEL_DIELECTRIC) return scale * fr_fresnel_dielectric(f0, v_dot_h);
    return fr_fresnel_schlick_times(scale, f0, v_dot_h);
}

// Fresnel reflectance, as the host chose it: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC.
float fr_fresnel(float f0, float v_dot_h) {
    return fr_fresnel_of(f0, v_dot_h, FR_FRESNEL);
}

#endif
