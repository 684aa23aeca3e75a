// Light at a point: the common result of all kinds of lights.
#ifndef HOST_LIGHT_GLSL
#define HOST_LIGHT_GLSL

struct Light {
    vec3 direction;   // unit vector to the light
    vec3 irradiance;  // of a surface that faces the light
};

#endif
