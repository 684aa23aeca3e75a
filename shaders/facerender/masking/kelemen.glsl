// Kelemen masking, which cancels the divisor (N.L)(N.V) of a BRDF: G/((N.L)(N.V)) = 4/(h.h) for h =
// l + v.
//
//   formula:           G = (N.L)(N.V)/(V.H)^2
//   v_dot_h:           Cosine of the angle between the direction to the camera and the unit half
//                      vector; at least (N.L + N.V)/2, a condition that all unit vectors meet.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in (0, 1].
//   unit:              none
//   returns:           In [0, 1].
//   error:             The value is between 0.5 and 1 times fr_masking_v_cavity; in the mirror
//                      direction both functions are equal. The command facerender plan measures the
//                      effect on a scene.
//   source:            Kelemen and Szirmay-Kalos (2001); for skin: GPU Gems 3, chapter 14 (2007).
#ifndef FR_MASKING_KELEMEN_GLSL
#define FR_MASKING_KELEMEN_GLSL

#include "../constants.glsl"

float fr_masking_kelemen(float v_dot_h, float n_dot_l, float n_dot_v) {
    float inverse = 1.0 / v_dot_h;  // The square of `inverse` may overflow.
    return n_dot_l * inverse * (n_dot_v * inverse);
}

// Kelemen masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h)
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   unit:              none
//   returns:           x >= 0 and y = 1; x is 0 if N.L or N.V is at most FR_MIN_COSINE.
//   error:             None.
vec2 fr_masking_kelemen_ratio(float n_dot_l, float n_dot_v) {
    return vec2(min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? 4.0 : 0.0, 1.0);
}

#endif
