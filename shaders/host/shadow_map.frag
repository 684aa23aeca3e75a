// Shadow map of a light: z of the surface nearest to the light, in light space.
in vec4 place;
#ifdef UV
in vec2 uv;
#endif
#ifdef UV2
in vec2 uv2;
#endif
#ifdef ALPHA_MASK
#include "host/alpha.glsl"
#endif
out float z;

#ifdef ALPHA_MASK
void main() {
    z = place.z / place.w;
    share_left();
}
#else
void main() { z = place.z / place.w; }
#endif
