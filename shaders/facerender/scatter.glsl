// Subsurface scattering in image space: mean irradiance around a pixel, weighted by a diffusion
// profile.
//
//   source:   Profile: d'Eon and Luebke (2007), "Advanced techniques for realistic real-time skin
//             rendering", GPU Gems 3, chapter 14; samples in the image: Jimenez et al. (2009),
//             "Screen-space perceptual rendering of human skin", here with distances between 3D
//             positions.
//   error:    docs/measurements/skin.md compares the result with the integral of the profile over a
//             mesh. Each function states its float32 rounding.
//   unit:     lengths: unit of the host; scattered light: unit of the image
//
//   gaussians:  Gaussians of the profile, except Gaussians narrower than half a pixel. For the
//               weight w (red, green, blue) and the variance v > 0 in square units, rgb:
//               w/(2 pi v), whose sum over the Gaussians is at most 1e8; a: -log2(e)/(2 v).
//   light:      Float texture without filtering. rgb: irradiance, in [0, 1e12]; a: result of
//               fr_scatter_area for the normal of the mesh.
//   place:      Float texture without filtering. xyz: position of the surface; w: a number other
//               than 0, equal for surfaces that scatter into each other.
#ifndef FR_SCATTER_GLSL
#define FR_SCATTER_GLSL

#include "constants.glsl"

#ifdef GL_ES
precision highp sampler2D;
precision highp int;
#endif

// Number of pixels that fr_scatter samples around each pixel.
#ifndef FR_SCATTER_SAMPLES
#define FR_SCATTER_SAMPLES 16
#endif

// Number of Gaussians in a profile.
#ifndef FR_SCATTER_GAUSSIANS
#define FR_SCATTER_GAUSSIANS 4
#endif

// Of the light that enters at one point, the fraction that leaves at another point, per unit area.
//
//   formula:  sum of w exp(-r^2/(2 v))/(2 pi v)
//   r2:       Squared distance between the two points, in [0, 1e18].
//   unit:     1/(square unit)
//   returns:  >= 0.
//   error:    float32 rounding: 1e-6 of the value at r2 = 0.
vec3 fr_scatter_profile(float r2, vec4[FR_SCATTER_GAUSSIANS] gaussians) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < FR_SCATTER_GAUSSIANS; ++i) {
        sum += gaussians[i].rgb * exp2(gaussians[i].a * r2);
    }
    return sum;
}

// Surface area that a pixel shows, divided by the area it would show if the surface faced the
// camera.
//
//   formula:  1/max(|c|, 0.2)
//   c:        N.V, in [-1, 1].
//   unit:     none
//   returns:  In [1, 5].
//   error:    float32 rounding: 2e-7. For |c| < 0.2 the area is too low; few pixels show such
//             surfaces.
float fr_scatter_area(float c) {
    return 1.0 / max(abs(c), 0.2);
}

// Rotation angle of a pixel's samples. The angle differs between adjacent pixels, which turns
// banding into noise.
//
//   formula:  2 pi fract(52.983 fract(0.06711056 x + 0.00583715 y)) - pi, computed with integers
//   pixel:    Column and row of the pixel.
//   unit:     radians
//   returns:  In [-pi, pi].
//   error:    float32 rounding: 4e-7.
//   source:   Jimenez (2014), "Next generation post processing in Call of Duty: Advanced Warfare".
float fr_scatter_turn(ivec2 pixel) {
    uint inner = uint(pixel.x) * 288237660u + uint(pixel.y) * 25070368u;
    uint outer = inner * 53u - inner / 59u;
    return float(int(outer >> 8) - 8388608) * (FR_PI / 8388608.0);
}

// Irradiance of a pixel after scattering.
//
//   formula:  rest E + (1 - rest) (sum of w E_i)/(sum of w), w = area_i R(d_i)/density_i, with R
//             the profile
//   pixel:    Column and row of a pixel where place.w is not 0.
//   scale:    Pixels per unit of length across the view, at the depth of the pixel.
//   rest:     Fraction of the light in each channel that leaves where it enters: 1 minus the sum of
//             the Gaussians' weights.
//   spiral:   xy: offset of each sample from the pixel, before the rotation, in units of length; z:
//             1/density of the samples at this offset, in [0, 1e12]. With larger z the result may
//             overflow if irradiance and profile have their largest values.
//             Example: radii distributed as the profile, angles 2.39996 i (Vogel 1979).
//   unit:     unit of the image
//   returns:  >= 0. In the formula, the sums run over the pixels i of the spiral; d_i is the
//             distance between the surface positions in the pixel and in pixel i. Both sums include
//             the pixel itself with w = 1e-3, in case no other surface is near. Pixels outside the
//             image are skipped.
//   error:    In 8-bit levels, at 99 % of the pixels of two heads: at most 18 with 8 samples, 14
//             with 16, 12 with 32, 11 with 64 (docs/measurements/skin.md). Float32 rounding: 1e-5 of the largest
//             irradiance, except where a sample rounds into another pixel.
vec3 fr_scatter(
    sampler2D light, sampler2D place, ivec2 pixel, float scale,
    vec4[FR_SCATTER_GAUSSIANS] gaussians, vec3 rest, vec3[FR_SCATTER_SAMPLES] spiral
) {
    ivec2 size = textureSize(place, 0);
    vec4 own = texelFetch(place, pixel, 0);
    vec3 entered = texelFetch(light, pixel, 0).rgb;
    float turn = fr_scatter_turn(pixel);
    mat2 turned = scale * mat2(cos(turn), sin(turn), -sin(turn), cos(turn));
    vec2 middle = vec2(pixel) + 0.5;
    vec3 norm = vec3(1e-3);
    vec3 sum = norm * entered;
    for (int i = 0; i < FR_SCATTER_SAMPLES; ++i) {
        ivec2 at = ivec2(floor(middle + turned * spiral[i].xy));
        if (at != clamp(at, ivec2(0), size - 1)) continue;
        vec4 other = texelFetch(place, at, 0);
        if (other.w != own.w) continue;
        vec4 received = texelFetch(light, at, 0);
        vec3 away = other.xyz - own.xyz;
        float area = received.a * spiral[i].z;
        vec3 weight = area * fr_scatter_profile(dot(away, away), gaussians);
        sum += weight * received.rgb;
        norm += weight;
    }
    return mix(sum / norm, entered, rest);
}

#endif
