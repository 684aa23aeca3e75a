// Point of the mesh: interpolated vertex attributes.
#ifndef HOST_POINT_GLSL
#define HOST_POINT_GLSL

struct Point {
    vec3 position;
    vec3 normal;  // any length
#ifdef CURVATURE
    vec3 normal_x;  // change per pixel
    vec3 normal_y;
#endif
    bool inside;  // whether the back face is visible
#if defined(NORMAL_MAP) || defined(SHADOWS)
    vec3 position_x;  // change per pixel
    vec3 position_y;
#endif
#ifdef UV
    vec2 uv;
#if defined(NORMAL_MAP) || defined(VISIBLE)
    vec2 uv_x;  // change per pixel of the coordinates of the normal map
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
