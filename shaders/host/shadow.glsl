// Visibility of the shadow-casting lights at a point.
// SHADOWS is the number of shadow-casting lights. SHADOW_DISCS is defined if one of them has a
// radius.
#include "facerender/shadow.glsl"

uniform sampler2D shadow_map;  // One square tile per light, side by side.
uniform mat4 shadow_view[SHADOWS];   // Matrix from the renderer's space to light space.
uniform vec2 shadow_size[SHADOWS];   // Tangent of the light's angular radius; largest z.

const float BIAS = 0.004;
// Noise: Jimenez (2014), "Next generation post processing in Call of Duty: Advanced Warfare".
const vec2 NOISE = vec2(0.06711056, 0.00583715);

#ifdef SHADOW_DISCS
// Return the change of z with x and y on the plane of the triangle, in light space. The change is
// unbounded for edge-on triangles; it is clamped to [-8, 8].
vec2 plane_of(mat4 view, vec3 at, Point p) {
    vec4 x = view * vec4(p.position_x, 0.0);
    vec4 y = view * vec4(p.position_y, 0.0);
    vec3 across = cross(x.xyz - at * x.w, y.xyz - at * y.w);
    across *= inversesqrt(max(dot(across, across), 1e-30));
    return clamp(-across.xy / (abs(across.z) < 0.05 ? 0.05 : across.z), -8.0, 8.0);
}
#endif

// Return the visible fraction of a light. The light is visible down to an angle below the
// horizon; `below` is the sine of this angle.
float visibility(int i, Surface s, Point p, vec3 direction, float below) {
    bool dark = dot(s.normal, direction) <= -below;
    int texels = textureSize(shadow_map, 0).y;
    ivec3 tile = ivec3(i * texels, 0, texels);
    vec3 n = normalize(p.normal);
    if (dot(n, s.normal) < 0.0) n = -n;
    vec4 place = shadow_view[i] * vec4(p.position + 2.5 / float(texels) * n, 1.0);
    vec3 at = place.xyz / place.w;
#ifdef SHADOW_DISCS
    if (shadow_size[i].x > 0.0) {
        float turn = 6.2831853 * fract(52.9829189 * fract(dot(gl_FragCoord.xy, NOISE)));
        vec2 plane = plane_of(shadow_view[i], at, p);
        float top = dark ? at.z : shadow_size[i].y;
        return fr_shadow_disc(
            shadow_map, tile, at, plane, shadow_size[i].x, top, BIAS, turn
        );
    }
#endif
    return dark ? 1.0 : fr_shadow_hard(shadow_map, tile, at, BIAS);
}

float share(Light light, int shadow, Surface s, Point p) {
    return visibility(shadow, s, p, light.direction, 0.0);
}

Light shadowed(Light light, int shadow, Surface s, Point p) {
    light.irradiance *= share(light, shadow, s, p);
    return light;
}

#ifdef HOST_LIGHT_AREA_GLSL
float share(Disc light, int shadow, Surface s, Point p) {
    return visibility(shadow, s, p, light.center.direction, light.size.x);
}

Disc shadowed(Disc light, int shadow, Surface s, Point p) {
    light.center.irradiance *= share(light, shadow, s, p);
    return light;
}
#endif
