// Adds to an image what scattering changes in the diffuse light of those pixels that scatter by one
// profile. OTHERS: draws the other pixels as they are.
#include "facerender/constants.glsl"
#include "facerender/scatter.glsl"

uniform sampler2D image;
uniform vec3 background;  // that the image lacks
uniform sampler2D light;  // this and place as facerender/scatter.glsl has it
uniform sampler2D place;
uniform sampler2D albedo;
uniform float profile;
uniform vec3 eye;
uniform vec3 forward;  // unit vector
uniform float pixels;  // of a unit of length across the view, at a depth of 1
uniform vec4[FR_SCATTER_GAUSSIANS] gaussians;
uniform vec3 rest;
uniform vec3[FR_SCATTER_SAMPLES] spiral;
out vec4 radiance;

// The pixel that stands for one: itself, or, where its centre sees nothing and its other samples do,
// a neighbour.
ivec2 stand_in(ivec2 pixel, float coverage) {
    if (coverage == 0.0 || texelFetch(place, pixel, 0).w != 0.0) return pixel;
    ivec2 last = textureSize(place, 0) - 1;
    for (int i = 0; i < 9; ++i) {
        ivec2 beside = clamp(pixel + ivec2(i % 3, i / 3) - 1, ivec2(0), last);
        if (texelFetch(place, beside, 0).w != 0.0) return beside;
    }
    return pixel;
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 seen = texelFetch(image, pixel, 0);
    radiance = seen + vec4((1.0 - seen.a) * background, 0.0);
    ivec2 at = stand_in(pixel, seen.a);
    vec4 shown = texelFetch(place, at, 0);
    if (shown.w != profile) {
#ifdef OTHERS
        return;
#else
        discard;
#endif
    }
    float scale = pixels / dot(shown.xyz - eye, forward);
    vec3 scattered = fr_scatter(light, place, at, scale, gaussians, rest, spiral);
    vec3 change = scattered - texelFetch(light, at, 0).rgb;
    radiance.rgb += seen.a * texelFetch(albedo, at, 0).rgb * change;
}
