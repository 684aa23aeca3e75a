// Point lights with a radius.
#include "host/light/area.glsl"

uniform vec3 sphere_position[SPHERE_LIGHTS];
uniform vec3 sphere_intensity[SPHERE_LIGHTS];  // Irradiance at distance 1.
uniform float sphere_size[SPHERE_LIGHTS];  // Radius, in units of length.

Disc sphere_light(int i, vec3 position) {
    vec3 to_light = sphere_position[i] - position;
    float distance2 = dot(to_light, to_light);
    float inverse = inversesqrt(distance2);
    float s = sphere_size[i] * inverse;
    Light center = Light(to_light * inverse, sphere_intensity[i] / distance2);
    return Disc(center, vec2(s, 0.5 + 0.5 * sqrt(1.0 - s * s)));
}
