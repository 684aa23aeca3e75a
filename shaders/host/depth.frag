// Draw the depth of a surface. With TRIANGLE, also draw the index of the visible triangle.
#ifdef UV
in vec2 uv;
#endif
#ifdef UV2
in vec2 uv2;
#endif
#ifdef ALPHA_MASK
#include "host/alpha.glsl"
#endif
#ifdef TRIANGLE
uniform float part;  // Index of the part, from 1; 0 is the background.
#endif
out vec4 share;

void main() {
#ifdef ALPHA_MASK
    share = vec4(share_left());
#else
    share = vec4(1.0);
#endif
#ifdef TRIANGLE
    // Float32 does not represent all indices above 2^24, so two channels hold an index.
    share = vec4(part, float(gl_PrimitiveID >> 12), float(gl_PrimitiveID & 4095), 1.0);
#endif
}
