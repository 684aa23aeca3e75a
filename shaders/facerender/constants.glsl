// Constants that every file of the library shares.
//
// A host may #define FR_MIN_COSINE or FR_MIN_SLOPE before its first include.
#ifndef FR_CONSTANTS
#define FR_CONSTANTS

#define FR_PI 3.14159265358979

// The power of 1/cos(gamma) in a model's lobe E/c^k.
#define FR_K_COOK_TORRANCE 4
#define FR_K_WARD 0

// Cosines below this are raised to it. A dot product of two float32 unit vectors carries an error
// near 1e-7, so smaller cosines are noise; and 1/(N.L N.V) = 1e12 times the largest peak, 2.5e7
// at FR_MIN_SLOPE, stays finite (float32 ends at 3.4e38).
#ifndef FR_MIN_COSINE
#define FR_MIN_COSINE 1e-6
#endif

// Slopes below this are raised to it: the peak 1/(4 m^2) is 2.5e7.
#ifndef FR_MIN_SLOPE
#define FR_MIN_SLOPE 1e-4
#endif

#endif
