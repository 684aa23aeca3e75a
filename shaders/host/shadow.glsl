// Visibility of the shadow-casting lights at a point.
// SHADOWS is the number of shadow-casting lights. SHADOW_DISCS is defined if one of them has a
// radius.
#include "facerender/shadow.glsl"

uniform sampler2D shadow_map;    // One square tile per light, side by side.
uniform sampler2D shadow_cones;  // Output of shadow_cones.frag, in the same order.
uniform sampler2D shadow_tops;   // Output of shadow_tops.frag: four levels per light.
uniform ivec2 shadow_tiles;  // Width of a light's tile in shadow_map and in shadow_cones.
uniform mat4 shadow_view[SHADOWS];  // Matrix from the renderer's space to light space.
uniform vec2 shadow_size[SHADOWS];  // Tangent of the light's angular radius; largest z.

// Noise: Jimenez (2014), "Next generation post processing in Call of Duty: Advanced Warfare".
const vec2 NOISE = vec2(0.06711056, 0.00583715);

// Return the offset added to z.
float bias_of() { return 0.0002 + 0.5 / float(shadow_tiles.x); }

// Return the change of z with x and y on the surface's tangent plane, in light space, from the
// changes of the position per pixel. The change is unbounded for edge-on surfaces; it is clamped to [-8, 8].
vec2 plane_of(vec3 x, vec3 y) {
    vec3 across = cross(x, y);
    across *= inversesqrt(max(dot(across, across), 1e-30));
    return clamp(-across.xy / (abs(across.z) < 0.05 ? 0.05 : across.z), -8.0, 8.0);
}

// Normal of the mesh, on the side of the shaded normal.
vec3 mesh_normal(Surface s, Point p) {
    vec3 n = normalize(p.normal);
    return dot(n, s.normal) < 0.0 ? -n : n;
}

// Return the shadowed point: 0.4 texels above the curved surface that the vertex normals describe.
// Without the curve, the shadow terminator shows the triangles: Hanika (2021), "Hacking the shadow
// terminator". The curve is the quadratic surface with these normals at the vertices, half as high
// as Hanika's mean of the tangent planes. Concave triangles keep their plane.
vec3 in_light_space(int i, vec3 n, Point p) {
    float curve = 0.5 * (p.tangent_plane - dot(p.position, p.normal));
    float above = max(dot(n, p.normal) < 0.0 ? -curve : curve, 0.0) + 0.8 / float(shadow_tiles.x);
    vec4 place = shadow_view[i] * vec4(p.position + above * n, 1.0);
    return place.xyz / place.w;
}

// Return whether an occluder may hide a part of the light. The light is visible down to an angle
// below the horizon; `below` is the sine of this angle.
bool in_doubt(int i, Surface s, Point p, vec3 direction, float below) {
    vec3 n = mesh_normal(s, p);
    vec3 at = in_light_space(i, n, p);
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

// Return the width of a pixel in texels, in [1, 3].
float pixel_width(vec3 x, vec3 y) {
    vec2 size = max(abs(x.xy), abs(y.xy));
    return clamp(0.5 * float(shadow_tiles.x) * max(size.x, size.y), 1.0, 3.0);
}

// Return the largest z of the occluders in the cone from a point to a light, or a larger value. Each
// step reads the level whose texels are as wide as the cone below the previous result.
float top_of(int i, vec3 at) {
    int blocks = shadow_tiles.y;
    float top = shadow_size[i].y;
    vec2 place = clamp(at.xy * 0.5 + 0.5, 0.0, 0.9999);
    for (int step = 0; step < 3; ++step) {
        float radius = 0.5 * float(blocks) * shadow_size[i].x * (top - at.z);
        if (radius > 32.0) break;
        int level = int(radius > 0.5) + int(radius > 2.0) + int(radius > 8.0);
        int side = blocks >> 2 * level;
        int column = (i * 4 * (blocks - 1) + 4 * (blocks - side)) / 3;
        ivec2 texel = ivec2(place * float(side)) + ivec2(column, 0);
        top = min(top, texelFetch(shadow_tops, texel, 0).r);
    }
    return top;
}

// Return the visible fraction of a light.
float visibility(int i, Surface s, Point p) {
    vec3 n = mesh_normal(s, p);
    vec3 at = in_light_space(i, n, p);
    ivec3 tile = ivec3(i, 0, 1) * shadow_tiles.x;
    float bias = bias_of();
    vec4 x = shadow_view[i] * vec4(p.position_x - n * dot(n, p.position_x), 0.0);
    vec4 y = shadow_view[i] * vec4(p.position_y - n * dot(n, p.position_y), 0.0);
    vec3 along_x = x.xyz - at * x.w;
    vec3 along_y = y.xyz - at * y.w;
    float width = pixel_width(along_x, along_y);
    vec2 plane = plane_of(along_x, along_y);
#ifdef SHADOW_DISCS
    float turn = 6.2831853 * fract(52.9829189 * fract(dot(gl_FragCoord.xy, NOISE)));
    return fr_shadow_disc(
        shadow_map, tile, at, plane, shadow_size[i].x, top_of(i, at), bias, width, turn
    );
#else
    return fr_shadow_hard(shadow_map, tile, at, plane, width, bias);
#endif
}

// Return the visible fraction of each light. Points in doubt about any light share one loop, because
// a software driver spends time on each copy of its code, even if no point enters it.
void see_lights(Surface s, Point p, out float seen[SHADOWS]) {
    int doubts = 0;
    EVERY_SHADOW
    for (int i = 0; i < SHADOWS; ++i) seen[i] = 1.0;
    while (doubts != 0) {
        int next = int(log2(float(doubts & -doubts)) + 0.5);
        doubts &= doubts - 1;
        float fraction = visibility(next, s, p);
        for (int i = 0; i < SHADOWS; ++i) {
            if (i == next) seen[i] = fraction;
        }
    }
}
