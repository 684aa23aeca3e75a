// Index of the triangle that a sample sees.
// The triangles of all parts are numbered consecutively; `first` is the index of the part's first
// triangle. Float32 represents all whole numbers up to 2^24.
uniform int first;
out float triangle;

#ifdef SELECTED
// Index, within the part, of each triangle that is drawn.
uniform sampler2D selected_triangles;

float triangle_index() {
    int row = gl_PrimitiveID / TRIANGLES_IN_ROW;
    return texelFetch(selected_triangles, ivec2(gl_PrimitiveID - row * TRIANGLES_IN_ROW, row), 0).x;
}
#else
float triangle_index() { return float(gl_PrimitiveID); }
#endif

void main() { triangle = float(first) + triangle_index(); }
