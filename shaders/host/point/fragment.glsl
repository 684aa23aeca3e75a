// Point of the mesh under a fragment, from interpolated vertex attributes.
#include "host/point/point.glsl"

in vec3 position;
in vec3 vertex_normal;
#ifdef SHADOWS
in float tangent_plane;
#endif
#ifdef UV
in vec2 uv;
#endif
#ifdef UV2
in vec2 uv2;
#endif
#ifdef VERTEX_OCCLUSION
in float vertex_occlusion;
#endif
#ifdef VERTEX_COLORS
in vec3 vertex_color;
#endif

#define TEXEL(map, p, place) texture(map, (p).place)

Point point() {
    Point p;
    p.position = position;
    p.normal = vertex_normal;
    p.inside = gl_FrontFacing;  // True for back faces: the image is drawn upside down.
#if defined(NORMAL_MAP) || defined(SHADOWS)
    p.position_x = dFdx(position);
    p.position_y = dFdy(position);
#endif
#ifdef SHADOWS
    p.tangent_plane = tangent_plane;
#endif
#ifdef UV
    p.uv = uv;
#ifdef NORMAL_MAP
    p.uv_x = dFdx(NORMAL_MAP_UV);
    p.uv_y = dFdy(NORMAL_MAP_UV);
#endif
#endif
#ifdef UV2
    p.uv2 = uv2;
#endif
#ifdef VERTEX_OCCLUSION
    p.occlusion = vertex_occlusion;
#endif
#ifdef VERTEX_COLORS
    p.color = vertex_color;
#endif
    return p;
}
