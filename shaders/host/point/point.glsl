// Point of the mesh: interpolated vertex attributes.
#ifndef HOST_POINT_GLSL
#define HOST_POINT_GLSL

struct Point {
    vec3 position;
    vec3 normal;  // Interpolated normal, of any length.
    bool inside;  // Whether the camera sees the back face.
#if defined(NORMAL_MAP) || defined(SHADOWS)
    vec3 position_x;  // Change of the position per pixel.
    vec3 position_y;
#endif
#ifdef SHADOWS
    float tangent_plane;  // Interpolated dot product of the vertices' positions and normals.
#endif
#ifdef UV
    vec2 uv;
#if defined(NORMAL_MAP) || defined(VISIBLE)
    vec2 uv_x;  // Change of the normal map's coordinates per pixel.
    vec2 uv_y;
#endif
#endif
#ifdef UV2
    vec2 uv2;
#endif
#ifdef VERTEX_OCCLUSION
    float occlusion;
#endif
#ifdef VERTEX_COLORS
    vec3 color;
#endif
};

#endif
