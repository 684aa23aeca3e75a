// Which triangle a sample sees: its number in the part, after those of the parts before. Float32 has all
// whole numbers up to 2^24.
uniform int first;
out float triangle;

void main() { triangle = float(first + gl_PrimitiveID); }
