// Fresnel reflectance of a dielectric in air for unpolarised light.
// The macro FR_FRESNEL selects the formula of fr_fresnel: #define FR_FRESNEL FR_FRESNEL_DIELECTRIC.
// The default is FR_FRESNEL_SCHLICK.
//
//   formula:  see fresnel/*.glsl; f0 for FR_FRESNEL_CONSTANT
//   f0:       Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin, with index of
//             refraction 1.4.
//   v_dot_h:  Cosine of the angle between the direction to the camera (or to the light) and the
//             unit half vector, in [0, 1].
//   fresnel:  FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   unit:     none
//   returns:  In [0, 1].
//   error:    See fresnel/*.glsl. FR_FRESNEL_CONSTANT is too low by up to 1 - f0, reached at 90
//             degrees.
//   source:   See fresnel/*.glsl.
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

// Number of FR_FRESNEL, for the comparison at the end of this file. Undefined if FR_FRESNEL is a name
// and the host compares macros as text, as Babylon.js does.
#if FR_FRESNEL == FR_FRESNEL_SCHLICK
#define FR_COMPILED_FRESNEL 0
#elif FR_FRESNEL == FR_FRESNEL_DIELECTRIC
#define FR_COMPILED_FRESNEL 1
#elif FR_FRESNEL == FR_FRESNEL_CONSTANT
#define FR_COMPILED_FRESNEL 2
#endif

// Fresnel reflectance by the formula that the compile-time constant `fresnel` selects.
float fr_fresnel_of(float f0, float v_dot_h, int fresnel) {
    if (fresnel == FR_FRESNEL_CONSTANT) return f0;
    if (fresnel == FR_FRESNEL_DIELECTRIC) return fr_fresnel_dielectric(f0, v_dot_h);
    return fr_fresnel_schlick(f0, v_dot_h);
}

// Fresnel reflectance times a constant factor, by the formula that `fresnel` selects.
//
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
float fr_fresnel_times(float scale, float f0, float v_dot_h, int fresnel) {
    if (fresnel == FR_FRESNEL_CONSTANT) return scale * f0;
    if (fresnel == FR_FRESNEL_DIELECTRIC) return scale * fr_fresnel_dielectric(f0, v_dot_h);
    return fr_fresnel_schlick_times(scale, f0, v_dot_h);
}

// Fresnel reflectance by the formula that the macro FR_FRESNEL selects.
float fr_fresnel(float f0, float v_dot_h) {
    return fr_fresnel_of(f0, v_dot_h, FR_FRESNEL);
}

#endif

#if !defined(FR_COMPILED_FRESNEL) || FR_FRESNEL == FR_COMPILED_FRESNEL
#else
#error FR_FRESNEL differs from its value at the first include: call the functions that end in _terms
#endif
