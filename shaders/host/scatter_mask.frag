// Marks, by its depth, which pixels scatter by a profile, so that nothing is begun elsewhere.
#include "host/scattering.glsl"

void main() {
    if (texelFetch(place, stand_in(ivec2(gl_FragCoord.xy)), 0).w != profile) discard;
}
