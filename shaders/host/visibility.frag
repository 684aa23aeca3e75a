// Number of the triangle that a sample sees. The parts of a mesh are numbered consecutively, from
// `first`.
// Float32 represents all whole numbers up to 2^24.
uniform int first;
out float triangle;

void main() { triangle = float(first + gl_PrimitiveID); }
