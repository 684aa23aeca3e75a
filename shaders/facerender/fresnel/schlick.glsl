// Fresnel reflectance, Schlick's approximation.
//
//   formula   f0 + (1 - f0)(1 - V.H)^5
//   f0        reflectance at normal incidence, in [0, 1); skin: 0.028, index of refraction 1.4
//   v_dot_h   cosine between the eye (or the light) and the unit half vector, in [0, 1]
//   unit      none, in [0, 1]
//   error     at most 0.046 absolute at f0 = 0.028 (at 84 degrees)
//   source    Schlick (1994), eq. 15
#ifndef FR_FRESNEL_SCHLICK_GLSL
#define FR_FRESNEL_SCHLICK_GLSL

#include "../constants.glsl"

float fr_fresnel_schlick(float f0, float v_dot_h) {
    float u = abs(1.0 - v_dot_h);  // rounding, or 0 to the power 5
    float u2 = u * u;
    return f0 + (1.0 - f0) * (u2 * u2 * u);
}

// Share of grazing reflection in Schlick's approximation, times a constant: compilers fold its root,
// and the product costs nothing.
//
//   formula   scale (1 - V.H)^5
//   scale     in (0, 1], a constant
//   unit      none, in [0, scale]
//   error     of the formula none; float32 adds 2e-6 of the scale
float fr_fresnel_schlick_grazing(float scale, float v_dot_h) {
    float root = pow(scale, 0.2);
    float u = abs(root - root * v_dot_h);
    float u2 = u * u;
    return u2 * u2 * u;
}

// Fresnel reflectance, Schlick's approximation, times a constant.
//
//   formula   scale (f0 + (1 - f0)(1 - V.H)^5)
//   scale     in (0, 1], a constant
//   unit      none, in [0, scale]
//   error     float32 adds 2e-6 of the scale
float fr_fresnel_schlick_times(float scale, float f0, float v_dot_h) {
    float grazing = fr_fresnel_schlick_grazing(scale, v_dot_h);
    return f0 * (scale - grazing) + grazing;
}

// Fresnel reflectance in colour, Schlick's approximation with a reflectance at 90 degrees, times a
// constant.
//
//   formula   scale (f0 + (f90 - f0)(1 - V.H)^5)
//   f0, f90   reflectances at normal incidence and at 90 degrees, in [0, 1] each
//   scale     in (0, 1], a constant
//   unit      none, in [0, scale]
//   error     float32 adds 2e-6 of the scale
vec3 fr_fresnel_schlick_rgb(float scale, vec3 f0, vec3 f90, float v_dot_h) {
    float grazing = fr_fresnel_schlick_grazing(scale, v_dot_h);
    return f0 * (scale - grazing) + f90 * grazing;
}

#endif
