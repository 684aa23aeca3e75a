// Draw transparent layers over an image; rgb is colour times coverage, alpha is coverage. The values
// of a pixel's samples are averaged.
#if SAMPLES > 1
uniform sampler2DMS transparent;
#else
uniform sampler2D transparent;
#endif
out vec4 radiance;

void main() {
    radiance = vec4(0.0);
    for (int i = 0; i < SAMPLES; ++i) {
        radiance += texelFetch(transparent, ivec2(gl_FragCoord.xy), i) / float(SAMPLES);
    }
}
