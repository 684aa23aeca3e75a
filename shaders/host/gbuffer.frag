// G-buffer: shading inputs at the centre of a pixel, for the float64 reference and data images.
// NAME_IMAGE is the index of an image. Images without an index are not drawn. With COVERAGE, the
// alpha channels of normal and albedo are 1.
#include "facerender/constants.glsl"
#include "host/surface.glsl"
#if defined(ALPHA_MASK) || defined(ALPHA_BLEND)
#include "host/alpha.glsl"
#endif
#ifdef EMISSIVE
#include "host/emission.glsl"
#endif
#ifdef REFRACTIONS
#include "host/refraction.glsl"
uniform float f0;
#endif

uniform float part;  // Index of the part, from 1; 0 is the background.
#ifdef DEPTH_IMAGE
uniform vec3 forward;
layout(location = DEPTH_IMAGE) out vec2 depth_part;  // Depth relative to the mesh's centre.
#endif
#ifdef POSITION_IMAGE
layout(location = POSITION_IMAGE) out vec4 position_part;
#endif
#ifdef NORMAL_IMAGE
layout(location = NORMAL_IMAGE) out vec4 normal_slope;
#endif
#ifdef ALBEDO_IMAGE
layout(location = ALBEDO_IMAGE) out vec4 albedo_weight;
#endif
#ifdef UV_IMAGE
layout(location = UV_IMAGE) out vec4 uv_occlusion;
#endif
#ifdef LOBES_IMAGE
layout(location = LOBES_IMAGE) out vec4 second_slope_weight;
#endif
#ifdef EMITTED_IMAGE
layout(location = EMITTED_IMAGE) out vec4 emitted;
#endif
#ifdef LAYER_IMAGE
layout(location = LAYER_IMAGE) out vec4 layer;
#endif

void main() {
#ifdef VISIBLE
    uint index = triangle_at(0);
    if (index >= uint(triangles.y)) discard;
    Point p = point(index);
#else
    Point p = point();
#endif
    Surface s = surface(p);
#ifdef COVERAGE
    s.m = s.specular_weight = 1.0;
#endif
#ifdef DEPTH_IMAGE
    depth_part = vec2(dot(s.position, forward), part);
#endif
#ifdef POSITION_IMAGE
    position_part = vec4(s.position, part);
#endif
#ifdef NORMAL_IMAGE
    normal_slope = vec4(s.normal, s.m);
#endif
#ifdef ALBEDO_IMAGE
    albedo_weight = vec4(s.albedo, s.specular_weight);
#endif
#ifdef UV_IMAGE
#ifdef UV
    uv_occlusion = vec4(p.uv, s.occlusion, 1.0);
#else
    uv_occlusion = vec4(0.0, 0.0, s.occlusion, 1.0);
#endif
#ifdef SCATTER
    uv_occlusion.a = dot(normalize(p.normal), s.view);
#endif
#ifdef ALPHA_BLEND
    uv_occlusion.a = opacity_here();
#endif
#endif
#ifdef LOBES_IMAGE
    second_slope_weight = vec4(s.second_m, s.lobe_weight, 0.0, 1.0);
#endif
#ifdef EMITTED_IMAGE
    emitted = vec4(0.0);
#ifdef EMISSIVE
    emitted.rgb = emission(p, s);
#endif
#ifdef REFRACTIONS
    emitted.rgb += refracted(s, f0);
#endif
#endif
#ifdef LAYER_IMAGE
    layer = vec4(gl_FragCoord.z, float(gl_PrimitiveID), 0.0, 1.0);
#endif
#ifdef ALPHA_MASK
    share_left();
#endif
#ifdef DEPTH_PEELING
    discard_previous_layers();
#endif
}
