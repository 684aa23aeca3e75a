// Ward's isotropic specular BRDF: E/(4 pi m^2 sqrt((N.L)(N.V))); Ward (1992), eq. 4.
//
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope (Ward's alpha), in the domain of the chosen lobe (FR_LOBE), at least 1e-4
//   unit      1/sr, for a specular reflectance of 1; N.L is not included, 1/pi is
//   result    finite and >= 0; exactly 0 for a light or an eye below the surface; above it, N.L
//             and N.V below FR_MIN_COSINE count as that
//   error     that of the lobe; float32 adds up to 5e-7/m^2 + 1e-5 of what the lobe's peak gives
//             in the same directions (dot products of l + v)
#ifndef FR_WARD_GLSL
#define FR_WARD_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"

float fr_ward(vec3 n, vec3 l, vec3 v, float m) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    if (min(n_dot_l, n_dot_v) <= 0.0) return 0.0;
    n_dot_l = max(n_dot_l, FR_MIN_COSINE);
    n_dot_v = max(n_dot_v, FR_MIN_COSINE);
    float slope = max(m, FR_MIN_SLOPE);

    vec3 h = l + v;
    float lobe = fr_lobe(n_dot_l + n_dot_v, dot(h, h), slope, FR_K_WARD);
    return lobe * inversesqrt(n_dot_l * n_dot_v) / (4.0 * FR_PI * slope * slope);
}

#endif
