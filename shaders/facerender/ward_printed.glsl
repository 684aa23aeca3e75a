// Ward's specular BRDF as published by Romanyuk et al. (2020).
// The function serves only to reproduce their paper: the BRDF is not reciprocal, and at normal
// incidence it is 0.707 times Ward's BRDF. In all other cases use ward.glsl.
//
//   formula:  E/(4 pi m^2 sqrt(N.V + L.H)), E = exp(-tan^2(gamma)/m^2)
//   n, l, v:  Unit vectors: normal, direction to the light, direction to the camera.
//   m:        Roughness: RMS slope of the microfacets (Ward's alpha), in the domain of the lobe
//             (FR_LOBE).
//   unit:     1/sr, for a specular reflectance of 1; includes 1/pi, excludes N.L
//   returns:  See ward.glsl.
//   error:    See ward.glsl.
//   source:   Romanyuk et al. (2020).
#ifndef FR_WARD_PRINTED_GLSL
#define FR_WARD_PRINTED_GLSL

#include "constants.glsl"
#include "ward.glsl"

// Ward's specular BRDF as published by Romanyuk et al. (2020), with the lobe that `lobe` selects.
//
//   lobe:     See fr_ward_terms.
float fr_ward_printed_terms(vec3 n, vec3 l, vec3 v, float m, int lobe) {
    float n_dot_l = max(dot(n, l), FR_MIN_COSINE);
    float n_dot_v = max(dot(n, v), FR_MIN_COSINE);
    float l_dot_h = 0.5 * length(l + v);
    return fr_ward_terms(n, l, v, m, lobe) * sqrt(n_dot_l * n_dot_v / (n_dot_v + l_dot_h));
}

// Ward's specular BRDF as published by Romanyuk et al. (2020), with the lobe that FR_LOBE selects.
float fr_ward_printed(vec3 n, vec3 l, vec3 v, float m) {
    return fr_ward_printed_terms(n, l, v, m, FR_DEFAULT_LOBE);
}

#endif
