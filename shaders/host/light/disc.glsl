// Directional lights with an angular radius.
#include "host/light/area.glsl"

uniform vec3 disc_direction[DISC_LIGHTS];  // Direction to the centre.
uniform vec3 disc_irradiance[DISC_LIGHTS];
uniform vec2 disc_size[DISC_LIGHTS];

Disc disc_light(int i, vec3 position) {
    return Disc(Light(disc_direction[i], disc_irradiance[i]), disc_size[i]);
}
