// Computes a mip level of a normal map from the next finer level. RGB is the direction of the mean
// vector. A is the standard deviation of the slopes in the texel, divided by FR_MAP_DEVIATION from
// facerender/slope_variance.glsl. texture/mips.py computes A from the length of the mean vector in the
// same way.
uniform sampler2D finer;
uniform bool finest;  // whether `finer` is level 0, which has unit vectors
uniform ivec2 last;   // last texel of `finer`
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
