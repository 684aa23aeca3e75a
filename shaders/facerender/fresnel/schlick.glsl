// Schlick's approximation of the Fresnel reflectance.
//
//   formula:  f0 + (1 - f0)(1 - V.H)^5
//   f0:       Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin, with index of
//             refraction 1.4.
//   v_dot_h:  Cosine of the angle between the direction to the camera (or to the light) and the
//             unit half vector, in [0, 1].
//   unit:     none
//   returns:  In [0, 1].
//   error:    At most 0.046 (absolute) for f0 = 0.028, reached at 84 degrees.
//   source:   Schlick (1994), eq. 15.
#ifndef FR_FRESNEL_SCHLICK_GLSL
#define FR_FRESNEL_SCHLICK_GLSL

#include "../constants.glsl"

float fr_fresnel_schlick(float f0, float v_dot_h) {
    float u = abs(1.0 - v_dot_h);  // V.H may round to a value above 1.
    float u2 = u * u;
    return f0 + (1.0 - f0) * (u2 * u2 * u);
}

// Grazing part of Schlick's approximation times a constant factor.
// Compilers fold the fifth root of a constant `scale`, so that the multiplication costs nothing.
//
//   formula:  scale (1 - V.H)^5
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    The formula is exact; float32 rounding: 2e-6 of the scale.
float fr_fresnel_schlick_grazing(float scale, float v_dot_h) {
    float root = pow(scale, 0.2);
    float u = abs(root - root * v_dot_h);
    float u2 = u * u;
    return u2 * u2 * u;
}

// Schlick's approximation of the Fresnel reflectance times a constant factor.
//
//   formula:  scale (f0 + (1 - f0)(1 - V.H)^5)
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
float fr_fresnel_schlick_times(float scale, float f0, float v_dot_h) {
    float grazing = fr_fresnel_schlick_grazing(scale, v_dot_h);
    return f0 * (scale - grazing) + grazing;
}

// Schlick's approximation in RGB times a constant factor, with a given reflectance at 90 degrees.
//
//   formula:  scale (f0 + (f90 - f0)(1 - V.H)^5)
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
vec3 fr_fresnel_schlick_rgb(float scale, vec3 f0, vec3 f90, float v_dot_h) {
    float grazing = fr_fresnel_schlick_grazing(scale, v_dot_h);
    return f0 * (scale - grazing) + f90 * grazing;
}

#endif
