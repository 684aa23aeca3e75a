// Vertex positions in light space: see facerender/shadow.glsl.
in vec3 in_position;
#ifdef UV
in vec2 in_uv;
out vec2 uv;
#endif
#ifdef UV2
in vec2 in_uv2;
out vec2 uv2;
#endif

uniform mat4 to_light;
uniform float top;  // Largest z in light space.

out vec4 place;

void main() {
#ifdef UV
    uv = in_uv;
#endif
#ifdef UV2
    uv2 = in_uv2;
#endif
    place = to_light * vec4(in_position, 1.0);
    gl_Position = vec4(place.xy, -place.z / top, place.w);
}
