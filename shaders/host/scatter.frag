// Subsurface scattering: add the change of the diffuse light to an image, and composite the image
// over the background.
// The depth test limits the program to the pixels that scatter_mask.frag marked.
#include "facerender/constants.glsl"
#include "facerender/scatter.glsl"
#include "host/scattering.glsl"

uniform sampler2D light;  // See facerender/scatter.glsl.
uniform sampler2D albedo;
uniform vec3 background;
uniform vec4 camera_position;  // Homogeneous: w is 0 for the direction of an orthographic camera.
uniform vec3 forward;  // Unit vector: viewing direction of the camera.
uniform float pixels;  // Pixels per unit of length across the view, at depth 1; orthographic: at every depth.
uniform vec4[FR_SCATTER_GAUSSIANS] gaussians;
uniform vec3 rest;
uniform vec3[FR_SCATTER_SAMPLES] spiral;
out vec4 radiance;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 seen = texelFetch(image, pixel, 0);
    ivec2 at = stand_in(pixel);
    float depth = dot(texelFetch(place, at, 0).xyz - camera_position.xyz, forward);
    float scale = pixels / (camera_position.w > 0.0 ? depth : 1.0);
    vec3 scattered = fr_scatter(light, place, at, scale, gaussians, rest, spiral);
    vec3 change = scattered - texelFetch(light, at, 0).rgb;
    vec3 color = seen.rgb + seen.a * texelFetch(albedo, at, 0).rgb * change;
    radiance = vec4(color + (1.0 - seen.a) * background, seen.a);
}
