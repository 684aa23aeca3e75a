// Environment lighting: irradiance by spherical harmonics, specular radiance by filtered samples.
//
//   unit:     radiance: unit of the map; irradiance: unit of the map times sr
//   error:    Specular light with 32 samples: 0.5 % of the total light on average. Irradiance: 3 %
//             on average, 10 % at most (docs/measurements/skin.md). Float32 rounding: 1e-4 of the
//             reflected radiance, plus 1e-6 of the highest value of the map.
//   source:   Ramamoorthi and Hanrahan (2001), "An efficient representation for irradiance
//             environment maps"; Krivanek and Colbert (2008), "Real-time shading with filtered
//             importance sampling"; map: Praun and Hoppe (2003), "Spherical parametrization".
//
//   map:      Float texture without filtering or mip levels. It stores the radiance over the
//             octahedron |x| + |y| + |z| = 1, seen from +y, with the lower half of the octahedron
//             folded out; x increases to the right, z upwards. The texture contains levels side by
//             side, starting at the lower left. Each level has half the side of the previous level,
//             down to a side of 4 texels. A texel is the mean of four texels of the previous level,
//             weighted by their solid angles. A border of one texel around each level repeats the
//             texels that adjoin the edge on the octahedron.
//   size:     Side of the first level in texels: a power of two, at least 8.
//   n, v:     Unit vectors in map space: normal, direction to the camera.
//   l:        Unit vector in map space: direction to the light.
//   m:        Roughness: RMS slope of the microfacets, in [1e-4, 2].
#ifndef FR_ENVIRONMENT_GLSL
#define FR_ENVIRONMENT_GLSL

#include "constants.glsl"
#include "fresnel.glsl"
#include "masking.glsl"

#ifdef GL_ES
precision highp sampler2D;
#endif

// Rotation from one sampled slope to the next: 1.94161104 radians, pi over the golden ratio.
#define FR_ENVIRONMENT_TURN mat2(-0.36237489, 0.93203242, -0.93203242, -0.36237489)

// Number of sampled directions per lobe: an even number.
#ifndef FR_ENVIRONMENT_SAMPLES
#define FR_ENVIRONMENT_SAMPLES 32
#endif

// Irradiance of a surface from the environment.
//
//   formula:  sum over i of sh[i] times term i of 1, y, z, x, xy, yz, 3 z^2 - 1, xz, x^2 - y^2,
//             with n = (x, y, z)
//   sh:       Nine spherical-harmonic coefficients of the map, up to degree 2.
//   returns:  >= 0.
//   error:    float32 rounding: 1e-6 of the sum of the absolute values of the coefficients.
vec3 fr_environment_irradiance(vec3[9] sh, vec3 n) {
    vec3 first = sh[0] + n.y * sh[1] + n.z * sh[2] + n.x * sh[3];
    vec3 mixed = n.x * n.y * sh[4] + n.y * n.z * sh[5] + n.x * n.z * sh[7];
    vec3 second = (3.0 * n.z * n.z - 1.0) * sh[6] + (n.x * n.x - n.y * n.y) * sh[8];
    return max(first + mixed + second, 0.0);
}

// Value of the map at a position in one level.
//
//   formula:  bilinear interpolation between four texels
//   place:    Position in the level, from lower left to upper right, in [0, 1].
//   level:    Index of the level, from 0.
//   returns:  Within the range of values of the map.
//   error:    float32 rounding: 3e-7 times the side of the level in texels, times the largest
//             difference of adjacent texels.
vec3 fr_environment_level(sampler2D map, int size, vec2 place, int level) {
    int side = size >> level;
    vec2 texel = place * float(side) + 0.5;
    vec2 low = floor(texel);
    vec2 share = texel - low;
    ivec2 at = ivec2(low) + ivec2(2 * (size - side + level), 0);
    vec3 left = mix(
        texelFetch(map, at, 0).rgb, texelFetch(map, at + ivec2(0, 1), 0).rgb, share.y
    );
    vec3 right = mix(
        texelFetch(map, at + ivec2(1, 0), 0).rgb, texelFetch(map, at + ivec2(1, 1), 0).rgb, share.y
    );
    return mix(left, right, share.x);
}

// Mean radiance within a solid angle around a direction.
//
//   formula:      linear interpolation between the two levels whose texels are closest to
//                 solid_angle in size
//   solid_angle:  Solid angle in sr.
//   returns:      Within the range of values of the map.
//   error:        float32 rounding: 2e-6 times the side of the level in texels, times the largest
//                 difference of adjacent texels.
vec3 fr_environment_radiance(sampler2D map, int size, vec3 l, float solid_angle) {
    float inverse = 1.0 / (abs(l.x) + abs(l.y) + abs(l.z));
    vec2 place = l.xz * inverse;
    vec2 folded = (1.0 - abs(place.yx)) * vec2(place.x < 0.0 ? -1.0 : 1.0, place.y < 0.0 ? -1.0 : 1.0);
    place = 0.5 * (l.y < 0.0 ? folded : place) + 0.5;
    // A texel has the side 2/size. The distance of the texel from the centre of the octahedron is
    // `inverse`; the solid angle of the texel is 4/size^2 / distance^3.
    float texels = solid_angle * (0.25 * float(size * size)) * (inverse * inverse * inverse);
    float last = floor(log2(float(size)) - 1.5);
    float level = clamp(0.5 * log2(max(texels, 1e-30)), 0.0, last);
    int low = int(min(level, last - 1.0));
    vec3 near = fr_environment_level(map, size, place, low);
    vec3 far = fr_environment_level(map, size, place, low + 1);
    return mix(near, far, level - float(low));
}

// Tangent axes of a normal, aligned with the camera.
//
//   formula:  first axis: v - (N.V) n, normalised; second axis: n x first axis. The axes are
//             arbitrary if the sine of the angle between n and v is at most 1e-3
//   unit:     none
//   returns:  Two columns of length 1.
//   error:    float32 rounding: 2e-7 divided by the sine of the angle between n and v.
mat2x3 fr_environment_axes(vec3 n, vec3 v) {
    vec3 aside = v - dot(n, v) * n;
    float length_ = length(aside);
    vec3 other = cross(n, abs(n.x) < 0.5 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0));
    vec3 tangent = length_ > 1e-3 ? aside / length_ : normalize(other);
    return mat2x3(tangent, cross(n, tangent));
}

// One sample of the lobe: direction and solid angle.
// The slopes of the samples follow the Beckmann distribution on a spiral. Each slope is used again
// in the opposite direction, for the other side of a V-cavity.
//
//   formula:  half vector n + s with |s|^2 = -m^2 ln(rest), l = 2 (V.H) H - V,
//             solid angle 4 pi m^2 (V.H) (N.H)^3/(N rest), rest = 1 - (i + 1/2)/(N/2)
//   axes:     Result of fr_environment_axes.
//   towards:  Unit vector: direction of the slope in `axes`, at the angle 1.94161104 i radians
//             or opposite. The caller rotates this vector for each next slope, because drivers may
//             compute sin and cos inaccurately.
//   i:        Index of the slope, from 0 to N/2 - 1, with N = FR_ENVIRONMENT_SAMPLES.
//   unit:     l: none; solid angle: sr
//   returns:  l in xyz, its solid angle in w; w <= 0 if the half vector faces away from the camera.
//   error:    float32 rounding: 2e-6 (absolute) for l, 2e-6 (relative) for the solid angle.
vec4 fr_environment_sample(vec3 n, vec3 v, float m, mat2x3 axes, vec2 towards, int i) {
    float rest = 1.0 - (float(i) + 0.5) / float(FR_ENVIRONMENT_SAMPLES / 2);
    float radius = m * sqrt(-log(rest));
    vec3 h = n + axes * (radius * towards);
    float inverse = 1.0 / dot(h, h);
    float v_dot_h = dot(v, h);
    float steradians = 4.0 * FR_PI * m * m * v_dot_h * inverse * inverse;
    return vec4(
        2.0 * v_dot_h * inverse * h - v, steradians / (float(FR_ENVIRONMENT_SAMPLES) * rest)
    );
}

// Environment light that Cook-Torrance with the exact lobe reflects, for a specular weight of 1.
//
//   formula:  mean over the samples of F G (V.H)/((N.V)(N.H)) times the radiance around l
//   f0:       Fresnel reflectance at normal incidence, in [0, 1).
//   fresnel:  FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   masking:  FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
//   returns:  Finite and >= 0; with FR_MASKING_V_CAVITY at most twice the highest value of the map;
//             0 if N.V is at most FR_MIN_COSINE.
vec3 fr_environment_cook_torrance(
    sampler2D map, int size, vec3 n, vec3 v, float m, float f0, int fresnel, int masking
) {
    vec3 total = vec3(0.0);
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    float n_dot_v = dot(n, v);
    if (n_dot_v <= FR_MIN_COSINE) return total;
    mat2x3 axes = fr_environment_axes(n, v);
    vec2 towards = vec2(1.0, 0.0);
    for (int i = 0; i < FR_ENVIRONMENT_SAMPLES; ++i) {
        vec4 s = fr_environment_sample(n, v, slope, axes, towards, i / 2);
        towards = i % 2 == 0 ? -towards : -(FR_ENVIRONMENT_TURN * towards);
        float n_dot_l = dot(n, s.xyz);
        if (n_dot_l <= FR_MIN_COSINE || s.w <= 0.0) continue;
        vec3 h = s.xyz + v;
        float n_dot_h = n_dot_l + n_dot_v;
        float h_dot_h = dot(h, h);
        vec2 masked = fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, masking);
        float weight = fr_fresnel_of(f0, 0.5 * sqrt(h_dot_h), fresnel)
            * masked.x * n_dot_l / (2.0 * masked.y * n_dot_h);
        total += weight * fr_environment_radiance(map, size, s.xyz, s.w);
    }
    return total / float(FR_ENVIRONMENT_SAMPLES);
}

// Environment light that Ward's BRDF with the exact lobe reflects, for a specular reflectance of 1.
//
//   formula:  mean over the samples of (N.H)^3 (V.H) sqrt((N.L)/(N.V)) times the radiance around l
//   returns:  Finite and >= 0; 0 if N.V is at most FR_MIN_COSINE.
vec3 fr_environment_ward(sampler2D map, int size, vec3 n, vec3 v, float m) {
    vec3 total = vec3(0.0);
    float slope = max(FR_SLOPE(m), FR_MIN_SLOPE);
    float n_dot_v = dot(n, v);
    if (n_dot_v <= FR_MIN_COSINE) return total;
    mat2x3 axes = fr_environment_axes(n, v);
    vec2 towards = vec2(1.0, 0.0);
    for (int i = 0; i < FR_ENVIRONMENT_SAMPLES; ++i) {
        vec4 s = fr_environment_sample(n, v, slope, axes, towards, i / 2);
        towards = i % 2 == 0 ? -towards : -(FR_ENVIRONMENT_TURN * towards);
        float n_dot_l = dot(n, s.xyz);
        if (n_dot_l <= FR_MIN_COSINE || s.w <= 0.0) continue;
        vec3 h = s.xyz + v;
        float n_dot_h = n_dot_l + n_dot_v;
        float cubed = n_dot_h * n_dot_h * n_dot_h;
        float weight = 0.5 * cubed / dot(h, h) * sqrt(n_dot_l / n_dot_v);
        total += weight * fr_environment_radiance(map, size, s.xyz, s.w);
    }
    return total / float(FR_ENVIRONMENT_SAMPLES);
}

#endif
