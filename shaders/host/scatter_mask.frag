// Mark, in the depth buffer, the pixels with the scattering profile.
// The depth test then skips scatter.frag at all other pixels.
#include "host/scattering.glsl"

void main() {
    if (texelFetch(place, stand_in(ivec2(gl_FragCoord.xy)), 0).w != profile) discard;
}
