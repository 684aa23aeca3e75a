// Emissive radiance of a surface. An unlit surface emits its albedo.
uniform vec3 emissive;  // Emitted radiance, or factor on the albedo of an unlit surface.
#ifdef EMISSIVE_MAP
uniform sampler2D emissive_map;
#endif

vec3 emission(Point p, Surface s) {
#if defined(UNLIT)
    return emissive * s.albedo;
#elif defined(EMISSIVE_MAP)
    return emissive * TEXEL(emissive_map, p, EMISSIVE_MAP_UV).rgb;
#else
    return emissive;
#endif
}
