// Evaluates the lobe at cosines from a texture, because the error of GLSL's cos() may reach 2^-11.
uniform sampler2D cosines;
uniform float m;
out vec4 value;

void main() {
    float c = texelFetch(cosines, ivec2(gl_FragCoord.xy), 0).r;
    value = vec4(fr_lobe(c, m, K));
}
