// Opacity of a fragment.
// With ALPHA_MASK, fragments with an opacity below alpha_cutoff are discarded. With ALPHA_BLEND,
// fragments are blended with the surfaces behind them. With OPACITY_CUT the opacity of a blended
// fragment is 0 below alpha_cutoff, otherwise 1.
#ifndef HOST_ALPHA_GLSL
#define HOST_ALPHA_GLSL

#include "host/texture_coordinates.glsl"

uniform float opacity;
#ifdef OPACITY_MAP
uniform sampler2D opacity_map;
#endif

#if defined(ALPHA_MASK) || defined(OPACITY_CUT)
uniform float alpha_cutoff;
#endif

float opacity_here() {
#ifdef OPACITY_MAP
    float own = opacity * texture(opacity_map, OPACITY_MAP_UV).r;
#else
    float own = opacity;
#endif
#ifdef OPACITY_CUT
    return own < alpha_cutoff ? 0.0 : 1.0;
#else
    return own;
#endif
}

#ifdef DEPTH_PEELING
// Previous layer of depth peeling. red: depth; green: index of the triangle; alpha: 0 if there is
// no layer.
uniform sampler2D previous_layer;

// Discard each fragment that is not behind the previous layer.
// At equal depth the triangle drawn last counts as the triangle in front.
void discard_previous_layers() {
    vec4 before = texelFetch(previous_layer, ivec2(gl_FragCoord.xy), 0);
    bool behind = gl_FragCoord.z > before.r;
    bool earlier = gl_FragCoord.z == before.r && float(gl_PrimitiveID) < before.g;
    if (before.a == 0.0 || !(behind || earlier)) discard;
}
#endif

#ifdef ALPHA_MASK
// Return the fraction of a fragment that remains after the alpha cutoff.
// TO_COVERAGE is the number of samples per pixel. If it is defined, the fraction may lie between 0
// and 1 in a pixel where the opacity crosses the cutoff. OpenGL converts the fraction to n covered
// samples (alpha to coverage). The offset of 0.25 gives n samples both on drivers that round to the
// nearest number and on drivers that round up, like Mesa.
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
