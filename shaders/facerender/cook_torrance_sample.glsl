// Directions drawn as Cook-Torrance with the exact lobe and V-cavities reflects them, and their
// density: importance sampling for path tracers.
//
//   formula   half vectors from the normals that v sees of V-cavities, l = 2 (V.H) H - V; density
//             G1 D/(4 (N.V)), D = exp(-tan^2(gamma)/m^2)/(pi m^2 c^4) and
//             G1 = min(1, 2 (N.H)(N.V)/(V.H))
//   n, v      unit vectors: normal, and towards the eye, where light comes from in a path tracer;
//             N.V above FR_MIN_COSINE
//   l         unit vector towards the light
//   m         rms slope, in [1e-4, 2]
//   u         three random numbers, even in [0, 1)
//   unit      none; of the density 1/sr
//   result    of the sample a unit vector, below the surface where N.L <= 0: the BRDF is 0 there.
//             The weight, BRDF (N.L)/density, is F G/G1, at most F
//   error     of the sample's components in float32 1e-5, or where sine and cosine are as Vulkan asks
//             for 2^-10, but where the choice of a cavity's side is that close
//   source    Heitz and d'Eon (2014), "Importance sampling microfacet-based BSDFs using the
//             distribution of visible normals"; frame: Duff et al. (2017)
#ifndef FR_COOK_TORRANCE_SAMPLE_GLSL
#define FR_COOK_TORRANCE_SAMPLE_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "slope_sample.glsl"

vec3 fr_cook_torrance_sample(vec3 n, vec3 v, float m, vec3 u) {
    vec3 across = fr_slope_sample(n, m, u.xy);
    vec3 h = n + across;
    vec3 other = n - across;  // the other side of the cavity
    float seen = max(dot(v, h), 0.0);
    float other_seen = max(dot(v, other), 0.0);
    if (u.z * (seen + other_seen) >= seen) h = other;
    return normalize(2.0 * dot(v, h) / dot(h, h) * h - v);
}

// Density of fr_cook_torrance_sample.
//
//   unit      1/sr
//   result    finite and >= 0; 0 where N.V or N.H is not above FR_MIN_COSINE
//   error     float32 adds, of the highest density in the same directions, what it adds to
//             fr_cook_torrance
float fr_cook_torrance_pdf(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_v = dot(n, v);
    vec3 h = l + v;
    float n_dot_h = dot(n, l) + n_dot_v;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    bool above = min(n_dot_h, n_dot_v) > FR_MIN_COSINE;
    float along = above ? n_dot_h * n_dot_h : 1.0;
    vec2 over = fr_half_vector(n, h, n_dot_h) / along;  // 1/c^2 and tan^2(gamma)
    float m2 = slope * slope;
    float d = exp2(-FR_LOG2_E * over.y / m2) * over.x * over.x;
    float seen = min(1.0, 4.0 * n_dot_h * n_dot_v / (over.x * along));
    return above ? d * seen / (4.0 * FR_PI * m2 * n_dot_v) : 0.0;
}

#endif
