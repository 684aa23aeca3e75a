// Surface at a point: geometry and maps, without light.
// shade.frag and gbuffer.frag share this code, so that the NumPy reference reads exactly the shaded
// values.
#include "host/texture_coordinates.glsl"
uniform vec4 camera_position;  // Homogeneous: w is 0 for the direction of an orthographic camera.
#ifdef VISIBLE
#include "host/point/visible.glsl"
#else
#include "host/point/fragment.glsl"
#endif
#ifdef ALBEDO_FACTOR
uniform vec3 albedo_factor;
#endif
uniform float slope;            // m; with a roughness map, the factor on roughness^2.
uniform float specular_weight;  // ks; with a specular map, the factor on the map's value.
#ifdef ALBEDO_MAP
uniform sampler2D albedo_map;
#endif
#ifdef NORMAL_MAP
uniform sampler2D normal_map;
#ifdef NORMAL_STRENGTH
uniform float normal_strength;  // Factor on x and y of the mapped normal.
#endif
#endif
#ifdef PROPERTY_MAP
uniform sampler2D property_map;  // Occlusion, roughness, specular weight.
#endif
#ifdef PROPERTIES_APART
#ifdef OCCLUSION_MAP
uniform sampler2D occlusion_map;
#endif
#ifdef ROUGHNESS_MAP
uniform sampler2D roughness_map;
#endif
#ifdef SPECULAR_MAP
uniform sampler2D specular_map;
#endif
#endif
#ifdef OCCLUSION_STRENGTH
uniform float occlusion_strength;  // Weight of the occlusion map.
#endif
#ifdef TWO_LOBES
uniform float second_slope;  // Ratio of the second lobe's m to the first lobe's m.
uniform float lobe_weight;   // Weight of the first lobe.
#endif
#ifdef LOBE_MAP
uniform sampler2D lobe_map;  // Red: factor on the weight 1 - lobe_weight of the second lobe.
#endif

#ifdef SLOPE_FILTER
#include "facerender/slope_variance.glsl"
#endif

struct Surface {
    vec3 position;
    vec3 view;  // Unit vector to the camera.
    vec3 normal;
    vec3 albedo;
    float m;
    float specular_weight;
    float occlusion;
#ifdef TWO_LOBES
    float second_m;
    float lobe_weight;
#endif
};

#ifdef NORMAL_MAP
// Tangent frame from screen-space derivatives: Schueler (2006), "Normal mapping without precomputed
// tangents". The sign of the determinant handles mirrored charts and a flipped screen. The frame
// does not depend on the length or the sign of the normal; `facing` is the sign.
vec3 mapped_normal(Point p, float square, float facing) {
    vec3 across_y = cross(p.position_y, p.normal);
    vec3 across_x = cross(p.normal, p.position_x);
    vec3 tangent = across_y * p.uv_x.x + across_x * p.uv_y.x;
    vec3 bitangent = across_y * p.uv_x.y + across_x * p.uv_y.y;
    // A UV chart of zero area has a zero frame; the minimum 1e-30 then keeps the vertex normal.
    float longest = max(max(dot(tangent, tangent), dot(bitangent, bitangent)), 1e-30);
    float scale = square * inversesqrt(square * longest);  // Scales to the vertex normal's length.
    if (dot(p.position_x, across_y) < 0.0) scale = -scale;
    vec3 texel = TEXEL(normal_map, p, NORMAL_MAP_UV).xyz;  // In [0, 1], encodes [-1, 1].
    vec2 along = texel.xy * (2.0 * scale) - scale;
#ifdef NORMAL_STRENGTH
    along *= normal_strength;
#endif
    float up = facing * (texel.z * 2.0 - 1.0);
    return normalize(along.x * tangent + along.y * bitangent + up * p.normal);
}
#endif

Surface surface(Point p) {
    vec3 v = normalize(camera_position.xyz - camera_position.w * p.position);
    float square = dot(p.normal, p.normal);
    // Inside open meshes back faces are visible, and their normals are flipped. A triangle just
    // behind the silhouette may also be visible, because depth is rounded; the normal of such a
    // triangle is not flipped. The test uses the unnormalised normal: interpolation shortens the
    // normal in curved triangles, where normals may point further away from the camera.
    float facing = p.inside && dot(p.normal, v) < -0.2 ? -1.0 : 1.0;
    vec3 n = facing * inversesqrt(square) * p.normal;
#ifdef NORMAL_MAP
    n = mapped_normal(p, square, facing);
#ifdef SLOPE_FILTER
#ifdef NORMAL_STRENGTH
    float strength2 = normal_strength * normal_strength;
    float variance = strength2 * fr_slope_variance_map(TEXEL(normal_map, p, NORMAL_MAP_UV).a);
#else
    // mapped_normal fetches the same texel; compilers fetch it once.
    float variance = fr_slope_variance_map(TEXEL(normal_map, p, NORMAL_MAP_UV).a);
#endif
#endif
#endif
#ifdef ALBEDO_FACTOR
    vec3 albedo = albedo_factor;
#else
    vec3 albedo = vec3(1.0);
#endif
#ifdef TWO_LOBES
    Surface s = Surface(p.position, v, n, albedo, slope, specular_weight, 1.0, slope, lobe_weight);
#else
    Surface s = Surface(p.position, v, n, albedo, slope, specular_weight, 1.0);
#endif
#ifdef VERTEX_COLORS
    s.albedo *= p.color;
#endif
#ifdef ALBEDO_MAP
    s.albedo *= TEXEL(albedo_map, p, ALBEDO_MAP_UV).rgb;
#endif
#ifdef PROPERTY_MAP
    vec3 properties = TEXEL(property_map, p, PROPERTY_MAP_UV).rgb;
#endif
#ifdef PROPERTIES_APART
    vec3 properties = vec3(1.0);
#ifdef OCCLUSION_MAP
    properties.r = TEXEL(occlusion_map, p, OCCLUSION_MAP_UV).r;
#endif
#ifdef ROUGHNESS_MAP
    properties.g = TEXEL(roughness_map, p, ROUGHNESS_MAP_UV).r;
#endif
#ifdef SPECULAR_MAP
    properties.b = TEXEL(specular_map, p, SPECULAR_MAP_UV).r;
#endif
#endif
#if defined(PROPERTY_MAP) || defined(PROPERTIES_APART)
#ifdef OCCLUSION_MAP
    s.occlusion = properties.r;
#ifdef OCCLUSION_STRENGTH
    s.occlusion = 1.0 + occlusion_strength * (s.occlusion - 1.0);
#endif
#endif
#ifdef ROUGHNESS_MAP
    s.m *= properties.g * properties.g;
#endif
#ifdef SPECULAR_MAP
    s.specular_weight *= properties.b;
#endif
#endif
#ifdef VERTEX_OCCLUSION
    s.occlusion *= clamp(p.occlusion, 0.0, 1.0);  // May be extrapolated beyond an edge.
#endif
#ifdef TWO_LOBES
    s.second_m = s.m * second_slope;
#ifdef LOBE_MAP
    s.lobe_weight = 1.0 - (1.0 - lobe_weight) * TEXEL(lobe_map, p, LOBE_MAP_UV).r;
#endif
#endif
#if defined(SLOPE_FILTER) && !defined(CONSTANT_SLOPE)
    s.m = fr_slope_filtered(s.m, variance);
#ifdef TWO_LOBES
    s.second_m = fr_slope_filtered(s.second_m, variance);
#endif
#else
    s.m = max(s.m, FR_MIN_SLOPE);
#ifdef TWO_LOBES
    s.second_m = max(s.second_m, FR_MIN_SLOPE);
#endif
#endif
    return s;
}
