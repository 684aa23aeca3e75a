// Draw the depth of a surface. With TRIANGLE, also draw the index of the visible triangle, as two
// digits of base TRIANGLE.
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
    int high = gl_PrimitiveID / TRIANGLE;
    share = vec4(part, float(high), float(gl_PrimitiveID - high * TRIANGLE), 1.0);
#endif
}
