// Which facets of a part the samples of a pixel see, as visibility.frag wrote them.
#if SAMPLES > 1
uniform sampler2DMS visible;
#else
uniform sampler2D visible;
#endif
uniform int first;        // of the part
uniform int facet_count;  // of the part

// The facet that a sample sees; at or above facet_count if it is none of the part.
uint facet_at(int index) {
    return uint(int(texelFetch(visible, ivec2(gl_FragCoord.xy), index).r) - first);
}
