// Front of a refracting part: z in map space, see refraction.glsl.
in vec3 position;

uniform mat4 to_map;
out float z;

void main() { z = (to_map * vec4(position, 1.0)).z; }
