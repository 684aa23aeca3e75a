// Vertex program of the renderer. Positions are centred and scaled by the bounding sphere of the
// mesh.
in vec3 in_position;
in vec3 in_normal;
uniform mat4 view_projection;
out vec3 position;
out vec3 vertex_normal;
#ifdef SHADOWS
out float tangent_plane;
#endif
#ifdef UV
in vec2 in_uv;
out vec2 uv;
#endif
#ifdef UV2
in vec2 in_uv2;
out vec2 uv2;
#endif
#ifdef VERTEX_OCCLUSION
in float in_occlusion;
out float vertex_occlusion;
#endif
#ifdef VERTEX_COLORS
in vec3 in_color;
out vec3 vertex_color;
#endif

void main() {
    position = in_position;
    vertex_normal = in_normal;
#ifdef SHADOWS
    tangent_plane = dot(in_position, in_normal);
#endif
#ifdef UV
    uv = in_uv;
#endif
#ifdef UV2
    uv2 = in_uv2;
#endif
#ifdef VERTEX_OCCLUSION
    vertex_occlusion = in_occlusion;
#endif
#ifdef VERTEX_COLORS
    vertex_color = in_color;
#endif
    gl_Position = view_projection * vec4(in_position, 1.0);
}
