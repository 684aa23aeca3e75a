// Triangles of a part that the samples of a pixel see, from the output of visibility.frag.
#if SAMPLES > 1
uniform sampler2DMS visible;
#else
uniform sampler2D visible;
#endif
uniform int first;        // Number of the first triangle of the part.
uniform int triangle_count;  // Number of triangles of the part.

// Return the number of the triangle in the part that a sample sees. The number is triangle_count or
// more if the sample sees another part.
uint triangle_at(int index) {
    return uint(int(texelFetch(visible, ivec2(gl_FragCoord.xy), index).r) - first);
}
