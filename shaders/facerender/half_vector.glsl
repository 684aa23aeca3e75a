// Squares of the half vector h = L + V, which keeps its length: nothing here is normalised.
//
//   n         normal, a unit vector
//   h         l + v, of any length
//   n_dot_h   dot(n, h), from the caller, who has it as dot(n, l) + dot(n, v)
//   unit      none: x is dot(h, h), y is |n x h|^2 = dot(h, h) - dot(n, h)^2 >= 0, so that
//             cos^2(gamma) = 1 - y/x and tan^2(gamma) = y/dot(n, h)^2
//   error     of y/x in float32, with FR_SMALL_SLOPE: 3e-7 sin(gamma), as of the cross product;
//             without: 3e-7, since the difference of two squares cancels where gamma is small
//
// The exact lobe multiplies that by 1/m^2: from the difference it is accurate to 5e-7/m^2 of its
// peak, from the component across the normal to 1.2e-6/m (sin(gamma) is near m where the lobe is
// steepest). The second costs some 4 % of a whole specular term more; a host whose m stays above
// 0.1 may save them: #define FR_SMALL_SLOPE 0.
#ifndef FR_HALF_VECTOR_GLSL
#define FR_HALF_VECTOR_GLSL

#ifndef FR_SMALL_SLOPE
#define FR_SMALL_SLOPE 1
#endif

vec2 fr_half_vector(vec3 n, vec3 h, float n_dot_h) {
    float along = n_dot_h * n_dot_h;
#if FR_SMALL_SLOPE
    // Where n is off unit length by e, this errs by 2 e dot(n, h) along n: e^2 in the square.
    vec3 across = h - n_dot_h * n;
    float across2 = dot(across, across);
    return vec2(along + across2, across2);
#else
    float h_dot_h = max(dot(h, h), along);  // rounding must not lift the lobe above its peak
    return vec2(h_dot_h, h_dot_h - along);
#endif
}

#endif
