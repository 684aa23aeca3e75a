// Directional albedo of Cook-Torrance with the exact lobe, Schlick's Fresnel term and V-cavities.
// The albedo is the fraction of the light from one direction that the surface reflects.
// fr_albedo_fit computes the coefficients of a fit once per material; fr_albedo_of evaluates the
// fit for each direction.
//
//   formula:  integral of BRDF (N.L) over the hemisphere, fitted by a polynomial of degree 7 in the
//             square root of the cosine and of degree 4 in m
//   n_dot_v:  Cosine of the angle between normal and direction, in [0, 1]; clamped to at least
//             4e-4.
//   m:        Roughness: RMS slope of the microfacets; clamped to [0.05, 1].
//   f0:       Fresnel reflectance at normal incidence, in [0, 0.1].
//   fit:      Result of fr_albedo_fit, or a linear combination of such results: mix(fit1, fit0,
//             weight) for two lobes, ks * fit for a specular weight ks.
//   unit:     none
//   returns:  In [0, 1.02].
//   error:    If f0 <= 0.1, the albedo is 0 to 0.0125 too high. It is never too low, so that an
//             energy-conserving diffuse term adds no light. If f0 > 0.1, the error is up to 0.008
//             f0 larger in either direction. If m < 0.05 and N.V < 0.1, the albedo is too low.
//   source:   Kelemen and Szirmay-Kalos (2001), who tabulate the albedo; the coefficients are
//             computed by tools/fits/albedo.py.
#ifndef FR_ALBEDO_GLSL
#define FR_ALBEDO_GLSL

#include "constants.glsl"

// Polynomial coefficients of the albedo of one material.
//
//   returns:  Finite factors of s^0 to s^7 with s = 2 sqrt(cosine) - 1: s^0 to s^3 in the first
//             column, s^4 to s^7 in the second.
mat2x4 fr_albedo_fit(float m, float f0) {
    float t = (2.0 * clamp(FR_SLOPE(m), 0.05, 1.0) - 1.05) * (1.0 / 0.95);
    vec4 first_low = vec4(0.863348, 0.0726275, -0.313448, 0.189434)
        + t * (vec4(0.0781893, -0.135827, -0.321842, -0.568655)
        + t * (vec4(-0.12987, 0.369948, 0.878571, -1.02757)
        + t * (vec4(-0.0220138, -0.308854, 0.427615, 0.877151)
        + t * (vec4(0.0837679, -0.0602395, -1.03386, 0.367696)))));
    vec4 first_high = vec4(0.290153, -0.22919, -0.078561, 0.0763889)
        + t * (vec4(0.2594, 0.62927, -0.114966, -0.212311)
        + t * (vec4(-1.82168, 1.10468, 0.914632, -0.517819)
        + t * (vec4(-0.57507, -0.822087, 0.308167, 0.236421)
        + t * (vec4(1.86765, -0.544213, -0.932605, 0.336868)))));
    vec4 rest_low = vec4(0.0798003, -0.2461, 0.298349, 0.126182)
        + t * (vec4(-0.0509785, 0.0662001, -0.15041, 0.361314)
        + t * (vec4(0.0701351, 0.143383, -0.518808, -1.55276)
        + t * (vec4(-0.0488855, 0.229181, 0.134066, -0.77729)
        + t * (vec4(-0.00373464, -0.36135, 0.467996, 1.9972)))));
    vec4 rest_high = vec4(-0.369746, -0.147346, 0.178681, 0.0918043)
        + t * (vec4(0.207035, -0.64708, -0.113359, 0.327341)
        + t * (vec4(1.60055, 2.69811, -1.13989, -1.34385)
        + t * (vec4(-0.415289, 1.22936, 0.283205, -0.634385)
        + t * (vec4(-1.32783, -3.37024, 0.944013, 1.69686)))));
    return mat2x4(f0 * first_low + rest_low, f0 * first_high + rest_high);
}

// Directional albedo, evaluated from the result of fr_albedo_fit.
float fr_albedo_of(mat2x4 fit, float n_dot_v) {
    float s = 2.0 * max(sqrt(clamp(n_dot_v, 0.0, 1.0)), 0.02) - 1.0;
    vec4 powers = vec4(1.0, s, s * s, s * s * s);
    return dot(fit[0], powers) + powers.z * powers.z * dot(fit[1], powers);
}

// Cosine-weighted mean of the albedo over the hemisphere, from the result of fr_albedo_fit.
float fr_albedo_mean(mat2x4 fit) {
    return dot(fit[0], vec4(1.0, 3.0 / 5.0, 7.0 / 15.0, 13.0 / 35.0))
        + dot(fit[1], vec4(11.0 / 35.0, 17.0 / 63.0, 5.0 / 21.0, 7.0 / 33.0));
}

// Directional albedo of Cook-Torrance.
float fr_cook_torrance_albedo(float n_dot_v, float m, float f0) {
    return fr_albedo_of(fr_albedo_fit(m, f0), n_dot_v);
}

// Cosine-weighted mean of fr_cook_torrance_albedo over the hemisphere.
float fr_cook_torrance_albedo_mean(float m, float f0) {
    return fr_albedo_mean(fr_albedo_fit(m, f0));
}

// Factor that makes a Lambertian diffuse term energy-conserving.
//
//   formula:             (1 - albedo_l) (1 - albedo_v)/(1 - mean)
//   albedo_l, albedo_v:  Directional albedos of the specular term for the directions to the light
//                        and to the camera, times the specular weight; each clamped to at most 1.
//   mean:                Cosine-weighted mean of the directional albedo over the hemisphere;
//                        clamped to at most 0.5.
//   unit:                none
//   returns:             In [0, 2].
//   error:               None. If no albedo is too low, the diffuse and the specular term together
//                        reflect at most all of the light.
//   source:              Kelemen and Szirmay-Kalos (2001).
float fr_diffuse_coupled(float albedo_l, float albedo_v, float mean) {
    return (1.0 - min(albedo_l, 1.0)) * (1.0 - min(albedo_v, 1.0)) / (1.0 - min(mean, 0.5));
}

#endif
