// How opaque the point under a fragment is: with ALPHA_MASK what is below alpha_cutoff is cut away, with
// ALPHA_BLEND what lies behind shows through.
#ifndef HOST_ALPHA_GLSL
#define HOST_ALPHA_GLSL

#include "host/texture_coordinates.glsl"

uniform float opacity;
#ifdef OPACITY_MAP
uniform sampler2D opacity_map;
#endif

float opacity_here() {
#ifdef OPACITY_MAP
    return opacity * texture(opacity_map, OPACITY_MAP_UV).r;
#else
    return opacity;
#endif
}

#ifdef DEPTH_PEELING
// Depth in the layer before in red, its triangle's number in green, and in alpha whether there is any.
uniform sampler2D previous_layer;

// Leaves what lies behind the layer before, or as deep and was drawn before it: at equal depth the
// last that is drawn stays.
void discard_previous_layers() {
    vec4 before = texelFetch(previous_layer, ivec2(gl_FragCoord.xy), 0);
    bool behind = gl_FragCoord.z > before.r;
    bool earlier = gl_FragCoord.z == before.r && float(gl_PrimitiveID) < before.g;
    if (before.a == 0.0 || !(behind || earlier)) discard;
}
#endif

#ifdef ALPHA_MASK
uniform float alpha_cutoff;

// Share of a fragment that is left. With TO_COVERAGE samples a pixel it may be a part, over the pixel
// in which the opacity crosses the cutoff, and OpenGL makes samples of it (alpha to coverage): as many
// as there are n, whether a driver rounds to the nearest number or, as Mesa, to the next above.
float share_left() {
    float alpha = opacity_here();
#ifdef TO_COVERAGE
    float width = fwidth(alpha);
    if (width > 1e-4) {
        float all = float(TO_COVERAGE);
        float n = floor(clamp((alpha - alpha_cutoff) / width + 0.5, 0.0, 1.0) * all + 0.5);
        return n < all ? (n - 0.25) / all : 1.0;
    }
#endif
    if (alpha < alpha_cutoff) discard;
    return 1.0;
}
#endif

#endif
