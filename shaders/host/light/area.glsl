// What a kind of light with a size gives at a place.
#ifndef HOST_LIGHT_AREA_GLSL
#define HOST_LIGHT_AREA_GLSL

#include "host/light/light.glsl"

// A light that is seen as a disc, whose rim is at the angle R from its centre.
struct Disc {
    Light center;
    vec2 size;  // sin(R) and (1 + cos(R))/2
};

#endif
