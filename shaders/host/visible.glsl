// Which triangles of a part the samples of a pixel see, as visibility.frag wrote them.
#if SAMPLES > 1
uniform sampler2DMS visible;
#else
uniform sampler2D visible;
#endif
uniform int first;        // of the part
uniform int triangle_count;  // of the part

// The triangle that a sample sees; at or above triangle_count if it is none of the part.
uint triangle_at(int index) {
    return uint(int(texelFetch(visible, ivec2(gl_FragCoord.xy), index).r) - first);
}
