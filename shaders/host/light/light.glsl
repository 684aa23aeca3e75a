// Light that arrives at a point: the common result of all kinds of lights.
#ifndef HOST_LIGHT_GLSL
#define HOST_LIGHT_GLSL

struct Light {
    vec3 direction;   // Unit vector to the light.
    vec3 irradiance;  // Irradiance of a surface that faces the light.
};

#endif
