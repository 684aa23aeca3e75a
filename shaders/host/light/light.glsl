// Light that arrives at a point, from a light of any kind.
#ifndef HOST_LIGHT_GLSL
#define HOST_LIGHT_GLSL

struct Light {
    vec3 direction;   // Unit vector to the light.
    vec3 irradiance;  // Irradiance of a surface that faces the light.
};

#endif
