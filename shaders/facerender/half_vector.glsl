// Squares of the half vector h = L + V, which keeps its length: nothing here is normalised.
//
//   formula   (|h|^2, |n x h|^2), so that cos^2(gamma) = 1 - y/x, tan^2(gamma) = y/(n.h)^2
//   n         normal, a unit vector
//   h         l + v, of any length
//   n_dot_h   dot(n, h), from the caller, who has it as dot(n, l) + dot(n, v)
//   unit      none, both >= 0
//   error     in float32, with e = 3e-7 (1 + 1/dot(n, h)): e of sin(gamma) = sqrt(y/x) with
//             FR_SMALL_SLOPE; without, the difference of two squares cancels where gamma is small,
//             and e is the error of sin^2(gamma) = y/x
//   source    |n x h|^2 = (n.n)(h.h) - (n.h)^2: Lagrange's identity
//
// The exact lobe multiplies tan^2(gamma) by 1/m^2: FR_SMALL_SLOPE is what keeps it accurate for
// small m. It costs up to 8 % of a whole specular term (facerender measure); a host whose m stays
// above 0.2 may save them: #define FR_SMALL_SLOPE 0.
#ifndef FR_HALF_VECTOR_GLSL
#define FR_HALF_VECTOR_GLSL

#include "constants.glsl"

#ifndef FR_SMALL_SLOPE
#define FR_SMALL_SLOPE 1
#endif

// Square of the half vector's length alone.
//
//   formula   |h|^2, and FR_FLOOR more, so that it may be divided by
//   error     in float32 3e-7 of it, and FR_FLOOR
float fr_half_vector_square(vec3 h) {
    return h.x * h.x + (h.y * h.y + (h.z * h.z + FR_FLOOR));
}

vec2 fr_half_vector(vec3 n, vec3 h, float n_dot_h) {
    float along = n_dot_h * n_dot_h;
#if FR_SMALL_SLOPE == 1
    // Where n is off unit length by e, this errs by 2 e dot(n, h) along n: e^2 in the square.
    vec3 across = h - n_dot_h * n;
    float across2 = dot(across, across);
    return vec2(along + across2, across2);
#else
    float h_dot_h = dot(h, h);
    return vec2(h_dot_h, abs(h_dot_h - along));  // a rounded difference below 0 would lift the lobe
#endif
}

#endif
