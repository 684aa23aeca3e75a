// What every file of the library shares: precision, constants, and the slope.
#ifndef FR_CONSTANTS_GLSL
#define FR_CONSTANTS_GLSL

// GLSL ES gives fragment shaders no precision of their own, and with mediump tan^2(gamma)/m^2
// overflows at a slope of 0.004. It counts from here on, for the host's code too: a host that wants
// another says so after its includes.
#ifdef GL_ES
precision highp float;
#endif

#define FR_PI 3.14159265358979
#define FR_LOG2_E 1.44269504088896
#define FR_LN_2 0.693147180559945

// The power of 1/cos(gamma) in a model's lobe E/c^k.
#define FR_K_COOK_TORRANCE 4
#define FR_K_WARD 0

// Cosines of light and eye below this are mostly noise: a dot product of two float32 unit vectors
// carries an error near 1e-7. Errors are stated above it, and a BRDF that grows without end towards
// the horizon is 0 up to it.
#define FR_MIN_COSINE 1e-6

// What BRDFs add to (N.L)(N.V), (N.h)^2 and m^2 before they divide by them: the product of three of
// these, 6.4e-38, and its inverse are in float32's normal range, 1.2e-38 to 3.4e38. It rides on a
// multiplication: a comparison would cost an instruction.
#define FR_FLOOR 4e-13

// The smallest slope: its square is 2.5e4 times FR_FLOOR, and the peak 1/(4 m^2) is 2.5e7. BRDFs
// stay finite below it.
#define FR_MIN_SLOPE 1e-4

// The end of the domain of the exact lobe: what widens a slope widens it no further.
#define FR_MAX_SLOPE 2.0

// Whether m is a constant; where it is not, 1/m^2 shares a BRDF's one division.
#if defined(FR_SLOPE) && !defined(FR_CONSTANT_SLOPE)
#define FR_CONSTANT_SLOPE 1
#endif
#ifndef FR_CONSTANT_SLOPE
#define FR_CONSTANT_SLOPE 0
#endif

// The slope that every function reads in place of its m. A host whose m is one constant may say so,
// and the compiler folds all that depends on it: #define FR_SLOPE(m) 0.3
#ifndef FR_SLOPE
#define FR_SLOPE(m) (m)
#endif

#endif
