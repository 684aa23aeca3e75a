// Texture coordinates of each map: uv, unless the program defines others before the include.
#ifndef HOST_TEXTURE_COORDINATES_GLSL
#define HOST_TEXTURE_COORDINATES_GLSL

#ifndef ALBEDO_MAP_UV
#define ALBEDO_MAP_UV uv
#endif
#ifndef NORMAL_MAP_UV
#define NORMAL_MAP_UV uv
#endif
#ifndef PROPERTY_MAP_UV
#define PROPERTY_MAP_UV uv
#endif
#ifndef OCCLUSION_MAP_UV
#define OCCLUSION_MAP_UV uv
#endif
#ifndef ROUGHNESS_MAP_UV
#define ROUGHNESS_MAP_UV uv
#endif
#ifndef SPECULAR_MAP_UV
#define SPECULAR_MAP_UV uv
#endif
#ifndef LOBE_MAP_UV
#define LOBE_MAP_UV uv
#endif
#ifndef OPACITY_MAP_UV
#define OPACITY_MAP_UV uv
#endif
#ifndef EMISSIVE_MAP_UV
#define EMISSIVE_MAP_UV uv
#endif

#endif
