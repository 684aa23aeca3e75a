// Ward's specular BRDF as Romanyuk et al. (2020) print it. To reproduce that paper and for nothing
// else: it is not reciprocal, and 0.707 times Ward at normal incidence. Use ward.glsl.
//
//   formula   E/(4 pi m^2 sqrt(N.V + L.H)), E = exp(-tan^2(gamma)/m^2)
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope (Ward's alpha), in the domain of the chosen lobe (FR_LOBE)
//   unit      1/sr, for a specular reflectance of 1; N.L is not included, 1/pi is
//   result    as of ward.glsl
//   error     as of ward.glsl
//   source    Romanyuk et al. (2020)
#ifndef FR_WARD_PRINTED_GLSL
#define FR_WARD_PRINTED_GLSL

#include "constants.glsl"
#include "ward.glsl"

// Ward's specular BRDF as printed, with a lobe of its own.
//
//   lobe      as for fr_ward_terms
float fr_ward_printed_terms(vec3 n, vec3 l, vec3 v, float m, int lobe) {
    float n_dot_l = max(dot(n, l), FR_MIN_COSINE);
    float n_dot_v = max(dot(n, v), FR_MIN_COSINE);
    float l_dot_h = 0.5 * length(l + v);
    return fr_ward_terms(n, l, v, m, lobe) * sqrt(n_dot_l * n_dot_v / (n_dot_v + l_dot_h));
}

// Ward's specular BRDF as printed, with the lobe that the host chose.
float fr_ward_printed(vec3 n, vec3 l, vec3 v, float m) {
    return fr_ward_printed_terms(n, l, v, m, FR_DEFAULT_LOBE);
}

#endif
