// Slope variance: what a pixel, a texel or the size of a light leaves unresolved, as microfacets.
//
//   unit      none; variances are of slopes, along each of two axes
//   error     each function's own, in float32 beside it
//   source    variances of independent slopes add, as in Olano and Baker (2010), "LEAN mapping"
//
// Each of these widens the lobe by its variance, added up before fr_slope_filtered: the normal map's
// in its texels, the mesh's curvature over a pixel, a light's disc, light by light.
#ifndef FR_SLOPE_VARIANCE_GLSL
#define FR_SLOPE_VARIANCE_GLSL

#include "constants.glsl"

// The deviation of slopes that alpha = 1 stands for in a prepared normal map.
#define FR_MAP_DEVIATION 0.35

// The share of a map's variance that widens the lobe. Relief such as pores is mostly flat with few
// steep walls: the normal distribution of all its variance has a lower peak than its highlight.
#define FR_MAP_SHARE 0.5

// The largest variance that fr_slope_variance_pixel gives: at a silhouette the normal turns without
// end, and lobes have a domain.
#define FR_MAX_PIXEL_VARIANCE 0.1

// Slope of microfacets that have the slope m and, unresolved, slopes of a variance.
//
//   formula    sqrt(m^2 + 2 variance), between FR_MIN_SLOPE and FR_MAX_SLOPE: Beckmann's slopes have
//              variance m^2/2
//   m          rms slope, in [0, 2]
//   variance   in [0, 1e18]
//   error      none for independent normal slopes; float32 adds 4e-7 of the result
float fr_slope_filtered(float m, float variance) {
    // The root last: where only the square of the result is used, compilers leave it out.
    float least = FR_MIN_SLOPE * FR_MIN_SLOPE;
    return sqrt(clamp(m * m + 2.0 * variance, least, FR_MAX_SLOPE * FR_MAX_SLOPE));
}

// Slope variance of the texels that one of a prepared normal map's levels stands for (facerender
// shaders prepare-normal-map).
//
//   formula   0.5 (0.35 alpha)^2, alpha = sqrt((1 - |N|)/|N|)/0.35 of the mean N of unit normals
//   alpha     of the map, filtered with its red, green and blue, in [0, 1]
//   error     docs/measurements/skin.md has what remains of a highlight's error; float32 adds 3e-7
//             of the result
//   source    Toksvig (2005), "Mipmapping normal maps", with the variance kept in place of |N|
float fr_slope_variance_map(float alpha) {
    float deviation = FR_MAP_DEVIATION * alpha;
    return FR_MAP_SHARE * deviation * deviation;
}

// Slope variance of a curved mesh over a pixel.
//
//   formula    (|n_x|^2 + |n_y|^2)/24, at most 0.1: half of it an axis, times the variance 1/12 of a
//              place in a box
//   n_x, n_y   how much the unit normal of the mesh, without its map, changes from a pixel to the
//              next, such as dFdx(n) and dFdy(n)
//   error      that of the normal as a linear function over the pixel; float32 adds 5e-7 of the
//              result
//   source     Kaplanyan et al. (2016), Tokuyoshi and Kaplanyan (2019), with a box of one pixel
float fr_slope_variance_pixel(vec3 n_x, vec3 n_y) {
    return min((dot(n_x, n_x) + dot(n_y, n_y)) / 24.0, FR_MAX_PIXEL_VARIANCE);
}

// Slope variance that a light of the shape of a disc adds, as seen from the surface.
//
//   formula   (s/k)^2/32 (1 + 1/(V.H)^2), s/k = 2 tan(R/2): a disc of radius R has variance R^2/4 an
//             axis, of which the half vector takes 1/4 in the plane of L and V, and 1/(4 (V.H)^2)
//             across
//   s         sin(R), R the angle between the disc's centre and its rim; R in [0, 20 degrees]
//   k         (1 + cos(R))/2
//   v_dot_h   cosine of eye and unit half vector, in [0, 1]; one below sqrt(0.05) counts as that
//   error     of the specular light, in the mean, for m = 0.15 and 0.3: 3 % with the light 20 degrees
//             from the eye, 7 % at 60, and to R = 10 degrees 10 % at 110; float32 adds 1e-6
float fr_slope_variance_disc(float s, float k, float v_dot_h) {
    float width = s / k;
    return width * width * (0.03125 + 0.03125 / max(v_dot_h * v_dot_h, 0.05));
}

// Cosine at which a surface receives the light of a disc: the mean of max(N.L, 0) over it.
//
//   formula   k c for c >= s, 0 for c <= -s, between them k (c + s)^2/(4 s)
//   c         N.L of the disc's centre, in [-1, 1]
//   s         sin(R), R the angle between the disc's centre and its rim; R in [0, 30 degrees]
//   k         (1 + cos(R))/2
//   unit      none, in [0, 1]
//   error     none for c >= s or c <= -s; between them 0.0063 to R = 10 degrees, 0.010 to 30; float32
//             adds 4e-7
float fr_cosine_disc(float c, float s, float k) {
    float above = max(c + s, 0.0);
    return k * (c >= s ? c : above * above / (4.0 * max(s, 1e-30)));
}

#endif
