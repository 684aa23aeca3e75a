// A slope drawn from the Beckmann distribution that all lobes here stand for, as a vector across
// the normal: n plus it points along a microfacet's normal.
//
//   formula   m sqrt(-ln(1 - x)) at an angle of 2 pi y about n
//   n         normal, a unit vector
//   m         rms slope, in [1e-4, 2]
//   u         two random numbers x and y, even in [0, 1); x from 1 on counts as 1 - 2^-24
//   unit      none: the tangent of the angle between normal and microfacet, and its direction
//   error     in float32 2e-6 (2 + its length) of each component, and where sine and cosine are as
//             Vulkan asks for, 2^-11, as much of its length: it is a slope of the distribution still
//   source    Walter et al. (2007), eq. 28; frame: Duff et al. (2017), "Building an orthonormal
//             basis, revisited"
#ifndef FR_SLOPE_SAMPLE_GLSL
#define FR_SLOPE_SAMPLE_GLSL

#include "constants.glsl"

vec3 fr_slope_sample(vec3 n, float m, vec2 u) {
    float side = n.z >= 0.0 ? 1.0 : -1.0;
    float a = -1.0 / (side + n.z);
    float b = n.x * n.y * a;
    vec3 tangent = vec3(1.0 + side * n.x * n.x * a, side * b, -side * n.x);
    vec3 bitangent = vec3(b, side + n.y * n.y * a, -n.y);
    // 2^-24 is the least that 1 - x can be for x < 1
    float length_ = max(FR_SLOPE(m), FR_MIN_SLOPE) * sqrt(-log(max(1.0 - u.x, 5.9604645e-8)));
    float angle = 2.0 * FR_PI * u.y;
    return length_ * (cos(angle) * tangent + sin(angle) * bitangent);
}

#endif
