// A triangle that covers the viewport.
uniform float depth;  // Depth in clip space, from -1 to 1.

void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    gl_Position = vec4(4.0 * corner - 1.0, depth, 1.0);
}
