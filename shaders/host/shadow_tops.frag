// Largest z of the shadow map around each texel of a level. A texel is `size` blocks wide; its value
// covers every point within half a texel of it.
uniform sampler2D shadow_cones;  // Output of shadow_blocks.frag.
uniform int left;    // First column of the light's blocks.
uniform int column;  // First column of the level.
uniform int size;

out float z;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy) - ivec2(column, 0);
    ivec2 low = max((2 * at - 1) * size >> 1, 0);
    ivec2 high = min(((2 * at + 3) * size - 1) >> 1, textureSize(shadow_cones, 0).y - 1);
    z = texelFetch(shadow_cones, low + ivec2(left, 0), 0).r;
    for (int y = low.y; y <= high.y; ++y) {
        for (int x = low.x; x <= high.x; ++x) {
            z = max(z, texelFetch(shadow_cones, ivec2(left + x, y), 0).r);
        }
    }
}
