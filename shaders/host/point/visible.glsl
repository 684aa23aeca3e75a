// Point where the ray through the centre of a pixel intersects the plane of a triangle.
// triangle_table.frag packs a triangle: its plane, and its attributes as affine functions of the
// position. Method: Burns and Hunt (2013), "The visibility buffer: a cache-friendly approach to
// deferred shading".
#include "host/point/point.glsl"
#include "host/visible.glsl"

uniform sampler2D triangle_table;
// Ray from the camera to the far plane, at the outer corner of the first pixel; and its change to the
// next pixel to the right, and to the next row. For an orthographic camera, start of the ray and its
// changes; the ray to the far plane is then -camera_position.
uniform mat3 rays;

#define TEXEL(map, p, place) textureGrad(map, (p).place, (p).uv_x, (p).uv_y)

vec4 texel_of(uint triangle, int index) {
    int row = int(triangle) / TRIANGLES_IN_ROW;
    int column = int(triangle) - row * TRIANGLES_IN_ROW;
    int others = TRIANGLES_IN_ROW + column * (TRIANGLE_TEXELS - 1) + index - 1;
    return texelFetch(triangle_table, ivec2(index == 0 ? column : others, row), 0);
}

float affine(uint triangle, int index, vec3 position) {
    vec4 function = texel_of(triangle, index);
    return dot(function.xyz, position) + function.w;
}

vec3 view_ray() { return rays[0] + gl_FragCoord.x * rays[1] + gl_FragCoord.y * rays[2]; }

Point point(uint triangle) {
    vec4 plane = texel_of(triangle, 0);
    bool parallel = camera_position.w == 0.0;
    vec3 ray = view_ray();
    vec3 start = parallel ? ray : camera_position.xyz;
    vec3 direction = parallel ? -camera_position.xyz : ray;
    float across = dot(direction, plane.xyz);
    Point p;
    p.inside = across > 0.0;
    // The ray may intersect the plane of an edge-on triangle at any distance. The distance is
    // clamped to [1e-3, 1]: 1 is the far plane, and nothing is drawn nearer than 1e-3
    // (scene/view.py).
    if (abs(across) < 1e-7) across = 1e-7;
    float distance = clamp((plane.w - dot(start, plane.xyz)) / across, 1e-3, 1.0);
    p.position = start + distance * direction;
    p.normal = vec3(
        affine(triangle, 1, p.position), affine(triangle, 2, p.position), affine(triangle, 3, p.position)
    );
#if defined(UV) || defined(SHADOWS)
    float spread = parallel ? 1.0 : distance;
    vec3 position_x = spread * (rays[1] - direction * (dot(rays[1], plane.xyz) / across));
    vec3 position_y = spread * (rays[2] - direction * (dot(rays[2], plane.xyz) / across));
#endif
#ifdef UV
    vec4 u = texel_of(triangle, 4);
    vec4 v = texel_of(triangle, 5);
    p.uv = vec2(dot(u.xyz, p.position) + u.w, dot(v.xyz, p.position) + v.w);
    p.uv_x = vec2(dot(u.xyz, position_x), dot(v.xyz, position_x));
    p.uv_y = vec2(dot(u.xyz, position_y), dot(v.xyz, position_y));
#endif
#if defined(NORMAL_MAP) || defined(SHADOWS)
    p.position_x = position_x;
    p.position_y = position_y;
#endif
#ifdef SHADOWS
    p.tangent_plane = affine(triangle, TRIANGLE_TEXELS - 1, p.position);
#endif
#ifdef VERTEX_OCCLUSION
#ifdef UV
    p.occlusion = affine(triangle, 6, p.position);
#else
    p.occlusion = affine(triangle, 4, p.position);
#endif
#endif
#ifdef VERTEX_COLORS
    p.color = vec3(
        affine(triangle, TRIANGLE_TEXELS - 4, p.position),
        affine(triangle, TRIANGLE_TEXELS - 3, p.position),
        affine(triangle, TRIANGLE_TEXELS - 2, p.position)
    );
#endif
    return p;
}
