// Directional lights.
#include "host/light/light.glsl"

uniform vec3 light_direction[DIRECTIONAL_LIGHTS];  // Direction to the light.
uniform vec3 light_irradiance[DIRECTIONAL_LIGHTS];

Light directional_light(int i, vec3 position) {
    return Light(light_direction[i], light_irradiance[i]);
}
