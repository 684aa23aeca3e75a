// Visible fraction of each shadow-casting light at a point, for the float64 reference.
#include "facerender/constants.glsl"
#include "host/light/light.glsl"
#include "host/surface.glsl"
#include "host/shadow.glsl"
#if defined(ALPHA_MASK) || defined(ALPHA_BLEND)
#include "host/alpha.glsl"
#endif

layout(location = 0) out vec4 seen_0;
layout(location = 1) out vec4 seen_4;
layout(location = 2) out vec4 seen_8;
layout(location = 3) out vec4 seen_12;

void main() {
#ifdef VISIBLE
    Point p = point(triangle_at(0));
#else
    Point p = point();
#endif
    Surface s = surface(p);
    float lights[SHADOWS];
    see_lights(s, p, lights);
    float seen[16];
    for (int i = 0; i < 16; ++i) seen[i] = i < SHADOWS ? lights[i] : 1.0;
    seen_0 = vec4(seen[0], seen[1], seen[2], seen[3]);
    seen_4 = vec4(seen[4], seen[5], seen[6], seen[7]);
    seen_8 = vec4(seen[8], seen[9], seen[10], seen[11]);
    seen_12 = vec4(seen[12], seen[13], seen[14], seen[15]);
#ifdef ALPHA_MASK
    share_left();
#endif
#ifdef DEPTH_PEELING
    discard_previous_layers();
#endif
}
