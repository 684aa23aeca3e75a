// Shadow mapping: visible fraction of a light at a point, from the depth map of the light.
//
//   unit:     none
//   returns:  In [0, 1].
//   error:    docs/measurements/skin.md compares the result with ray-traced shadows. Float32
//             rounding: none, except where a depth equals the depth in the map within rounding; the
//             texel then counts as lit or as dark.
//   source:   Williams (1978), "Casting curved shadows on curved surfaces"; discs: Fernando (2005),
//             "Percentage-closer soft shadows".
//
// Points are in light space. x and y are perpendicular to the direction of the light, from -1 to 1
// over the map. z grows towards the light, with the same scale as x and y. For a point light at
// distance d from the centre of a mesh in the unit sphere, light space is s d (x, y, z)/(d - z).
// Here z is the coordinate along the axis from the centre to the light, and s = sqrt(1 - 1/d^2). In
// light space the rays from the light are parallel, planes stay planes, and the shadow edge of a
// sphere light widens like the shadow edge of a distant disc light.
//
//   map:      Float texture without filtering. Red: z of the surface nearest to the light; where
//             there is no surface, a value below the z of every point.
//   tile:     xy: first texel of the light's map in the texture; z: side of this map in texels. One
//             texture may hold the maps of several lights; nothing outside the tile casts shadows.
//   p:        Point in light space, moved by 0.4 texels (0.8/tile.z) along the normal of the mesh.
//   bias:     Offset added to the z of the point, for example 0.001 + 1/tile.z.
#ifndef FR_SHADOW_GLSL
#define FR_SHADOW_GLSL

#include "constants.glsl"

#ifdef GL_ES
precision highp sampler2D;
#endif

// Number of samples in the two loops of fr_shadow_disc: search for occluders, visible fraction.
#ifndef FR_SHADOW_SEARCH
#define FR_SHADOW_SEARCH 8
#endif
#ifndef FR_SHADOW_SAMPLES
#define FR_SHADOW_SAMPLES 12
#endif

// z of the surface nearest to the light in a texel of the light's map.
//
//   formula:  red of the map at floor(texel), clamped to the map
//   texel:    Column and row in the light's map.
float fr_shadow_depth(sampler2D map, ivec3 tile, vec2 texel) {
    ivec2 inside = ivec2(clamp(texel, vec2(0.0), vec2(float(tile.z - 1))));
    return texelFetch(map, inside + tile.xy, 0).r;
}

// Weight of a texel in the mean over a square.
//
//   formula:  area of the texel inside the square, divided by the area of the square
//   texel:    Lower corner of the texel; the side of a texel is 1.
//   centre:   Centre of the square, in texels.
//   width:    Side of the square in texels, in [1, 3].
float fr_shadow_weight(vec2 texel, vec2 centre, float width) {
    vec2 low = max(texel, centre - 0.5 * width);
    vec2 covered = max(min(texel + 1.0, centre + 0.5 * width) - low, 0.0) / width;
    return covered.x * covered.y;
}

// Visible fraction of a light without angular radius.
//
//   formula:  mean of step(map, z + bias) over a square of texels around p
//   plane:    Change of z per unit of x and per unit of y on the tangent plane at p, in [-8, 8].
//   width:    Side of the square in texels, in [1, 3]: the width of a pixel of the image.
float fr_shadow_hard(
    sampler2D map, ivec3 tile, vec3 p, vec2 plane, float width, float bias
) {
    float texels = float(tile.z);
    vec2 centre = (p.xy * 0.5 + 0.5) * texels;
    vec2 first = floor(centre - 0.5 * width), end = centre + 0.5 * width;
    vec2 texel = first;
    float seen = 0.0;
    for (int i = 0; i < 16 && texel.y < end.y; ++i) {
        vec2 aside = (texel + 0.5 - centre) * (2.0 / texels);
        float z = p.z + bias + max(dot(plane, aside), 0.0);
        if (fr_shadow_depth(map, tile, texel) <= z) {
            seen += fr_shadow_weight(texel, centre, width);
        }
        texel.x += 1.0;
        if (texel.x >= end.x) texel = vec2(first.x, texel.y + 1.0);
    }
    return seen;
}

// Visible fraction of a disc light or a sphere light.
//
//   formula:     mean of step(map, z) over a disc: the cross-section, at the mean z of the
//                occluders, of the cone from p to the light. If the disc has a diameter of less
//                than 2 texels, a square replaces it.
//   plane:       Change of z per unit of x and per unit of y on the tangent plane at p, in [-8, 8].
//   tan_radius:  Tangent of the angle between the centre and the rim of the light, seen from the
//                centre of the mesh, in [0, tan(20 degrees)].
//   top:         Largest z of the occluders between p and the light: at most 1 for a distant light,
//                s d/(d - 1) for a point light. The search finds smaller occluders if the host
//                gives a smaller top, from maxima of the map around p. If top is at most p.z, the
//                function skips the search and returns 1.
//   width:       Smallest side of the square in texels, in [1, 3]: the width of a pixel.
//   start:       Direction of the first sample, a unit vector; a different direction at each pixel
//                turns banding into noise.
//   returns:     In [0, 1]: 1 without occluders, 0 if every sample of the search finds an occluder.
//                The radius of the search is tan_radius times top - p.z, which is clamped to [0,
//                1], and at least half of the width. Both loops use N samples at angles of
//                2.39996 i from the start. The radius of a sample is (i + 1/2)/N in the search,
//                which is denser near p, and sqrt((i + 1/2)/N) in the mean (Vogel 1979). An
//                occluder outside the cone from p to the light hides no light: its weight in the
//                search is 0.1, and the mean ignores it if it is more than 1.5 times as far from
//                the axis as the cone's edge.
float fr_shadow_disc(
    sampler2D map, ivec3 tile, vec3 p, vec2 plane, float tan_radius, float top, float bias,
    float width, vec2 start
) {
    const mat2 next = mat2(-0.73736888, 0.67549029, -0.67549029, -0.73736888);
    float texels = float(tile.z);
    vec2 centre = (p.xy * 0.5 + 0.5) * texels;
    float z = p.z + bias;
    float cone = 0.5 * texels * tan_radius;  // Radius of the cone in texels, per unit of z.
    float reach = max(cone * clamp(top - p.z, 0.0, 1.0), 0.5 * width);
    vec2 slope = plane * (2.0 / texels);
    // Loops with 0 iterations replace branches, because some drivers execute both sides of a
    // branch.
    int turns = top > p.z ? FR_SHADOW_SEARCH : 0;
    int blocked = 0;
    float depth = 0.0, weights = 0.0;
    vec2 towards = start;
    for (int i = 0; i < turns; ++i) {
        float away = (float(i) + 0.5) * reach / float(FR_SHADOW_SEARCH);
        vec2 aside = away * towards;
        towards = next * towards;
        float other = fr_shadow_depth(map, tile, centre + aside);
        if (other > z + max(dot(slope, aside), 0.0)) {
            float weight = away < max(cone * (other - p.z), 1.0) ? 1.0 : 0.1;
            ++blocked;
            depth += weight * other;
            weights += weight;
        }
    }
    if (blocked == turns || blocked == 0) turns = 0;
    float radius = cone * (depth / max(weights, 0.1) - p.z);
    bool narrow = radius < 1.0;
    float side = clamp(2.0 * radius, width, 3.0);
    float total = narrow ? 1.0 : float(FR_SHADOW_SAMPLES);
    float seen = blocked > 0 ? 0.0 : total;
    towards = start;
    vec2 first = floor(centre - 0.5 * side), end = centre + 0.5 * side;
    vec2 texel = first, covered = ceil(end) - first;
    if (turns > 0) turns = narrow ? min(int(covered.x * covered.y), 16) : FR_SHADOW_SAMPLES;
    for (int i = 0; i < turns; ++i) {
        float away = radius * sqrt((float(i) + 0.5) / float(FR_SHADOW_SAMPLES));
        vec2 aside = narrow ? texel + 0.5 - centre : away * towards;
        towards = next * towards;
        float other = fr_shadow_depth(map, tile, centre + aside);
        float weight = narrow ? fr_shadow_weight(texel, centre, side) : 1.0;
        bool outside = !narrow && away > max(1.5 * cone * (other - p.z), 1.0);
        if (outside || other <= z + max(dot(slope, aside), 0.0)) seen += weight;
        texel.x += 1.0;
        if (texel.x >= end.x) texel = vec2(first.x, texel.y + 1.0);
    }
    return seen / total;
}

#endif
