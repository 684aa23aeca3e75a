// Light that enters skin and leaves it beside: the irradiance around a pixel, by a profile of
// diffusion, from what an image holds of it.
//
//   source    profile: d'Eon and Luebke (2007), "Advanced techniques for realistic real-time skin
//             rendering", GPU Gems 3, chapter 14; samples in the image: Jimenez et al. (2009),
//             "Screen-space perceptual rendering of human skin", here with distances in space
//   error     against the profile's integral over a mesh: docs/measurements/skin.md; each function's
//             own, in float32 beside it
//   unit      lengths are of one unit, the host's; what is scattered has that of the image
//
//   gaussians  of the profile that are wider than half a pixel. Of one with the weight w, red,
//              green and blue, and the variance v > 0 in square units: w/(2 pi v), in all at most
//              1e8, and behind it -log2(e)/(2 v)
//   light      irradiance, red, green, blue, in [0, 1e12]; behind it how much more surface a pixel
//              shows than if it faced the eye, fr_scatter_area of the mesh's normal
//   place      position of what a pixel shows; behind it a number other than 0 that surfaces share
//              which scatter into each other. Both are float textures without filtering
#ifndef FR_SCATTER_GLSL
#define FR_SCATTER_GLSL

#include "constants.glsl"

#ifdef GL_ES
precision highp sampler2D;
precision highp int;
#endif

// How many pixels fr_scatter looks at.
#ifndef FR_SCATTER_SAMPLES
#define FR_SCATTER_SAMPLES 16
#endif

// How many Gaussians a profile has.
#ifndef FR_SCATTER_GAUSSIANS
#define FR_SCATTER_GAUSSIANS 4
#endif

// Share of the light that falls on a point and leaves the skin at another, for each area there.
//
//   formula   sum of w exp(-r^2/(2 v))/(2 pi v)
//   r2        squared distance, in [0, 1e18]
//   unit      1 over square units
//   error     float32 adds 1e-6 of the value at r2 = 0
vec3 fr_scatter_profile(float r2, vec4[FR_SCATTER_GAUSSIANS] gaussians) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < FR_SCATTER_GAUSSIANS; ++i) {
        sum += gaussians[i].rgb * exp2(gaussians[i].a * r2);
    }
    return sum;
}

// How much more surface a pixel shows than if it faced the eye.
//
//   formula   1/max(|c|, 0.2)
//   c         N.V, in [-1, 1]
//   unit      none, in [1, 5]
//   error     none but float32's, 2e-7; of cosines below 0.2 it is too little, for few pixels show
//             what is there
float fr_scatter_area(float c) {
    return 1.0 / max(abs(c), 0.2);
}

// An angle of its own for each pixel, different from that of its neighbours: noise of what else were
// bands.
//
//   formula   2 pi fract(52.983 fract(0.06711056 x + 0.00583715 y)) - pi, in whole numbers
//   pixel     column and row
//   unit      radians, in [-pi, pi]
//   error     none but float32's, 4e-7
//   source    Jimenez (2014), "Next generation post processing in Call of Duty: Advanced Warfare"
float fr_scatter_turn(ivec2 pixel) {
    uint inner = uint(pixel.x) * 288237660u + uint(pixel.y) * 25070368u;
    uint outer = inner * 53u - inner / 59u;
    return float(int(outer >> 8) - 8388608) * (FR_PI / 8388608.0);
}

// Irradiance of a pixel after scattering.
//
//   formula   rest E + (1 - rest) (sum of w E_i)/(sum of w), w = area_i R(d_i)/density_i, of the
//             pixels i at the places of a spiral, where d_i is the distance in space from what the
//             pixel shows to what pixel i shows; 1e-3 of the pixel's own irradiance is added, for
//             where nothing is near. What lies outside of the image is left out
//   pixel     column and row, with a number other than 0
//   scale     pixels of a unit of length across the view, at the pixel's depth
//   rest      share of each channel that leaves where it enters: 1 less the weights of the Gaussians
//   spiral    places around the pixel, before they are turned, in units of length, and 1 over the
//             density of places there, in [0, 1e12]: more, with the most light and profile, would
//             overflow; such as radii by the distribution of the profile, and angles 2.39996 i
//             (Vogel 1979)
//   error     8 samples 17 of 255 at 99 % of the pixels of a face, 16 11, 32 8, 64 7; float32 adds
//             1e-5 of the largest irradiance, but where a place rounds into another pixel
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
