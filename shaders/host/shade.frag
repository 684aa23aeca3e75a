// Radiance of a point: the sum of irradiance x N.L x BRDF over all lights, plus the ambient term.
// drawing/program.py writes the text before this file:
// - the includes of the kinds of lights;
// - EVERY_LIGHT, which calls add_light for each light and states whether it has a specular term;
// - EVERY_FRACTION, which calls add_fractions for each light of the environment;
// - if a light has a specular term: SPECULAR and specular_term(n, l, v, m, f0); with
//   TWO_LOBES the arguments second_m and lobe_weight precede f0;
// - with ENVIRONMENT_SAMPLES: ENVIRONMENT_RADIANCE, the reflected environment light as an
//   expression of n, v and the arguments that follow v in specular_term.
#include "facerender/constants.glsl"
#ifdef COUPLED
#include "facerender/albedo.glsl"
#endif
#include "host/light/light.glsl"
#include "host/surface.glsl"
#ifdef SHADOWS
#include "host/shadow.glsl"
#endif
#ifdef ENVIRONMENT
#include "host/environment.glsl"
#endif
#if defined(DISC_LIGHTS) || defined(SPHERE_LIGHTS)
#include "facerender/slope_variance.glsl"
#endif
#if defined(ALPHA_MASK) || defined(ALPHA_BLEND)
#include "host/alpha.glsl"
#endif
#ifdef EMISSIVE
#include "host/emission.glsl"
#endif
#ifdef REFRACTIONS
#include "host/refraction.glsl"
#endif

uniform float diffuse_brdf;  // kd/pi.
uniform float f0;
#ifdef AMBIENT
uniform vec3 ambient;  // Irradiance, the same for every normal.
#endif
#ifdef VISIBLE
uniform vec3 background;
#endif
#ifdef TRANSMISSION
uniform float transmission;  // Fraction of the light from behind that passes.
#endif
#ifdef SCATTER
// Inputs of scatter.frag in addition to the radiance. With APART, another pass draws the radiance.
#include "facerender/scatter.glsl"
#ifdef APART
vec4 radiance;
layout(location = 0) out vec4 albedo;
#else
layout(location = 0) out vec4 radiance;
layout(location = 3) out vec4 albedo;
#endif
layout(location = 1) out vec4 light;  // See facerender/scatter.glsl.
layout(location = 2) out vec4 place;
uniform float profile;  // Index of the part's scattering profile, -1 for none.
#else
out vec4 radiance;
#endif

vec3 diffuse;
vec3 specular;
#ifdef COUPLED
mat2x4 specular_albedo;  // See fr_albedo_fit.
float camera_albedo;
float mean_albedo;
#endif

// Add the light from direction l. `spread` is the fraction of the irradiance that the diffuse term
// receives.
void add(Surface s, vec3 v, vec3 l, vec3 irradiance, float spread, bool shines) {
    float cosine = dot(s.normal, l);
#ifdef COUPLED
    float towards = fr_albedo_of(specular_albedo, cosine);
    spread *= fr_diffuse_coupled(towards, camera_albedo, mean_albedo);
#endif
    diffuse += irradiance * spread;
#ifdef SPECULAR
    if (!shines) return;
#ifdef TWO_LOBES
    float term_value = specular_term(s.normal, l, v, s.m, s.second_m, s.lobe_weight, f0);
#else
    float term_value = specular_term(s.normal, l, v, s.m, f0);
#endif
    specular += irradiance * (clamp(cosine, 0.0, 1.0) * term_value);
#endif
}

void add_light(Surface s, vec3 v, Light light, bool shines) {
    float spread = clamp(dot(s.normal, light.direction), 0.0, 1.0);
    add(s, v, light.direction, light.irradiance, spread, shines);
}

#if defined(DISC_LIGHTS) || defined(SPHERE_LIGHTS)
void add_light(Surface s, vec3 v, Disc light, bool shines) {
    vec3 l = light.center.direction;
    float variance =
        fr_slope_variance_disc(light.size.x, light.size.y, 0.5 * length(l + v));
    s.m = fr_slope_filtered(s.m, variance);
#ifdef TWO_LOBES
    s.second_m = fr_slope_filtered(s.second_m, variance);
#endif
    float spread = fr_cosine_disc(dot(s.normal, l), light.size.x, light.size.y);
    add(s, v, l, light.center.irradiance, spread, shines);
}
#endif

#ifdef ENVIRONMENT
void add_environment(Surface s, vec3 v) {
    vec3 received = environment_irradiance(s.normal);
#ifdef ENVIRONMENT_LIGHTS
    vec3[2] fractions = environment_fractions();
    received *= fractions[0];
#else
    received *= s.occlusion;  // The shadows of lights replace it.
#endif
#ifdef COUPLED
    received *= fr_diffuse_coupled(mean_albedo, camera_albedo, mean_albedo);
#endif
    diffuse += received;
#ifdef ENVIRONMENT_SAMPLES
#ifdef TWO_LOBES
    vec3 reflected = environment_specular(s.normal, v, s.m, s.second_m, s.lobe_weight, f0);
#else
    vec3 reflected = environment_specular(s.normal, v, s.m, f0);
#endif
#ifdef ENVIRONMENT_LIGHTS
    reflected *= fractions[1];
#endif
    specular += reflected;
#endif
}
#endif

vec3 shaded(Point p) {
    Surface s = surface(p);
    vec3 v = s.view;
    diffuse = vec3(0.0);
    specular = vec3(0.0);
#ifdef COUPLED
    specular_albedo = fr_albedo_fit(s.m, f0);
#ifdef TWO_LOBES
    specular_albedo *= s.lobe_weight;
    specular_albedo += (1.0 - s.lobe_weight) * fr_albedo_fit(s.second_m, f0);
#endif
    specular_albedo *= s.specular_weight;
    mean_albedo = fr_albedo_mean(specular_albedo);
    camera_albedo = fr_albedo_of(specular_albedo, dot(s.normal, v));
#endif
#ifdef AMBIENT
#ifdef COUPLED
    diffuse += ambient * s.occlusion * fr_diffuse_coupled(mean_albedo, camera_albedo, mean_albedo);
#else
    diffuse += ambient * s.occlusion;
#endif
#endif
#ifdef SHADOWS
    float seen[SHADOWS];
    see_lights(s, p, seen);
#endif
    EVERY_LIGHT
#ifdef SCATTER
    light = vec4(diffuse, fr_scatter_area(dot(normalize(p.normal), v)));
    place = vec4(s.position, profile);
    albedo = vec4(diffuse_brdf * s.albedo, 1.0);
#endif
#ifdef ENVIRONMENT
    EVERY_FRACTION
    add_environment(s, v);  // After SCATTER: this slowly varying light is not scattered.
#endif
    vec3 result = vec3(0.0);
#ifdef DIFFUSE
    result += diffuse_brdf * s.albedo * diffuse;
#endif
#if defined(SPECULAR) || defined(ENVIRONMENT_SAMPLES)
    result += s.specular_weight * specular;
#endif
#ifdef EMISSIVE
    result += emission(p, s);
#endif
#ifdef REFRACTIONS
    result += refracted(s, f0);
#endif
    return result;
}

#ifdef PIXEL_RATE
// Per-pixel shading of the pixels that visible.frag marked. The program shades only the triangle
// that most samples of the pixel see. It adds the difference from the background, weighted by
// coverage.
void main() {
    uint count = uint(triangles.y);
    uint seen[SAMPLES];
    for (int i = 0; i < SAMPLES; ++i) seen[i] = triangle_at(i);
    uint triangle = count;
    float weight = 0.0;
    int most = 0;
    for (int i = 0; i < SAMPLES; ++i) {
        if (seen[i] >= count) continue;
        weight += 1.0 / float(SAMPLES);
        int alike = 0;
        for (int j = 0; j < SAMPLES; ++j) alike += int(seen[j] == seen[i]);
        if (alike >= most) {
            most = alike;
            triangle = seen[i];
        }
    }
    radiance = weight * vec4(shaded(point(triangle)) - background, 1.0);
}
#elif defined(VISIBLE)
// Shading of the pixels that visible.frag marked. If several samples see the same triangle, the
// program shades this triangle once, at the centre of the pixel, as OpenGL does for multisampling.
// It adds the difference from the background, weighted by coverage.
void main() {
    uint count = uint(triangles.y);
    uint seen[SAMPLES];
    uint triangle = count;
    for (int i = 0; i < SAMPLES; ++i) {
        seen[i] = triangle_at(i);
        if (seen[i] < count) triangle = seen[i];
    }
    radiance = vec4(0.0);
    do {
        float weight = 0.0;
        uint next = count;
        for (int i = 0; i < SAMPLES; ++i) {
            if (seen[i] == triangle) {
                weight += 1.0 / float(SAMPLES);
                seen[i] = count;
            } else if (seen[i] < count) {
                next = seen[i];
            }
        }
        radiance += weight * vec4(shaded(point(triangle)) - background, 1.0);
        triangle = next;
    } while (triangle < count);
}
#elif defined(BEHIND_REFRACTION)
// Radiance and z in a map of refraction.glsl. Fragments in front of the refracting part are
// discarded.
uniform mat4 to_map;
uniform sampler2D refraction_surface;

void main() {
    float z = (to_map * vec4(position, 1.0)).z;
    float front = texelFetch(refraction_surface, ivec2(gl_FragCoord.xy), 0).r;
    if (z > front + 0.02) discard;  // The rim of a cornea may be just below the sclera.
    radiance = vec4(shaded(point()), z);
#ifdef ALPHA_MASK
    share_left();
#endif
}
#elif defined(ALPHA_MASK)
void main() {
    radiance = vec4(shaded(point()), 1.0);
    radiance.a = share_left();  // With multisampling OpenGL then sets alpha to 1 (alpha to one).
}
#elif defined(TRANSMISSION)
void main() { radiance = opacity_here() * vec4(shaded(point()), 1.0 - transmission); }
#elif defined(ALPHA_BLEND)
void main() { radiance = opacity_here() * vec4(shaded(point()), 1.0); }
#else
void main() { radiance = vec4(shaded(point()), 1.0); }
#endif
