// z above which a point is certain to see the whole light: the shadow map's blocks, each widened
// downwards by a pyramid that contains the light's cone. Two passes per axis and stride.
uniform sampler2D shadow_cones;
uniform ivec2 stride;  // Distance of two samples in blocks; one component is 0.
uniform int left;      // First column of the light's tile.
uniform float fall;    // Decrease of z per block.

out float z;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    int blocks = textureSize(shadow_cones, 0).y;
    ivec2 last = ivec2(left + blocks - 1, blocks - 1);
    z = texelFetch(shadow_cones, at, 0).r;
    for (int i = 1; i <= 3; ++i) {
        ivec2 low = clamp(at - i * stride, ivec2(left, 0), last);
        ivec2 high = clamp(at + i * stride, ivec2(left, 0), last);
        float other = max(texelFetch(shadow_cones, low, 0).r, texelFetch(shadow_cones, high, 0).r);
        // The occluder and the point may be anywhere in their blocks.
        z = max(z, other - fall * (float(i * (stride.x + stride.y)) - 0.75));
    }
}
