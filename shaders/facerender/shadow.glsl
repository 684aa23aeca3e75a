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
// Both are multiples of 4.
#ifndef FR_SHADOW_SEARCH
#define FR_SHADOW_SEARCH 12
#endif
#ifndef FR_SHADOW_SAMPLES
#define FR_SHADOW_SAMPLES 28
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
//                occluders, of the cone from p to the light.
//   plane:       Change of z per unit of x and per unit of y on the tangent plane at p, in [-8, 8].
//   tan_radius:  Tangent of the angle between the centre and the rim of the light, seen from the
//                centre of the mesh, in [0, tan(20 degrees)].
//   top:         Largest z of the occluders between p and the light: at most 1 for a distant light,
//                s d/(d - 1) for a point light. The search finds smaller occluders if the host
//                gives a smaller top, from maxima of the map around p. If top is at most p.z, the
//                function skips the search and returns 1.
//   width:       Width of a pixel in texels, in [1, 3]. The diameter of the disc is at least 1.12
//                times the width, so that an edge is as smooth as without angular radius.
//   start:       Direction of the first sample, a unit vector. A different direction within a
//                quarter turn at each pixel turns banding into noise. A full turn would repeat each
//                pattern of the mean four times.
//   jitter:      Position of the samples within their rings, in search and mean, in [0, 1): 0.5 for
//                one image. Images with other starts and jitters have another noise, so that their
//                mean has less.
//   returns:     In [0, 1]: 1 without occluders.
//                The radius of the search is tan_radius times top - p.z, which is clamped to [0,
//                1], and at least half of the width. The search uses N samples at angles of
//                2.39996 i from the start, with the radius (i + jitter)/N, which is denser near p.
//                The mean uses N/4 crosses of four samples at angles of 0.6 i, with the radius
//                sqrt((i + jitter)/(N/4)): opposite samples see the same edge from both sides,
//                which halves the noise of as many samples on a spiral. An occluder outside the
//                cone from p to the light hides no light: its weight in the search is 0.1, and the
//                mean ignores it if it is more than 1.5 times as far from the axis as the cone's
//                edge.
float fr_shadow_disc(
    sampler2D map, ivec3 tile, vec3 p, vec2 plane, float tan_radius, float top, float bias,
    float width, vec2 start, vec2 jitter
) {
    const mat2 golden = mat2(-0.73736888, 0.67549029, -0.67549029, -0.73736888);
    const mat2 next = mat2(0.82533561, 0.56464247, -0.56464247, 0.82533561);
    float texels = float(tile.z);
    vec2 centre = (p.xy * 0.5 + 0.5) * texels;
    float z = p.z + bias;
    float cone = 0.5 * texels * tan_radius;  // Radius of the cone in texels, per unit of z.
    float reach = max(cone * clamp(top - p.z, 0.0, 1.0), 0.5 * width);
    vec2 slope = plane * (2.0 / texels);
    float blocked = 0.0, depth = 0.0, weights = 0.0;
    vec2 towards = start;
    // Rounds of four samples, because four fetches at once cost less than one after another. The
    // loops run at least once: a software driver executes a loop with a test in front once more.
    int rounds = top > p.z ? FR_SHADOW_SEARCH / 4 : 0;
    int i = 0;
    do {
        vec4 away = (vec4(4 * i) + vec4(0.0, 1.0, 2.0, 3.0) + jitter.x)
            * (reach / float(FR_SHADOW_SEARCH));
        vec2 second = golden * towards, third = golden * second, fourth = golden * third;
        vec2 a = away.x * towards, b = away.y * second, c = away.z * third, d = away.w * fourth;
        towards = golden * fourth;
        vec4 other = vec4(
            fr_shadow_depth(map, tile, centre + a), fr_shadow_depth(map, tile, centre + b),
            fr_shadow_depth(map, tile, centre + c), fr_shadow_depth(map, tile, centre + d)
        );
        vec4 rise = max(vec4(dot(slope, a), dot(slope, b), dot(slope, c), dot(slope, d)), 0.0);
        vec4 blocks = vec4(greaterThan(other, z + rise));
        vec4 inside = vec4(lessThan(away, max(cone * (other - p.z), 1.0)));
        vec4 weight = blocks * (0.1 + 0.9 * inside);
        blocked += dot(blocks, vec4(1.0));
        depth += dot(weight, max(other, -2.0));  // Texels without a surface have a huge negative z.
        weights += dot(weight, vec4(1.0));
        ++i;
    } while (i < rounds);
    rounds = rounds > 0 && blocked > 0.0 ? FR_SHADOW_SAMPLES / 4 : 0;
    float radius = max(cone * (depth / max(weights, 0.1) - p.z), 0.56 * width);
    float least = max(0.56 * width, 1.0);
    float dark = 0.0;
    towards = start;
    i = 0;
    do {
        float away = radius * sqrt((float(i) + jitter.y) / float(FR_SHADOW_SAMPLES / 4));
        vec2 a = away * towards, b = vec2(-a.y, a.x);
        towards = next * towards;
        vec4 other = vec4(
            fr_shadow_depth(map, tile, centre + a), fr_shadow_depth(map, tile, centre + b),
            fr_shadow_depth(map, tile, centre - a), fr_shadow_depth(map, tile, centre - b)
        );
        vec2 up = vec2(dot(slope, a), dot(slope, b));
        vec4 above = vec4(greaterThan(other, z + max(vec4(up, -up), 0.0)));
        dark += dot(above, vec4(lessThanEqual(vec4(away), max(1.5 * cone * (other - p.z), least))));
        ++i;
    } while (i < rounds);
    return rounds > 0 ? 1.0 - dark / float(FR_SHADOW_SAMPLES) : 1.0;
}

#endif
