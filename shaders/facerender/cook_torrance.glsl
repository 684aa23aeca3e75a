// Cook-Torrance specular BRDF: F G D/(pi (N.L)(N.V)) with D = E/(4 m^2 c^4); Cook and Torrance
// (1982), in the normalisation used since (Walter et al. 2007: F G D'/(4 (N.L)(N.V)), D' = 4D/pi).
//
//   n, l, v   unit vectors: normal, towards the light, towards the eye
//   m         rms slope, in the domain of the chosen lobe (FR_LOBE), at least 1e-4
//   f0        Fresnel reflectance at normal incidence, in [0, 1)
//   unit      1/sr, for a specular weight ks = 1; N.L is not included, 1/pi is
//   result    finite and >= 0; exactly 0 for a light or an eye below the surface; above it, N.L
//             and N.V below FR_MIN_COSINE count as that
//   error     that of the lobe; float32 adds up to 5e-7/m^2 + 1e-5 of what the lobe's peak gives
//             in the same directions (dot products of l + v)
#ifndef FR_COOK_TORRANCE_GLSL
#define FR_COOK_TORRANCE_GLSL

#include "facerender/constants.glsl"
#include "facerender/lobe.glsl"
#include "facerender/fresnel.glsl"
#include "facerender/masking.glsl"

float fr_cook_torrance(vec3 n, vec3 l, vec3 v, float m, float f0) {
    float n_dot_l = dot(n, l);
    float n_dot_v = dot(n, v);
    if (min(n_dot_l, n_dot_v) <= 0.0) return 0.0;
    n_dot_l = max(n_dot_l, FR_MIN_COSINE);
    n_dot_v = max(n_dot_v, FR_MIN_COSINE);
    float slope = max(m, FR_MIN_SLOPE);

    // h = l + v keeps its length: V.H = |h|/2, and the masking needs only (N.h)/(V.h).
    vec3 h = l + v;
    float h_dot_h = dot(h, h);
    float n_dot_h = n_dot_l + n_dot_v;
    float fresnel = fr_fresnel(f0, 0.5 * sqrt(h_dot_h));
    float masking = fr_masking_v_cavity(n_dot_h, 0.5 * h_dot_h, n_dot_l, n_dot_v);
    float d = fr_lobe(n_dot_h, h_dot_h, slope, FR_K_COOK_TORRANCE) / (4.0 * slope * slope);
    return fresnel * masking * d / (FR_PI * n_dot_l * n_dot_v);
}

#endif
