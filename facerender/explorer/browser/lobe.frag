// The lobe at the cosines of a texture: GLSL's own cos() may be off by 2^-11.
uniform sampler2D cosines;
uniform float m;
out vec4 value;

void main() {
    float c = texelFetch(cosines, ivec2(gl_FragCoord.xy), 0).r;
    value = vec4(fr_lobe(c, m, K));
}
