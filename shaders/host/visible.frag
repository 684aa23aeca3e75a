// Marks, by its depth, where a part is visible, so that what shades the part is not begun elsewhere.
#include "host/visible.glsl"

void main() {
    for (int i = 0; i < SAMPLES; ++i) {
        if (facet_at(i) < uint(facet_count)) return;
    }
    discard;
}
