#version 330 core
// One triangle that covers a square image, from three vertices without attributes.

out vec2 p;  // position in the image, in radii of the sphere

void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    p = corner / 0.9;
    gl_Position = vec4(corner, 0.0, 1.0);
}
