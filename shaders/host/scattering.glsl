// Pixels that scatter light. `place` is described in facerender/scatter.glsl; its w is the index of
// the profile, -1 for none.
// SEVERAL is defined if a pixel has several samples.
uniform sampler2D image;
uniform sampler2D place;
uniform float profile;

// Return the pixel whose surface represents `pixel`: usually `pixel` itself.
// If a surface covers some samples of the pixel but not its centre, return a neighbour.
ivec2 stand_in(ivec2 pixel) {
#ifdef SEVERAL
    if (texelFetch(image, pixel, 0).a == 0.0) return pixel;
    ivec2 last = textureSize(place, 0) - 1;
    ivec2 beside = pixel;
    for (int i = 0; i < 9 && texelFetch(place, beside, 0).w == 0.0; ++i) {
        beside = clamp(pixel + ivec2(i % 3, i / 3) - 1, ivec2(0), last);
    }
    return beside;
#else
    return pixel;
#endif
}
