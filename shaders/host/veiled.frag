// What lies over an image: colour times coverage, and coverage.
uniform sampler2D veil;
out vec4 radiance;

void main() { radiance = texelFetch(veil, ivec2(gl_FragCoord.xy), 0); }
