// Visibility of the shadow-casting lights at a point.
// SHADOWS is the number of shadow-casting lights. SHADOW_DISCS is defined if one of them has a
// radius, SHADOW_POINTS if one of them has a position.
#include "facerender/shadow.glsl"

uniform sampler2D shadow_map;    // One square tile per light, side by side.
uniform sampler2D shadow_cones;  // Output of shadow_cones.frag, in the same order.
uniform sampler2D shadow_tops;   // Output of shadow_tops.frag: four levels per light.
uniform float shadow_reach;  // Radius of the sphere around the mesh, which the maps cover.
uniform ivec2 shadow_tiles;  // Width of a light's tile in shadow_map and in shadow_cones.
uniform mat4 shadow_view[SHADOWS];  // Matrix from the renderer's space to light space.
// Tangent of the light's angular radius; largest z; LightSpace.scale.
uniform vec3 shadow_size[SHADOWS];
// Shift of the noise, and fr_shadow_disc's jitter: different in each image of a pixel's samples.
uniform vec3 shadow_phase;

// Noise: Jimenez (2014), "Next generation post processing in Call of Duty: Advanced Warfare".
const vec2 NOISE = vec2(0.06711056, 0.00583715);

// Return the offset added to z.
float bias_of() { return 0.0002 + 0.5 / float(shadow_tiles.x); }

// Normal of the mesh, on the side of the shaded normal.
vec3 mesh_normal(Surface s, Point p) {
    vec3 n = normalize(p.normal);
    return dot(n, s.normal) < 0.0 ? -n : n;
}

// Return the shadowed point: 0.4 texels above the curved surface that the vertex normals describe.
// Without the curve, the shadow terminator shows the triangles: Hanika (2021), "Hacking the shadow
// terminator". The curve is the quadratic surface with these normals at the vertices, half as high
// as Hanika's mean of the tangent planes. Concave triangles keep their plane.
vec3 in_light_space(mat4 view, vec3 n, Point p) {
    float curve = 0.5 * (p.tangent_plane - dot(p.position, p.normal));
    float above = max(dot(n, p.normal) < 0.0 ? -curve : curve, 0.0) + 0.8 * shadow_reach / float(shadow_tiles.x);
    vec4 place = view * vec4(p.position + above * n, 1.0);
#ifdef SHADOW_POINTS
    place.xyz /= place.w;
#endif
    return place.xyz;
}

// Return whether an occluder may hide a part of the light. The light is visible down to an angle
// below the horizon; `below` is the sine of this angle.
bool in_doubt(int i, Surface s, Point p, vec3 direction, float below) {
    vec3 n = mesh_normal(s, p);
    vec3 at = in_light_space(shadow_view[i], n, p);
    vec2 block = clamp((at.xy * 0.5 + 0.5) * float(shadow_tiles.y), 0.0, float(shadow_tiles.y - 1));
    float cones = texelFetch(shadow_cones, ivec2(block) + ivec2(i * shadow_tiles.y, 0), 0).r;
    // The surface around the point rises within the block.
    float rise = 4.0 / float(shadow_tiles.y) * (1.0 - max(dot(n, direction), 0.0));
    return dot(s.normal, direction) > -below && cones > at.z + 4.0 * bias_of() + rise;
}

bool in_doubt(Light light, int shadow, Surface s, Point p) {
    return in_doubt(shadow, s, p, light.direction, 0.0);
}

Light shadowed(Light light, float seen) {
    light.irradiance *= seen;
    return light;
}

#ifdef HOST_LIGHT_AREA_GLSL
bool in_doubt(Disc light, int shadow, Surface s, Point p) {
    return in_doubt(shadow, s, p, light.center.direction, light.size.x);
}

Disc shadowed(Disc light, float seen) {
    light.center.irradiance *= seen;
    return light;
}
#endif

// Return the largest z of the occluders in the cone from a point to a light, or a larger value. Each
// step reads the level whose texels are as wide as the cone below the previous result.
float top_of(int i, vec3 size, vec3 at) {
    int blocks = shadow_tiles.y;
    float top = size.y;
    vec2 place = clamp(at.xy * 0.5 + 0.5, 0.0, 0.9999);
    for (int step = 0; step < 2; ++step) {
        float radius = 0.5 * float(blocks) * size.x * (top - at.z);
        if (radius > 32.0) break;
        int level = int(radius > 0.5) + int(radius > 2.0) + int(radius > 8.0);
        int side = blocks >> 2 * level;
        int column = (i * 4 * (blocks - 1) + 4 * (blocks - side)) / 3;
        ivec2 texel = ivec2(place * float(side)) + ivec2(column, 0);
        top = min(top, texelFetch(shadow_tops, texel, 0).r);
    }
    return top;
}

// Return the visible fraction of light i with its elements of shadow_view and shadow_size.
float visibility(int i, mat4 view, vec3 size, Surface s, Point p) {
    vec3 n = mesh_normal(s, p);
    vec3 at = in_light_space(view, n, p);
    ivec3 tile = ivec3(i, 0, 1) * shadow_tiles.x;
    // The change of z on the tangent plane is unbounded where the surface is edge-on to the light.
    mat3 to_light = mat3(view);
    vec3 plane = shadow_reach * (to_light * n);
    vec2 x = (to_light * p.position_x).xy, y = (to_light * p.position_y).xy;
#ifdef SHADOW_POINTS
    plane.z -= size.z * dot(n, p.position);
    float depth = (view * vec4(p.position, 1.0)).w;
    x /= depth;
    y /= depth;
#endif
    vec2 slope = clamp(-plane.xy / (abs(plane.z) < 0.05 ? 0.05 : plane.z), -8.0, 8.0);
    vec2 pixel = max(abs(x), abs(y));
    float width = clamp(0.5 * float(shadow_tiles.x) * max(pixel.x, pixel.y), 1.0, 3.0);
#ifdef SHADOW_DISCS
    float noise = fract(52.9829189 * fract(dot(gl_FragCoord.xy, NOISE)) + shadow_phase.x);
    vec2 start = normalize(vec2(1.0 - noise, noise));
    return fr_shadow_disc(
        shadow_map, tile, at, slope, size.x, top_of(i, size, at), bias_of(), width, start,
        shadow_phase.yz
    );
#else
    return fr_shadow_hard(shadow_map, tile, at, slope, width, bias_of());
#endif
}

// Return the visible fraction of each light. Points in doubt about any light share one loop, because
// a software driver spends time on each copy of its code, even if no point enters it. Constant
// indices, because such a driver reads an element of an array with a variable index for each point.
void see_lights(Surface s, Point p, out float seen[SHADOWS]) {
    int doubts = 0;
    EVERY_SHADOW
    for (int i = 0; i < SHADOWS; ++i) seen[i] = 1.0;
    if (doubts != 0) do {
        int next = 0;
        mat4 view = shadow_view[0];
        vec3 size = shadow_size[0];
        for (int i = 1; i < SHADOWS; ++i) {
            if ((doubts & 1 << i) != 0) {
                next = i;
                view = shadow_view[i];
                size = shadow_size[i];
            }
        }
        doubts &= ~(1 << next);
        float fraction = visibility(next, view, size, s, p);
        for (int i = 0; i < SHADOWS; ++i) {
            if (i == next) seen[i] = fraction;
        }
    } while (doubts != 0);
}
