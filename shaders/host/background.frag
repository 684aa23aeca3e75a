// Composite an image over the background colour.
uniform sampler2D image;
uniform vec3 background;
out vec4 radiance;

void main() {
    vec4 seen = texelFetch(image, ivec2(gl_FragCoord.xy), 0);
    radiance = seen + vec4((1.0 - seen.a) * background, 0.0);
}
