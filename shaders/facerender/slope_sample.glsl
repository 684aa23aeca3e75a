// Random slope from the exact lobe's Beckmann distribution: a vector in the tangent plane.
// The sum of the normal and the slope points along the normal of a microfacet.
//
//   formula:  m sqrt(-ln(1 - x)) at the angle 2 pi y around n
//   n:        Unit vector: normal.
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 2].
//   u:        Two random numbers x and y, uniform in [0, 1); x is clamped to at most 1 - 2^-24.
//   unit:     none
//   returns:  Vector in the direction of the slope; its length is the tangent of the angle between
//             the normals of the surface and of the microfacet.
//   error:    float32 rounding, per component: 2e-6 (2 + length of the slope). If sine and cosine
//             are only as accurate as Vulkan requires, 2^-11, the error is larger by 2^-11 times
//             the length of the slope; the result is still a slope of the distribution.
//   source:   Walter et al. (2007), eq. 28; tangent frame: Duff et al. (2017), "Building an
//             orthonormal basis, revisited".
#ifndef FR_SLOPE_SAMPLE_GLSL
#define FR_SLOPE_SAMPLE_GLSL

#include "constants.glsl"

vec3 fr_slope_sample(vec3 n, float m, vec2 u) {
    float side = n.z >= 0.0 ? 1.0 : -1.0;
    float a = -1.0 / (side + n.z);
    float b = n.x * n.y * a;
    vec3 tangent = vec3(1.0 + side * n.x * n.x * a, side * b, -side * n.x);
    vec3 bitangent = vec3(b, side + n.y * n.y * a, -n.y);
    // 2^-24 is the smallest 1 - x for a float32 x < 1.
    float length_ = max(FR_SLOPE(m), FR_MIN_SLOPE) * sqrt(-log(max(1.0 - u.x, 5.9604645e-8)));
    float angle = 2.0 * FR_PI * u.y;
    return length_ * (cos(angle) * tangent + sin(angle) * bitangent);
}

#endif
