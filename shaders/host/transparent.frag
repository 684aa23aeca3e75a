// Draw transparent layers over an image; rgb is colour times coverage, alpha is coverage.
uniform sampler2D transparent;
out vec4 radiance;

void main() { radiance = texelFetch(transparent, ivec2(gl_FragCoord.xy), 0); }
