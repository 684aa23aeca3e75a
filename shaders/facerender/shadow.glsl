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
//   p:        Point in light space, moved by 1.25 texels (2.5/tile.z) along the normal of the mesh.
//   bias:     Offset added to the z of the point, for example 0.004.
#ifndef FR_SHADOW_GLSL
#define FR_SHADOW_GLSL

#include "constants.glsl"

#ifdef GL_ES
precision highp sampler2D;
#endif

// Number of samples in each of the two loops of fr_shadow_disc: search for occluders, visible
// fraction.
#ifndef FR_SHADOW_SAMPLES
#define FR_SHADOW_SAMPLES 12
#endif

// Visibility of the light at a position and depth: 0 or 1 per texel, interpolated between four
// texels.
//
//   formula:  bilinear interpolation of step(map, z)
//   at, z:    Position and depth in light space.
float fr_shadow_lit(sampler2D map, ivec3 tile, vec2 at, float z) {
    vec2 texel = (at * 0.5 + 0.5) * float(tile.z) - 0.5;
    vec2 share = fract(texel);
    ivec2 low = ivec2(floor(texel));
    ivec2 first = clamp(low, ivec2(0), ivec2(tile.z - 1)) + tile.xy;
    ivec2 last = clamp(low + 1, ivec2(0), ivec2(tile.z - 1)) + tile.xy;
    vec4 lit = step(
        vec4(
            texelFetch(map, first, 0).r,
            texelFetch(map, ivec2(last.x, first.y), 0).r,
            texelFetch(map, ivec2(first.x, last.y), 0).r,
            texelFetch(map, last, 0).r
        ),
        vec4(z)
    );
    return mix(mix(lit.x, lit.y, share.x), mix(lit.z, lit.w, share.x), share.y);
}

// Visible fraction of a light without angular radius.
//
//   formula:  fr_shadow_lit at p, with the bias added to z
float fr_shadow_hard(sampler2D map, ivec3 tile, vec3 p, float bias) {
    return fr_shadow_lit(map, tile, p.xy, p.z + bias);
}

// Visible fraction of a disc light or a sphere light.
//
//   formula:     mean of fr_shadow_lit over a disc: the cross-section, at the mean z of the
//                occluders, of the cone from p to the light
//   plane:       Change of z per unit of x and per unit of y on the tangent plane at p, in [-8, 8].
//   tan_radius:  Tangent of the angle between the centre and the rim of the light, seen from the
//                centre of the mesh, in (0, tan(20 degrees)].
//   top:         Largest z of the occluders: 1 for a distant light, s d/(d - 1) for a point light.
//                If top is at most p.z, the function skips the search and returns 1.
//   turn:        Rotation of the spiral in radians; a different angle at each pixel turns banding
//                into noise.
//   returns:     In [0, 1]: 1 without occluders, 0 if every sample of the search finds an occluder.
//                The radius of the search is tan_radius times top - p.z, which is clamped to [0,
//                1]. Search and mean use samples on a spiral (Vogel 1979): radius sqrt((i +
//                1/2)/N), angle 2.39996 i + turn.
float fr_shadow_disc(
    sampler2D map, ivec3 tile, vec3 p, vec2 plane, float tan_radius, float top, float bias,
    float turn
) {
    const mat2 next = mat2(-0.73736888, 0.67549029, -0.67549029, -0.73736888);
    float z = p.z + bias;
    float reach = tan_radius * clamp(top - p.z, 0.0, 1.0);
    vec2 start = vec2(cos(turn), sin(turn)) * inversesqrt(float(FR_SHADOW_SAMPLES));
    // Loops with 0 iterations replace branches, because some drivers execute both sides of a
    // branch.
    int turns = reach > 0.0 ? FR_SHADOW_SAMPLES : 0;
    int blocked = 0;
    float depth = 0.0;
    vec2 towards = start;
    for (int i = 0; i < turns; ++i) {
        vec2 aside = reach * sqrt(float(i) + 0.5) * towards;
        towards = next * towards;
        ivec2 texel = ivec2(floor(((p.xy + aside) * 0.5 + 0.5) * float(tile.z)));
        texel = clamp(texel, ivec2(0), ivec2(tile.z - 1)) + tile.xy;
        float other = texelFetch(map, texel, 0).r;
        if (other > z + max(dot(plane, aside), 0.0) + bias) {
            ++blocked;
            depth += other;
        }
    }
    if (blocked == turns || blocked == 0) turns = 0;
    float radius = max(tan_radius * (depth / float(max(blocked, 1)) - p.z), 2.0 / float(tile.z));
    float seen = blocked > 0 ? 0.0 : float(FR_SHADOW_SAMPLES);
    towards = start;
    for (int i = 0; i < turns; ++i) {
        vec2 aside = radius * sqrt(float(i) + 0.5) * towards;
        towards = next * towards;
        seen += fr_shadow_lit(map, tile, p.xy + aside, z + max(dot(plane, aside), 0.0));
    }
    return seen / float(FR_SHADOW_SAMPLES);
}

#endif
