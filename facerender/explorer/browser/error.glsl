// error_at returns three errors of B against A at a pixel, each in the worst channel, and coverage.
//   x   error of the linear radiance
//   y   error of the displayed image in 8-bit levels, before rounding
//   z   error of the linear radiance, relative to max(A, 0.01)
//   w   coverage of A
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D a;
uniform sampler2D b;
uniform float exposure;  // factor of the radiance, but not of the background
uniform vec3 background;

vec3 displayed(vec4 image) {
    vec3 behind = (1.0 - image.a) * background;
    vec3 x = clamp(exposure * (image.rgb - behind) + behind, 0.0, 1.0);
    vec3 curve = 1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
    return mix(curve, 12.92 * x, vec3(lessThanEqual(x, vec3(0.0031308))));
}

float worst(vec3 each) { return max(max(each.r, each.g), each.b); }

vec4 error_at(ivec2 at) {
    vec4 first = texelFetch(a, at, 0);
    vec4 second = texelFetch(b, at, 0);
    vec3 apart = abs(second.rgb - first.rgb);
    float steps = 255.0 * worst(abs(displayed(second) - displayed(first)));
    return vec4(worst(apart), steps, worst(apart / max(first.rgb, vec3(0.01))), first.a);
}
