// Triangles of a part that the samples of a pixel see, from the output of visibility.frag.
#if SAMPLES > 1
uniform sampler2DMS visible;
#else
uniform sampler2D visible;
#endif
uniform ivec2 triangles;  // Index of the first triangle of the part, and number of its triangles.

// Return the index, within the part, of the triangle that a sample sees: triangles.y or more if the sample sees another part.
uint triangle_at(int index) {
    return uint(int(texelFetch(visible, ivec2(gl_FragCoord.xy), index).r) - triangles.x);
}
