// Importance sampling of Ward's BRDF with the exact lobe, for path tracers.
//
//   formula:  half vectors from the distribution of slopes, l = 2 (V.H) H - V.
//             Density: E/(4 pi m^2 c^3 (V.H)), E = exp(-tan^2(gamma)/m^2)
//   n, v:     Unit vectors: normal, direction to the camera; N.V above FR_MIN_COSINE.
//   l:        Unit vector: direction to the light.
//   m:        Roughness: RMS slope of the microfacets (Ward's alpha), in [1e-4, 2].
//   u:        Two random numbers, uniform in [0, 1).
//   unit:     none for the sample; 1/sr for the density
//   returns:  A unit vector l. If N.L <= 0, l points below the surface and the BRDF is 0. The
//             weight of the sample, BRDF (N.L)/density, is c^3 (V.H) sqrt((N.L)/(N.V)); this weight
//             is unbounded only as N.V approaches 0. If the half vector points away from the
//             camera, l is -n.
//   error:    At most 1e-5 per component of l in float32, or 2^-10 if sine and cosine are only as
//             accurate as Vulkan requires.
//   source:   Ward (1992); Walter (2005), "Notes on the Ward BRDF".
#ifndef FR_WARD_SAMPLE_GLSL
#define FR_WARD_SAMPLE_GLSL

#include "constants.glsl"
#include "half_vector.glsl"
#include "slope_sample.glsl"

vec3 fr_ward_sample(vec3 n, vec3 v, float m, vec2 u) {
    vec3 h = n + fr_slope_sample(n, m, u);
    float v_dot_h = dot(v, h);
    return v_dot_h > 0.0 ? normalize(2.0 * v_dot_h / dot(h, h) * h - v) : -n;
}

// Probability density of fr_ward_sample.
//
//   unit:     1/sr
//   returns:  Finite and >= 0; 0 if N.V or N.L is at most FR_MIN_COSINE; this condition excludes
//             the pole at l = -v below the surface.
//   error:    float32 rounding: r of fr_ward (see cook_torrance.glsl), times the density in the
//             same directions, with the lobe replaced by its highest value.
float fr_ward_pdf(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    vec3 h = l + v;
    float n_dot_h = n_dot_l + n_dot_v;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    bool above = min(n_dot_l, n_dot_v) > FR_MIN_COSINE;
    float along = above ? n_dot_h * n_dot_h : 1.0;
    vec2 over = fr_half_vector(n, h, n_dot_h) / along;  // 1/c^2 and tan^2(gamma).
    float m2 = slope * slope;
    float d = exp2(-FR_LOG2_E * over.y / m2) * over.x;  // E/c^2; 1/(c (V.H)) is 2/(N.h).
    return above ? d / (2.0 * FR_PI * m2 * n_dot_h) : 0.0;
}

#endif
