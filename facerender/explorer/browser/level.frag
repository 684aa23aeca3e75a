// Computes a mip level of a normal map from the next finer level. RGB is the direction of the mean
// vector. A is the deviation of the slopes in the texel, as in facerender/slope_variance.glsl.
// FR_MAP_DEVIATION, and the length of a vector as a function of its deviation, are as in
// scenes/texture.py.
uniform sampler2D finer;
uniform bool finest;  // whether the finer level is the finest, which has unit vectors
uniform ivec2 last;   // last texel of the finer level
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
