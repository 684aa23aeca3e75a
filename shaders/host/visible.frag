// Marks, by its depth, where a part is visible, so that what shades the part is not begun elsewhere.
#include "host/visible.glsl"

void main() {
    for (int i = 0; i < SAMPLES; ++i) {
        if (triangle_at(i) < uint(triangle_count)) return;
    }
    discard;
}
