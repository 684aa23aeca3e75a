// Directions drawn for Ward's BRDF with the exact lobe, and their density: importance sampling for
// path tracers.
//
//   formula   half vectors from the slopes' distribution, l = 2 (V.H) H - V; density
//             E/(4 pi m^2 c^3 (V.H)), E = exp(-tan^2(gamma)/m^2)
//   n, v      unit vectors: normal, and towards the eye; N.V above FR_MIN_COSINE
//   l         unit vector towards the light
//   m         rms slope (Ward's alpha), in [1e-4, 2]
//   u         two random numbers, even in [0, 1)
//   unit      none; of the density 1/sr
//   result    of the sample a unit vector, below the surface where N.L <= 0: there the BRDF is 0;
//             -n where the half vector is turned away. The weight, BRDF (N.L)/density, is
//             c^3 (V.H) sqrt((N.L)/(N.V)), which grows without bound only at grazing N.V
//   error     of the sample's components in float32 1e-5, or where sine and cosine are as Vulkan asks
//             for 2^-10
//   source    Ward (1992); Walter (2005), "Notes on the Ward BRDF"
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

// Density of fr_ward_sample.
//
//   unit      1/sr
//   result    finite and >= 0; 0 where N.V or N.L is not above FR_MIN_COSINE: below the surface it
//             would have a pole at l = -v
//   error     float32 adds, of the highest density in the same directions, what it adds to fr_ward
float fr_ward_pdf(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    vec3 h = l + v;
    float n_dot_h = n_dot_l + n_dot_v;
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    bool above = min(n_dot_l, n_dot_v) > FR_MIN_COSINE;
    float along = above ? n_dot_h * n_dot_h : 1.0;
    vec2 over = fr_half_vector(n, h, n_dot_h) / along;  // 1/c^2 and tan^2(gamma)
    float m2 = slope * slope;
    float d = exp2(-FR_LOG2_E * over.y / m2) * over.x;  // E/c^2; 1/(c (V.H)) is 2/(N.h)
    return above ? d / (2.0 * FR_PI * m2 * n_dot_h) : 0.0;
}

#endif
