// One level of a normal map from the finer one: directions of mean vectors in RGB, and in A the
// deviation of the slopes that a texel stands for, as facerender/slope_variance.glsl has it.
// FR_MAP_DEVIATION and the finer level's length, which its deviation tells, are those of
// scenes/texture.py.
uniform sampler2D finer;
uniform bool finest;  // of unit vectors
uniform ivec2 last;   // texel of the finer level
out vec4 texel;

vec3 mean_vector(ivec2 at) {
    vec4 found = texelFetch(finer, min(at, last), 0);
    vec3 direction = normalize(found.xyz * 255.0 - 127.5);
    float deviation = FR_MAP_DEVIATION * found.a;
    return finest ? direction : direction / (1.0 + deviation * deviation);
}

void main() {
    ivec2 at = 2 * ivec2(gl_FragCoord.xy);
    vec3 mean = 0.25 * (
        mean_vector(at) + mean_vector(at + ivec2(1, 0)) + mean_vector(at + ivec2(0, 1))
            + mean_vector(at + ivec2(1, 1)));
    float size = clamp(length(mean), 1e-6, 1.0);
    float deviation = sqrt((1.0 - size) / size) / FR_MAP_DEVIATION;
    texel = vec4(mean / size * 0.5 + 0.5, min(deviation, 1.0));
}
