// Index of the triangle that a sample sees.
// The triangles of all parts are numbered consecutively; `first` is the index of the part's first
// triangle. Float32 represents all whole numbers up to 2^24.
uniform int first;
out float triangle;

void main() { triangle = float(first + gl_PrimitiveID); }
