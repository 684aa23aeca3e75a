// Point lights.
#include "host/light/light.glsl"

uniform vec3 light_position[POINT_LIGHTS];
uniform vec3 light_intensity[POINT_LIGHTS];  // Irradiance at distance 1.

Light point_light(int i, vec3 position) {
    vec3 to_light = light_position[i] - position;
    float distance2 = dot(to_light, to_light);
    return Light(to_light * inversesqrt(distance2), light_intensity[i] / distance2);
}
