// Mark, in the depth buffer, the pixels where a part is visible.
// The depth test then skips the shading of the part at all other pixels.
#include "host/visible.glsl"

void main() {
    for (int i = 0; i < SAMPLES; ++i) {
        if (triangle_at(i) < uint(triangles.y)) return;
    }
    discard;
}
