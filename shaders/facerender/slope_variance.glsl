// Slope variance: unresolved detail within a pixel or texel, or the extent of a disc light, treated
// as microfacets.
//
//   unit:     none: variance of the slopes along each of the two tangent axes
//   returns:  >= 0.
//   error:    Each function states its error and its float32 rounding.
//   source:   Variances of independent slopes add, as in Olano and Baker (2010), "LEAN mapping".
//
// Three variances widen the lobe: the variance of the normal map within a texel, of the curved mesh
// within a pixel, and of each disc light. The caller passes their sum to fr_slope_filtered.
#ifndef FR_SLOPE_VARIANCE_GLSL
#define FR_SLOPE_VARIANCE_GLSL

#include "constants.glsl"

// Standard deviation of the slopes that alpha = 1 encodes in a prepared normal map.
#define FR_MAP_DEVIATION 0.35

// Fraction of a normal map's variance that widens the lobe, in (0, 1]. Skin relief such as pores is
// mostly flat with few steep walls: a Gaussian distribution with the full variance has a lower peak
// than the real highlight.
#ifndef FR_MAP_SHARE
#define FR_MAP_SHARE 0.5
#endif

// Roughness m after adding unresolved slope variance.
//
//   formula:   sqrt(m^2 + 2 variance), clamped to [FR_MIN_SLOPE, FR_MAX_SLOPE]; the slopes of a
//              Beckmann distribution have the variance m^2/2
//   m:         Roughness: RMS slope of the microfacets, in [0, 2].
//   variance:  Unresolved slope variance, in [0, 1e18].
//   returns:   RMS slope, in [FR_MIN_SLOPE, FR_MAX_SLOPE].
//   error:     The formula is exact for independent, normally distributed slopes; float32 rounding:
//              4e-7 times the result.
float fr_slope_filtered(float m, float variance) {
    // The root comes last: compilers remove the root if only the square of the result is used.
    float least = FR_MIN_SLOPE * FR_MIN_SLOPE;
    return sqrt(clamp(m * m + 2.0 * variance, least, FR_MAX_SLOPE * FR_MAX_SLOPE));
}

// Slope variance within one texel of a prepared normal map, at any mip level.
//
//   formula:  FR_MAP_SHARE (0.35 alpha)^2, alpha = sqrt((1 - |N|)/|N|)/0.35, where N is the mean of
//             unit normals; (0.35 alpha)^2 is the variance v of the slopes, FR_MAP_SHARE is 0.5
//   alpha:    Alpha channel of the map, filtered together with red, green and blue, in [0, 1].
//   error:    The default 0.5 suits skin, whose relief is mostly flat with few steep walls
//             (docs/measurements/skin.md lists the errors). For normally distributed slopes define
//             FR_MAP_SHARE 1.0: with 0.5 the peak is too high, about (m^2 + 2 v)/(m^2 + v) times
//             the true peak, 1.34 times for sqrt(v) = 0.115 and m = 0.15, 1.13 times for m = 0.25;
//             with 1.0 the error is at most 4 %. Float32 rounding: 3e-7 times the result.
//   source:   Toksvig (2005), "Mipmapping normal maps"; here the map stores the standard deviation
//             instead of |N|.
float fr_slope_variance_map(float alpha) {
    float deviation = FR_MAP_DEVIATION * alpha;
    return FR_MAP_SHARE * deviation * deviation;
}

// Slope variance that represents the extent of a disc light.
//
//   formula:  (s/k)^2/32 (1 + 1/(V.H)^2), s/k = 2 tan(R/2)
//   s:        sin(R), with R the angle between the centre and the rim of the disc, in
//             [0, 20 degrees].
//   k:        (1 + cos(R))/2.
//   v_dot_h:  Cosine of the angle between the direction to the camera and the unit half vector, in
//             [0, 1]; clamped to at least sqrt(0.05).
//   returns:  >= 0. A disc of radius R has the variance R^2/4 per axis. The half vector has 1/4 of
//             this variance in the plane of L and V, and 1/(4 (V.H)^2) of it perpendicular to this
//             plane.
//   error:    Mean error of the specular light for m = 0.15 and 0.3: 3 % if the light is 20 degrees
//             from the camera, 7 % at 60 degrees, and 10 % at 110 degrees (for R up to 10 degrees).
//             Float32 rounding: 1e-6 times the result.
float fr_slope_variance_disc(float s, float k, float v_dot_h) {
    float width = s / k;
    return width * width * (0.03125 + 0.03125 / max(v_dot_h * v_dot_h, 0.05));
}

// Cosine term of a disc light: the mean of max(N.L, 0) over the disc.
//
//   formula:  k c for c >= s; 0 for c <= -s; k (c + s)^2/(4 s) for c between -s and s
//   c:        N.L of the centre of the disc, in [-1, 1].
//   s:        sin(R), with R the angle between the centre and the rim of the disc, in
//             [0, 30 degrees].
//   k:        (1 + cos(R))/2.
//   unit:     none
//   returns:  In [0, 1].
//   error:    The formula is exact for c >= s and for c <= -s. For c between -s and s, the error is
//             at most 0.0063 for R up to 10 degrees, 0.010 for R up to 30 degrees. Float32
//             rounding: 4e-7.
float fr_cosine_disc(float c, float s, float k) {
    float above = max(c + s, 0.0);
    return k * (c >= s ? c : above * above / (4.0 * max(s, 1e-30)));
}

#endif
