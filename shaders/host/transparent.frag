// Transparent layers over an image: colour times coverage, and coverage.
uniform sampler2D transparent;
out vec4 radiance;

void main() { radiance = texelFetch(transparent, ivec2(gl_FragCoord.xy), 0); }
