// Ward's specular BRDF as Romanyuk et al. (2020) print it, E/(4 pi m^2 sqrt(N.V + L.H)), to
// reproduce that paper and for nothing else: it is not reciprocal, and 0.707 times Ward at normal
// incidence. Use ward.glsl.
//
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope (Ward's alpha), in the domain of the chosen lobe (FR_LOBE), at least 1e-4
//   unit      1/sr, for a specular reflectance of 1; N.L is not included, 1/pi is
//   result    finite and >= 0; exactly 0 for a light or an eye below the surface; above it, N.L
//             and N.V below FR_MIN_COSINE count as that
//   error     that of the lobe; float32 adds up to 5e-7/m^2 + 1e-5 of what the lobe's peak gives
//             in the same directions (dot products of l + v)
#ifndef FR_WARD_PRINTED_GLSL
#define FR_WARD_PRINTED_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"

float fr_ward_printed(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    if (min(n_dot_l, n_dot_v) <= 0.0) return 0.0;
    n_dot_l = max(n_dot_l, FR_MIN_COSINE);
    n_dot_v = max(n_dot_v, FR_MIN_COSINE);
    float slope = max(m, FR_MIN_SLOPE);

    vec3 h = l + v;
    float h_dot_h = dot(h, h);
    float l_dot_h = 0.5 * sqrt(h_dot_h);
    float lobe = fr_lobe(n_dot_l + n_dot_v, h_dot_h, slope, FR_K_WARD);
    return lobe * inversesqrt(n_dot_v + l_dot_h) / (4.0 * FR_PI * slope * slope);
}

#endif
