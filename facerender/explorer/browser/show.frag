// Shows A left of the cut and B right of the cut, or their difference. Pixels whose error exceeds
// the budget are red. Colours are on a square-root scale, because a few pixels often have errors far
// above the others. Row 0 of an image is on top.
uniform int height;
uniform int cut;           // distance of the cut from the left side, in pixels
uniform bool difference;
uniform float gain;
uniform float budget;      // 8-bit levels; negative for no budget
out vec4 color;

vec3 heat(float x) {
    const vec3 stops[5] = vec3[5](
        vec3(0.0), vec3(0.09, 0.17, 0.45), vec3(0.10, 0.52, 0.58), vec3(0.66, 0.82, 0.36),
        vec3(1.0, 1.0, 0.9));
    float place = 4.0 * clamp(x, 0.0, 1.0);
    int low = min(int(place), 3);
    return mix(stops[low], stops[low + 1], place - float(low));
}

void main() {
    ivec2 at = ivec2(int(gl_FragCoord.x), height - 1 - int(gl_FragCoord.y));
    vec4 error = error_at(at);
    vec4 image = at.x < cut ? texelFetch(a, at, 0) : texelFetch(b, at, 0);
    color = vec4(difference ? heat(sqrt(gain * error.y / 255.0)) : displayed(image), 1.0);
    if (budget >= 0.0 && error.y > budget) color.rgb = mix(color.rgb, vec3(1.0, 0.0, 0.05), 0.85);
}
