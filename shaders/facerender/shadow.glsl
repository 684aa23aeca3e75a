// Shadows: how much of a light a place sees, from a map of what stands nearest to the light.
//
//   unit      none, in [0, 1]
//   error     against rays: docs/measurements/skin.md; each function's own in float32 is none but
//             where a depth equals that of the map within rounding, and the answer is 0 or 1
//   source    Williams (1978), "Casting curved shadows on curved surfaces"; discs: Fernando (2005),
//             "Percentage-closer soft shadows"
//
// Places are in the light's space: x and y across its direction, from -1 to 1 over the map; z grows
// towards the light, by as much as x and y for the same length. Of a point light at distance d from
// the centre of a mesh in the unit sphere, with its z along the axis and s = sqrt(1 - 1/d^2), it is
// s d (x, y, z)/(d - z): seen in it, rays are parallel, planes plane, and a sphere's shadow widens
// as that of a distant disc.
//
//   map      its red channel is the z of what is nearest to the light in each texel, less than any
//            place's where nothing is; a float texture without filtering
//   tile     the first texel of the light's map and how many it has a side, so that one texture may
//            hold those of several lights; nothing outside of it casts shadows
//   p        the place in the light's space, moved by 1.25 texels, 2.5/tile.z, along the normal
//            of the mesh
//   bias     by how much more z counts, such as 0.004
#ifndef FR_SHADOW_GLSL
#define FR_SHADOW_GLSL

#include "constants.glsl"

#ifdef GL_ES
precision highp sampler2D;
#endif

// How many places fr_shadow_disc looks at for what stands before the light, and again for how much
// of it is seen.
#ifndef FR_SHADOW_SAMPLES
#define FR_SHADOW_SAMPLES 12
#endif

// Whether a place of the map is lit at a depth, 0 or 1, interpolated between four texels.
//
//   formula   step(map, z), bilinear
//   at, z     place and depth in the light's space
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

// How much of a light without size a place sees.
//
//   formula   fr_shadow_lit at p, with the bias
float fr_shadow_hard(sampler2D map, ivec3 tile, vec3 p, float bias) {
    return fr_shadow_lit(map, tile, p.xy, p.z + bias);
}

// How much of a disc or a sphere of light a place sees.
//
//   formula      with the mean z of what stands before the light, within the tangent times the
//                largest difference of z: the mean of fr_shadow_lit over the disc that the light
//                becomes when it is seen from p through a hole there; of both, at points of a spiral
//                (Vogel 1979), at sqrt((i + 1/2)/N) and the angle 2.39996 i + turn. 1 where nothing
//                stands before the light, and 0 where something does at every point
//   plane        change of z with x and y on the plane through p that touches the surface, of at
//                most 8
//   tan_radius   tangent of the angle between the centre and the rim of the light, as seen from the
//                centre of the mesh, in (0, tan(20 degrees)]
//   top          largest z of what casts shadows: 1 for a distant light, s d/(d - 1) for a point
//                light; p.z where nothing needs to be looked at, and the answer is 1
//   turn         radians, of the spiral; another one at each pixel makes noise of what else were
//                bands
float fr_shadow_disc(
    sampler2D map, ivec3 tile, vec3 p, vec2 plane, float tan_radius, float top, float bias,
    float turn
) {
    const mat2 next = mat2(-0.73736888, 0.67549029, -0.67549029, -0.73736888);
    float z = p.z + bias;
    float reach = tan_radius * clamp(top - p.z, 0.0, 1.0);
    vec2 start = vec2(cos(turn), sin(turn)) * inversesqrt(float(FR_SHADOW_SAMPLES));
    // Loops of no turns, for drivers that execute what a branch leaves out as well.
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
