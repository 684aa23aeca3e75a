// Float precision, constants and the macro FR_SLOPE, which all files of the library share.
#ifndef FR_CONSTANTS_GLSL
#define FR_CONSTANTS_GLSL

// Fragment shaders of GLSL ES have no default float precision, and in mediump the lobe's
// exponent tan^2(gamma)/m^2 overflows at m = 0.004. This statement also applies to the host's code
// after the include. A host that needs another precision declares it after its includes.
#ifdef GL_ES
precision highp float;
#endif

#define FR_PI 3.14159265358979
#define FR_LOG2_E 1.44269504088896
#define FR_LN_2 0.693147180559945

// Power k in the lobe E/c^k of each model, with c = cos(gamma) = N.H.
#define FR_K_COOK_TORRANCE 4
#define FR_K_WARD 0

// Smallest meaningful N.L and N.V. Smaller cosines are mostly noise: a dot product of two float32
// unit vectors has an error near 1e-7. The error bounds of the BRDFs apply to larger cosines. A
// BRDF that is unbounded at the horizon returns 0 for cosines up to this value.
#define FR_MIN_COSINE 1e-6

// BRDFs add this value to the divisors (N.L)(N.V), (N.h)^2 and m^2. If all three are 0, the
// product of the sums is 6.4e-38. This product and its inverse are in the normal range of float32,
// 1.2e-38 to 3.4e38. The addition is free as part of a multiply-add; a comparison would cost an
// instruction.
#define FR_FLOOR 4e-13

// Smallest slope m. Its square is 2.5e4 times FR_FLOOR, and the peak 1/(4 m^2) of the distribution
// D is 2.5e7. BRDFs stay finite even for smaller slopes.
#define FR_MIN_SLOPE 1e-4

// Largest slope m of the exact lobe. Functions that increase m for unresolved detail clamp the
// result to this value.
#define FR_MAX_SLOPE 2.0

// FR_CONSTANT_SLOPE is 1 if m is a compile-time constant. If FR_CONSTANT_SLOPE is 0, a BRDF
// computes 1/m^2 as part of its only division.
#if defined(FR_SLOPE) && !defined(FR_CONSTANT_SLOPE)
#define FR_CONSTANT_SLOPE 1
#endif
#ifndef FR_CONSTANT_SLOPE
#define FR_CONSTANT_SLOPE 0
#endif

// Slope that every function reads instead of its parameter m. A host with one constant slope may
// define this macro, so that the compiler folds all dependent values: #define FR_SLOPE(m) 0.3
#ifndef FR_SLOPE
#define FR_SLOPE(m) (m)
#endif

#endif
