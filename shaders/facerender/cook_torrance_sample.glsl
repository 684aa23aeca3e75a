// Importance sampling of Cook-Torrance with the exact lobe and V-cavities, for path tracers.
//
//   formula:  half vector H: a normal of the V-cavities that is visible from v; l = 2 (V.H) H - V.
//             Density: G1 D/(4 (N.V)), D = exp(-tan^2(gamma)/m^2)/(pi m^2 c^4),
//             G1 = min(1, 2 (N.H)(N.V)/(V.H))
//   n, v:     Unit vectors: normal, direction to the camera (in a path tracer, to the previous
//             vertex of the path); N.V above FR_MIN_COSINE.
//   l:        Unit vector: direction to the light.
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 2].
//   u:        Three random numbers, uniform in [0, 1).
//   unit:     none for the sample; 1/sr for the density
//   returns:  A unit vector l. If N.L <= 0, l points below the surface and the BRDF is 0. The
//             weight of the sample, BRDF (N.L)/density, is F G/G1, at most F.
//   error:    At most 1e-5 per component of l in float32, or 2^-10 if sine and cosine are only as
//             accurate as Vulkan requires. There is no bound where rounding decides which side of
//             the cavity is sampled.
//   source:   Heitz and d'Eon (2014), "Importance sampling microfacet-based BSDFs using the
//             distribution of visible normals"; tangent frame: Duff et al. (2017).
#ifndef FR_COOK_TORRANCE_SAMPLE_GLSL
#define FR_COOK_TORRANCE_SAMPLE_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "slope_sample.glsl"

vec3 fr_cook_torrance_sample(vec3 n, vec3 v, float m, vec3 u) {
    vec3 across = fr_slope_sample(n, m, u.xy);
    vec3 h = n + across;
    vec3 other = n - across;  // Normal of the other side of the cavity.
    float seen = max(dot(v, h), 0.0);
    float other_seen = max(dot(v, other), 0.0);
    if (u.z * (seen + other_seen) >= seen) h = other;
    return normalize(2.0 * dot(v, h) / dot(h, h) * h - v);
}

// Probability density of fr_cook_torrance_sample.
//
//   unit:     1/sr
//   returns:  Finite and >= 0; 0 if N.V or n.h = N.L + N.V is at most FR_MIN_COSINE.
//   error:    float32 rounding: r of fr_cook_torrance (see cook_torrance.glsl), times the density
//             in the same directions, with the lobe replaced by its highest value.
float fr_cook_torrance_pdf(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_v = dot(n, v);
    vec3 h = l + v;
    float n_dot_h = dot(n, l) + n_dot_v;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    bool above = min(n_dot_h, n_dot_v) > FR_MIN_COSINE;
    float along = above ? n_dot_h * n_dot_h : 1.0;
    vec2 over = fr_half_vector(n, h, n_dot_h) / along;  // 1/c^2 and tan^2(gamma).
    float m2 = slope * slope;
    float d = exp2(-FR_LOG2_E * over.y / m2) * over.x * over.x;
    float seen = min(1.0, 4.0 * n_dot_h * n_dot_v / (over.x * along));
    return above ? d * seen / (4.0 * FR_PI * m2 * n_dot_v) : 0.0;
}

#endif
