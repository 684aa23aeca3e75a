// Largest z in each block of texels of the shadow map.
uniform sampler2D shadow_map;
uniform int block;  // Width and height of a block in texels.

out float z;

void main() {
    ivec2 first = block * ivec2(gl_FragCoord.xy);
    z = texelFetch(shadow_map, first, 0).r;
    for (int y = 0; y < block; ++y) {
        for (int x = 0; x < block; ++x) z = max(z, texelFetch(shadow_map, first + ivec2(x, y), 0).r);
    }
}
