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

// The power of 1/cos(gamma) in a model's lobe E/c^k.
#define FR_K_COOK_TORRANCE 4
#define FR_K_WARD 0

// A light or an eye whose cosine is not above this counts as below the surface. A dot product of
// two float32 unit vectors carries an error near 1e-7, so smaller cosines are mostly noise; and the
// smallest divisor, (N.L)(N.V)(N.h)^2 m^2 = 1e-12 * 4e-12 * 1e-8 = 4e-32 at FR_MIN_SLOPE, and its
// inverse stay in float32's normal range, 1.2e-38 to 3.4e38.
#define FR_MIN_COSINE 1e-6

// BRDFs raise slopes below this to it: see FR_MIN_COSINE; the peak 1/(4 m^2) is then 2.5e7.
#define FR_MIN_SLOPE 1e-4

// The end of the domain of the exact lobe: what widens a slope widens it no further.
#define FR_MAX_SLOPE 2.0

// The slope that every function reads in place of its m. A host whose m is one constant may say so,
// and the compiler folds all that depends on it: #define FR_SLOPE(m) 0.3
#ifndef FR_SLOPE
#define FR_SLOPE(m) (m)
#endif

#endif
