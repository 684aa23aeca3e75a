// What every kind of light gives at a place.
#ifndef HOST_LIGHT_GLSL
#define HOST_LIGHT_GLSL

struct Light {
    vec3 direction;   // towards the light, a unit vector
    vec3 irradiance;  // of a surface that faces it
};

#endif
