// Which facet a sample sees: its number in the part, after those of the parts before.
uniform int first;
out uint facet;

void main() { facet = uint(first + gl_PrimitiveID); }
