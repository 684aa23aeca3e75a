// Draw the depth of a surface.
#ifdef UV
in vec2 uv;
#endif
#ifdef UV2
in vec2 uv2;
#endif
#ifdef ALPHA_MASK
#include "host/alpha.glsl"
#endif
out vec4 share;

void main() {
#ifdef ALPHA_MASK
    share = vec4(share_left());
#else
    share = vec4(1.0);
#endif
}
