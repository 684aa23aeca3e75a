// The map of a light that casts shadows: what is nearest to it.
in vec4 place;
out float z;

void main() { z = place.z / place.w; }
