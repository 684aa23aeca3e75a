// Squared lengths of the half vector h = L + V, not normalised, and of its tangential part.
//
//   formula:  x = |h|^2, y = |n x h|^2; then cos^2(gamma) = 1 - y/x, tan^2(gamma) = y/(n.h)^2
//   n:        Unit vector: normal.
//   h:        l + v, of any length.
//   n_dot_h:  dot(n, h); the caller passes the sum dot(n, l) + dot(n, v).
//   unit:     none
//   returns:  x and y, both >= 0.
//   error:    float32 rounding, with e = 3e-7 (1 + 1/dot(n, h)):
//             with FR_SMALL_SLOPE 1, the error of sin(gamma) = sqrt(y/x) is e;
//             with FR_SMALL_SLOPE 0, the error of sin^2(gamma) = y/x is e, because the difference
//             of two squares cancels for small gamma.
//   source:   Lagrange's identity: |n x h|^2 = (n.n)(h.h) - (n.h)^2.
//
// The exact lobe multiplies tan^2(gamma) by 1/m^2. FR_SMALL_SLOPE 1 keeps the product accurate for
// small m. A host whose m stays above 0.2 may turn the setting off, which saves a little time
// (docs/measurements/trade.md): #define FR_SMALL_SLOPE 0.
#ifndef FR_HALF_VECTOR_GLSL
#define FR_HALF_VECTOR_GLSL

#include "constants.glsl"

#ifndef FR_SMALL_SLOPE
#define FR_SMALL_SLOPE 1
#endif
#if FR_SMALL_SLOPE == 1
#define FR_COMPILED_SMALL_SLOPE 1
#else
#define FR_COMPILED_SMALL_SLOPE 0
#endif

// Squared length of the half vector, plus FR_FLOOR.
//
//   formula:  |h|^2 + FR_FLOOR; because of FR_FLOOR, the result may be a divisor
//   returns:  > 0.
//   error:    float32 rounding: 3e-7 times |h|^2, plus FR_FLOOR.
float fr_half_vector_square(vec3 h) {
    return h.x * h.x + (h.y * h.y + (h.z * h.z + FR_FLOOR));
}

vec2 fr_half_vector(vec3 n, vec3 h, float n_dot_h) {
    float along = n_dot_h * n_dot_h;
#if FR_SMALL_SLOPE == 1
    // If the length of n is 1 + e, `across` has an error of 2 e dot(n, h) along n. This error is
    // perpendicular to `across`, so that only its square, of order e^2, enters across2.
    vec3 across = h - n_dot_h * n;
    float across2 = dot(across, across);
    return vec2(along + across2, across2);
#else
    float h_dot_h = dot(h, h);
    return vec2(h_dot_h, abs(h_dot_h - along));  // A negative y would raise the lobe above 1.
#endif
}

#endif

#if FR_SMALL_SLOPE == FR_COMPILED_SMALL_SLOPE
#else
#error FR_SMALL_SLOPE differs from its value at the first include, or is neither 0 nor 1
#endif
