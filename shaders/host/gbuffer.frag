// G-buffer: all shading inputs at the centre of a pixel, for the float64 reference and the data
// views.
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
layout(location = 0) out vec4 position_part;
layout(location = 1) out vec4 normal_slope;
layout(location = 2) out vec4 albedo_weight;
layout(location = 3) out vec4 uv_occlusion;
// LOBES, EMITTED and LAYER are the indices of their images.
#ifdef LOBES
layout(location = LOBES) out vec4 second_slope_weight;
#endif
#ifdef EMITTED
layout(location = EMITTED) out vec4 emitted;
#endif
#ifdef LAYER
layout(location = LAYER) out vec4 layer;
#endif

void main() {
#ifdef VISIBLE
    Point p = point(triangle_at(0));
#else
    Point p = point();
#endif
    Surface s = surface(p);
    position_part = vec4(s.position, part);
    normal_slope = vec4(s.normal, s.m);
    albedo_weight = vec4(s.albedo, s.specular_weight);
#ifdef UV
    uv_occlusion = vec4(p.uv, s.occlusion, 1.0);
#else
    uv_occlusion = vec4(0.0, 0.0, s.occlusion, 1.0);
#endif
#ifdef LOBES
    second_slope_weight = vec4(s.second_m, s.lobe_weight, 0.0, 1.0);
#endif
#ifdef SCATTER
    uv_occlusion.a = dot(normalize(p.normal), s.view);
#endif
#ifdef ALPHA_BLEND
    uv_occlusion.a = opacity_here();
#endif
#ifdef EMITTED
    emitted = vec4(0.0);
#ifdef EMISSIVE
    emitted.rgb = emission(p);
#endif
#ifdef REFRACTIONS
    emitted.rgb += refracted(s, f0);
#endif
#endif
#ifdef LAYER
    layer = vec4(gl_FragCoord.z, float(gl_PrimitiveID), 0.0, 1.0);
#endif
#ifdef ALPHA_MASK
    share_left();
#endif
#ifdef DEPTH_PEELING
    discard_previous_layers();
#endif
}
