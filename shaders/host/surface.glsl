// What lies under a fragment: geometry and maps, without light. Shared by shade.frag and
// gbuffer.frag, so that the NumPy reference reads exactly what is shaded.
in vec3 position;
in vec3 vertex_normal;
uniform vec3 eye;
#ifdef ALBEDO_FACTOR
uniform vec3 albedo_factor;
#endif
uniform float slope;            // m; the factor on roughness^2 where there is a map
uniform float specular_weight;  // ks; the factor where there is a map
#ifdef UV
in vec2 uv;
#endif
#ifdef VERTEX_COLORS
in vec3 vertex_color;
#endif
#ifdef ALBEDO_MAP
uniform sampler2D albedo_map;
#endif
#ifdef NORMAL_MAP
uniform sampler2D normal_map;
#endif
#ifdef PROPERTY_MAP
uniform sampler2D property_map;  // occlusion, roughness, specular weight
#endif

struct Surface {
    vec3 position;
    vec3 normal;
    vec3 albedo;
    float m;
    float specular_weight;
    float occlusion;
};

#ifdef NORMAL_MAP
// Tangent frame from screen-space derivatives: Schueler (2006), "Normal mapping without precomputed
// tangents", with the sign of the determinant, so that mirrored charts and a flipped screen work.
vec3 mapped_normal(vec3 n) {
    vec3 position_x = dFdx(position);
    vec3 across_y = cross(dFdy(position), n);
    vec3 across_x = cross(n, position_x);
    vec2 uv_x = dFdx(uv);
    vec2 uv_y = dFdy(uv);
    vec3 tangent = across_y * uv_x.x + across_x * uv_y.x;
    vec3 bitangent = across_y * uv_x.y + across_x * uv_y.y;
    // 1e-30: a chart of zero area has a zero frame, and keeps the vertex normal.
    float longest = max(max(dot(tangent, tangent), dot(bitangent, bitangent)), 1e-30);
    float scale = sign(dot(position_x, across_y)) * inversesqrt(longest);
    vec3 texel = texture(normal_map, uv).xyz * 2.0 - 1.0;
    return normalize(texel.x * scale * tangent + texel.y * scale * bitangent + texel.z * n);
}
#endif

Surface surface() {
    vec3 n = normalize(vertex_normal);
    // The inside of an open mesh shows its back; as the image is drawn upside down, that is what
    // OpenGL calls the front. A triangle that is only just turned away, whose normal still lies near
    // the silhouette's, peeks out by rounding of depth, and is no inside.
    if (gl_FrontFacing && dot(n, normalize(eye - position)) < -0.25) n = -n;
#ifdef NORMAL_MAP
    n = mapped_normal(n);
#endif
#ifdef ALBEDO_FACTOR
    vec3 albedo = albedo_factor;
#else
    vec3 albedo = vec3(1.0);
#endif
    Surface s = Surface(position, n, albedo, slope, specular_weight, 1.0);
#ifdef VERTEX_COLORS
    s.albedo *= vertex_color;
#endif
#ifdef ALBEDO_MAP
    s.albedo *= texture(albedo_map, uv).rgb;
#endif
#ifdef PROPERTY_MAP
    vec3 properties = texture(property_map, uv).rgb;
#ifdef OCCLUSION_MAP
    s.occlusion = properties.r;
#endif
#ifdef ROUGHNESS_MAP
    s.m *= properties.g * properties.g;
#endif
#ifdef SPECULAR_MAP
    s.specular_weight *= properties.b;
#endif
#endif
    s.m = max(s.m, FR_MIN_SLOPE);
    return s;
}
