// Area light as seen from a point.
#ifndef HOST_LIGHT_AREA_GLSL
#define HOST_LIGHT_AREA_GLSL

#include "host/light/light.glsl"

// Light that appears as a disc with the angular radius R.
struct Disc {
    Light center;
    vec2 size;  // sin(R) and (1 + cos(R))/2.
};

#endif
