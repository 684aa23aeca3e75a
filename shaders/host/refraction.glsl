// Refraction at a part with transmission, such as a cornea.
// REFRACTIONS is the number of the part's maps. drawing/maps.py describes map space.
// A map is a height field: z in map space, and the radiance, of the surfaces behind the part.
#include "facerender/fresnel/schlick.glsl"

uniform float transmission;
uniform float refraction;  // Index of refraction behind the surface.
uniform sampler2D refraction_map;  // Radiance and z. One square tile per map, side by side.
uniform mat4 refraction_view[REFRACTIONS];  // From the renderer's space to map space.
uniform float refraction_bottom[REFRACTIONS];  // Smallest z of each map.
uniform int refraction_first;  // Tile of the first map.
uniform vec3 refraction_background;  // Radiance where nothing is behind the part.

const int REFRACTION_STEPS = 24;
const float NO_SURFACE = -1e29;  // A smaller z denotes a texel without a surface.

// Return radiance and z of a map at x and y, interpolated between the texels that have a surface.
vec4 behind_at(vec2 place, int tile) {
    int texels = textureSize(refraction_map, 0).y;
    vec2 at = clamp((0.5 * place + 0.5) * float(texels) - 0.5, 0.0, float(texels - 1));
    ivec2 low = ivec2(at);
    vec2 upper = at - vec2(low);
    vec4 sum = vec4(0.0);
    float weight = 0.0;
    for (int i = 0; i < 4; ++i) {
        ivec2 corner = ivec2(i & 1, i >> 1);
        ivec2 texel = min(low + corner, texels - 1) + ivec2(tile * texels, 0);
        vec4 own = texelFetch(refraction_map, texel, 0);
        if (own.a < NO_SURFACE) continue;
        vec2 each = mix(1.0 - upper, upper, vec2(corner));
        sum += each.x * each.y * own;
        weight += each.x * each.y;
    }
    return weight > 0.0 ? sum / weight : vec4(refraction_background, 2.0 * NO_SURFACE);
}

// Return the height of a point of the ray above the map's surface, at most 4.
float height_above(vec3 at, int tile) { return min(at.z - behind_at(at.xy, tile).a, 4.0); }

// Return the radiance where a ray in map space first is below the map's surface. The ray starts at
// `start`. A search in equal steps finds an interval; regula falsi then narrows it.
vec3 first_behind(vec3 start, vec3 direction, float bottom, int tile) {
    float reach = min((start.z - bottom) / max(-direction.z, 1e-3), 4.0);
    float above = 0.0, below = 0.0;
    float height = height_above(start, tile), depth = height;
    for (int i = 1; i <= REFRACTION_STEPS && depth > 0.0; ++i) {
        above = below;
        height = depth;
        below = reach * float(i) / float(REFRACTION_STEPS);
        vec3 at = start + below * direction;
        if (abs(at.x) > 1.0 || abs(at.y) > 1.0) break;
        depth = height_above(at, tile);
    }
    if (depth > 0.0) return behind_at((start + above * direction).xy, tile).rgb;
    for (int i = 0; i < 4 && below > above; ++i) {
        float middle = mix(above, below, height / max(height - depth, 1e-12));
        float own = height_above(start + middle * direction, tile);
        if (own > 0.0) {
            above = middle;
            height = own;
        } else {
            below = middle;
            depth = own;
        }
    }
    float hit = mix(above, below, height / max(height - depth, 1e-12));
    return behind_at((start + clamp(hit, above, below) * direction).xy, tile).rgb;
}

// Return the radiance that a point of the part transmits from behind.
vec3 refracted(Surface s, float f0) {
    int map = 0;
    float nearest = 1e30;
    for (int i = 0; i < REFRACTIONS; ++i) {
        vec3 at = (refraction_view[i] * vec4(s.position, 1.0)).xyz;
        float distance = dot(at, at);
        if (distance < nearest) {
            nearest = distance;
            map = i;
        }
    }
    vec3 start = (refraction_view[map] * vec4(s.position, 1.0)).xyz;
    vec3 inwards = refract(-s.view, s.normal, 1.0 / refraction);
    vec3 direction = normalize((refraction_view[map] * vec4(inwards, 0.0)).xyz);
    vec3 radiance = first_behind(start, direction, refraction_bottom[map], refraction_first + map);
    float lost = fr_fresnel_schlick(f0, clamp(dot(s.normal, s.view), 0.0, 1.0));
    return transmission * (1.0 - min(s.specular_weight, 1.0) * lost) * radiance;
}
