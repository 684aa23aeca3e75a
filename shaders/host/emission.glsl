// Emissive radiance of a surface.
uniform vec3 emissive;  // Emitted radiance.
#ifdef EMISSIVE_MAP
uniform sampler2D emissive_map;
#endif

vec3 emission(Point p) {
#ifdef EMISSIVE_MAP
    return emissive * TEXEL(emissive_map, p, EMISSIVE_MAP_UV).rgb;
#else
    return emissive;
#endif
}
