// specular.glsl with what it includes of facerender 0.1.0.
// SPDX-License-Identifier: MIT, (c) 2026 the facerender contributors

const FR_LOBE_EXACT: i32 = 1;
const FR_LOBE_COSINE: i32 = 2;
const FR_LOBE_D4: i32 = 4;
const FR_LOBE_D8: i32 = 8;
const FR_LOBE_D16: i32 = 16;
const FR_LOBE_FITTED: i32 = 3;
const FR_LOBE_FITTED_FINE: i32 = 5;
const FR_LOBE_G_POWER: i32 = 6;
const FR_LOBE_OWN: i32 = 90;
const FR_LOBE_EVERY: i32 = 91;
const FR_FRESNEL_SCHLICK: i32 = 0;
const FR_FRESNEL_DIELECTRIC: i32 = 1;
const FR_FRESNEL_CONSTANT: i32 = 2;
const FR_MASKING_V_CAVITY: i32 = 0;
const FR_MASKING_KELEMEN: i32 = 1;
const FR_MASKING_NONE: i32 = 2;

// Squared length of the half vector, plus FR_FLOOR.
//
//   formula:  |h|^2 + FR_FLOOR; because of FR_FLOOR, the result may be a divisor
//   returns:  > 0.
//   error:    float32 rounding: 3e-7 times |h|^2, plus FR_FLOOR.
fn fr_half_vector_square(h: vec3<f32>) -> f32 {
    var h_1: vec3<f32>;

    h_1 = h;
    let _e2 = h_1;
    let _e4 = h_1;
    let _e7 = h_1;
    let _e9 = h_1;
    let _e12 = h_1;
    let _e14 = h_1;
    return ((_e2.x * _e4.x) + ((_e7.y * _e9.y) + ((_e12.z * _e14.z) + 4e-13f)));
}

fn fr_half_vector(n: vec3<f32>, h: vec3<f32>, n_dot_h: f32) -> vec2<f32> {
    var n_1: vec3<f32>;
    var h_3: vec3<f32>;
    var n_dot_h_1: f32;
    var along: f32;
    var across: vec3<f32>;
    var across2: f32;

    n_1 = n;
    h_3 = h;
    n_dot_h_1 = n_dot_h;
    let _e6 = n_dot_h_1;
    let _e7 = n_dot_h_1;
    along = (_e6 * _e7);
    let _e10 = h_3;
    let _e11 = n_1;
    let _e12 = n_dot_h_1;
    across = (_e10 - (_e11 * _e12));
    let _e16 = across;
    let _e17 = across;
    across2 = dot(_e16, _e17);
    let _e20 = along;
    let _e21 = across2;
    let _e23 = across2;
    return vec2<f32>((_e20 + _e21), _e23);
}

// Slope factor E of the exact lobe.
//
//   formula:  E = exp(-x)
//   returns:  1 at x = 0.
fn fr_slope_factor(x: f32) -> f32 {
    var x_1: f32;

    x_1 = x;
    let _e4 = x_1;
    return exp2((-1.442695f * _e4));
}

// Exact lobe from tan^2(gamma), which keeps the digits of small angles, unlike c.
fn fr_lobe_exact_tan2(tan2: f32, m: f32, k: i32) -> f32 {
    var tan2_1: f32;
    var m_1: f32;
    var k_1: i32;
    var t: f32;
    var param: f32;
    var e: f32;
    var sec2: f32;

    tan2_1 = tan2;
    m_1 = m;
    k_1 = k;
    let _e6 = tan2_1;
    t = clamp(_e6, 0f, 1000000f);
    let _e11 = t;
    let _e12 = m_1;
    let _e13 = m_1;
    param = (_e11 / (_e12 * _e13));
    let _e17 = param;
    let _e18 = fr_slope_factor(_e17);
    e = _e18;
    let _e20 = k_1;
    if (_e20 == 4i) {
        {
            let _e24 = t;
            sec2 = (1f + _e24);
            let _e27 = e;
            let _e28 = sec2;
            let _e29 = sec2;
            e = (_e27 * (_e28 * _e29));
        }
    }
    let _e32 = e;
    return _e32;
}

fn fr_lobe_exact(c: f32, m: f32, k: i32) -> f32 {
    var c_1: f32;
    var m_3: f32;
    var k_3: i32;
    var x_2: f32;
    var param_1: f32;
    var param_1_: f32;
    var param_2_: i32;

    c_1 = c;
    m_3 = m;
    k_3 = k;
    let _e6 = c_1;
    x_2 = clamp(_e6, 0.001f, 1f);
    let _e12 = x_2;
    let _e15 = x_2;
    let _e18 = x_2;
    let _e19 = x_2;
    param_1 = (((1f - _e12) * (1f + _e15)) / (_e18 * _e19));
    let _e23 = m_3;
    param_1_ = _e23;
    let _e25 = k_3;
    param_2_ = _e25;
    let _e27 = param_1;
    let _e28 = param_1_;
    let _e29 = param_2_;
    let _e30 = fr_lobe_exact_tan2(_e27, _e28, _e29);
    return _e30;
}

// Power of a cosine.
//
//   formula:  c^n
//   n:        Exponent; clamped to at least 0.
//   error:    The formula is exact. For the difference between c^n and E/c^k see fr_lobe_cosine.
fn fr_lobe_power(c: f32, n: f32) -> f32 {
    var c_3: f32;
    var n_3: f32;

    c_3 = c;
    n_3 = n;
    let _e4 = n_3;
    let _e7 = c_3;
    return exp2((max(_e4, 0f) * log2(clamp(_e7, 1e-30f, 1f))));
}

// Cosine-power lobe.
fn fr_lobe_cosine(c: f32, m: f32, k: i32) -> f32 {
    var c_5: f32;
    var m_5: f32;
    var k_5: i32;
    var param_2: f32;
    var param_1_1: f32;

    c_5 = c;
    m_5 = m;
    k_5 = k;
    let _e6 = c_5;
    param_2 = _e6;
    let _e9 = m_5;
    let _e10 = m_5;
    let _e13 = k_5;
    param_1_1 = ((2f / (_e9 * _e10)) - f32(_e13));
    let _e17 = param_2;
    let _e18 = param_1_1;
    let _e19 = fr_lobe_power(_e17, _e18);
    return _e19;
}

// Factor linear in c, clamped and raised to a power: the g-power lobe with free g and steepness.
//
//   formula:    max(1 - steepness (1 - c), 0)^g
//   steepness:  Steepness of the linear factor, >= 0; (2/m^2 - k)/g gives D4, D8 and D16.
//   g:          Power, 1 to 31, a constant.
//   error:      The formula is exact. Its difference from E/c^k depends on the steepness, which
//               facerender plan fits to a given m.
//   source:     Lyon (1993).
fn fr_lobe_clamped_power(c: f32, steepness: f32, g: i32) -> f32 {
    var c_7: f32;
    var steepness_1: f32;
    var g_1: i32;
    var p: f32;
    var p2: f32;
    var p4: f32;
    var p8: f32;
    var local: f32;
    var power: f32;

    c_7 = c;
    steepness_1 = steepness;
    g_1 = g;
    let _e7 = steepness_1;
    let _e9 = c_7;
    p = clamp((1f - (_e7 * (1f - _e9))), 0f, 1f);
    let _e17 = p;
    let _e18 = p;
    p2 = (_e17 * _e18);
    let _e21 = p2;
    let _e22 = p2;
    p4 = (_e21 * _e22);
    let _e25 = p4;
    let _e26 = p4;
    p8 = (_e25 * _e26);
    let _e29 = g_1;
    if ((_e29 & 1i) != 0i) {
        let _e34 = p;
        local = _e34;
    } else {
        local = 1f;
    }
    let _e37 = local;
    power = _e37;
    let _e39 = g_1;
    if ((_e39 & 2i) != 0i) {
        {
            let _e44 = power;
            let _e45 = p2;
            power = (_e44 * _e45);
        }
    }
    let _e47 = g_1;
    if ((_e47 & 4i) != 0i) {
        {
            let _e52 = power;
            let _e53 = p4;
            power = (_e52 * _e53);
        }
    }
    let _e55 = g_1;
    if ((_e55 & 8i) != 0i) {
        {
            let _e60 = power;
            let _e61 = p8;
            power = (_e60 * _e61);
        }
    }
    let _e63 = g_1;
    if ((_e63 & 16i) != 0i) {
        {
            let _e68 = power;
            let _e69 = p8;
            let _e70 = p8;
            power = (_e68 * (_e69 * _e70));
        }
    }
    let _e73 = power;
    return _e73;
}

// g-power lobe D4, D8 or D16, for g = 4, 8 or 16.
fn fr_lobe_g_power(c: f32, m: f32, k: i32, g: i32) -> f32 {
    var c_9: f32;
    var m_7: f32;
    var k_7: i32;
    var g_3: i32;
    var n_4: f32;
    var param_3: f32;
    var param_1_2: f32;
    var param_2_1: i32;

    c_9 = c;
    m_7 = m;
    k_7 = k;
    g_3 = g;
    let _e9 = m_7;
    let _e10 = m_7;
    let _e13 = k_7;
    n_4 = ((2f / (_e9 * _e10)) - f32(_e13));
    let _e17 = c_9;
    param_3 = _e17;
    let _e19 = n_4;
    let _e20 = g_3;
    param_1_2 = (_e19 / f32(_e20));
    let _e24 = g_3;
    param_2_1 = _e24;
    let _e26 = param_3;
    let _e27 = param_1_2;
    let _e28 = param_2_1;
    let _e29 = fr_lobe_clamped_power(_e26, _e27, _e28);
    return _e29;
}

// Variable of the polynomials, u/m^2, with m clamped to the lobe's domain.
//
//   formula:     u/m^2
//   u:           1 - c, in [0, 1].
//   inverse_m2:  1/m^2; clamped to at least 1/m^2 at the largest m of the domain.
//   returns:     >= 0.
//   error:       The formula is exact.
fn fr_lobe_fitted_variable(u: f32, inverse_m2: f32, k: i32) -> f32 {
    var u_1: f32;
    var inverse_m2_1: f32;
    var k_9: i32;
    var local_1: f32;

    u_1 = u;
    inverse_m2_1 = inverse_m2;
    k_9 = k;
    let _e6 = u_1;
    let _e7 = inverse_m2_1;
    let _e8 = k_9;
    if (_e8 == 4i) {
        local_1 = 2.0408163f;
    } else {
        local_1 = 1f;
    }
    let _e14 = local_1;
    return (_e6 * max(_e7, _e14));
}

// Numerators of the polynomial coefficients in fr_lobe_fitted.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6; each is a cubic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted.
fn fr_lobe_fitted_numerators(m: f32, k: i32) -> vec3<f32> {
    var m_9: f32;
    var k_11: i32;
    var w: f32;
    var a: vec3<f32>;

    m_9 = m;
    k_11 = k;
    let _e4 = m_9;
    let _e5 = m_9;
    w = (_e4 * _e5);
    let _e9 = k_11;
    if (_e9 == 4i) {
        {
            let _e12 = w;
            w = min(_e12, 0.49f);
            let _e37 = w;
            let _e40 = w;
            let _e43 = w;
            a = (vec3<f32>(-0.39700398f, 0.07498738f, -0.006093595f) + ((vec3<f32>(0.6738297f, -0.586297f, 0.002621735f) + ((vec3<f32>(0.71936625f, -1.6754473f, 1.1615276f) + (vec3<f32>(-1.0351326f, 4.1195316f, -5.0082765f) * _e37)) * _e40)) * _e43));
        }
    } else {
        {
            let _e46 = w;
            w = min(_e46, 1f);
            let _e72 = w;
            let _e75 = w;
            let _e78 = w;
            a = (vec3<f32>(-0.40198097f, 0.08352605f, -0.010091574f) + ((vec3<f32>(-0.020725707f, -0.49894732f, 0.08771378f) + ((vec3<f32>(0.0773726f, -0.42975122f, 0.18764888f) + (vec3<f32>(-0.06750309f, 0.5130421f, -1.5410764f) * _e72)) * _e75)) * _e78));
        }
    }
    let _e81 = a;
    return _e81;
}

// Coefficients of fr_lobe_fitted, for hosts that define FR_FITTED_COEFFICIENTS.
//
//   formula:  a1, a2, a3; each a_i m^(2i) is a cubic in m^2
//   returns:  Factors of u, u^2, u^3.
//   error:    See fr_lobe_fitted.
fn fr_lobe_fitted_coefficients(m: f32, k: i32) -> vec3<f32> {
    var m_11: f32;
    var k_13: i32;
    var param_4: f32 = 1f;
    var param_1_3: f32;
    var param_2_2: i32;
    var r: f32;
    var param_3_: f32;
    var param_4_: i32;

    m_11 = m;
    k_13 = k;
    let _e7 = m_11;
    let _e8 = m_11;
    param_1_3 = (1f / (_e7 * _e8));
    let _e12 = k_13;
    param_2_2 = _e12;
    let _e14 = param_4;
    let _e15 = param_1_3;
    let _e16 = param_2_2;
    let _e17 = fr_lobe_fitted_variable(_e14, _e15, _e16);
    r = _e17;
    let _e19 = m_11;
    param_3_ = _e19;
    let _e21 = k_13;
    param_4_ = _e21;
    let _e23 = param_3_;
    let _e24 = param_4_;
    let _e25 = fr_lobe_fitted_numerators(_e23, _e24);
    let _e26 = r;
    let _e27 = r;
    let _e28 = r;
    let _e30 = r;
    let _e31 = r;
    let _e33 = r;
    return (_e25 * vec3<f32>(_e26, (_e27 * _e28), ((_e30 * _e31) * _e33)));
}

// Fitted lobe for callers that already have 1/m^2: the fifth power of a clamped cubic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
fn fr_lobe_fitted_with_inverse_m2(c: f32, m: f32, inverse_m2: f32, k: i32) -> f32 {
    var c_11: f32;
    var m_13: f32;
    var inverse_m2_3: f32;
    var k_15: i32;
    var param_5: f32;
    var param_1_4: i32;
    var a_1: vec3<f32>;
    var param_2_3: f32;
    var param_3_1: f32;
    var param_4_1: i32;
    var v: f32;
    var p_1: f32;
    var p2_1: f32;

    c_11 = c;
    m_13 = m;
    inverse_m2_3 = inverse_m2;
    k_15 = k;
    let _e8 = m_13;
    param_5 = _e8;
    let _e10 = k_15;
    param_1_4 = _e10;
    let _e12 = param_5;
    let _e13 = param_1_4;
    let _e14 = fr_lobe_fitted_numerators(_e12, _e13);
    a_1 = _e14;
    let _e17 = c_11;
    param_2_3 = (1f - _e17);
    let _e20 = inverse_m2_3;
    param_3_1 = _e20;
    let _e22 = k_15;
    param_4_1 = _e22;
    let _e24 = param_2_3;
    let _e25 = param_3_1;
    let _e26 = param_4_1;
    let _e27 = fr_lobe_fitted_variable(_e24, _e25, _e26);
    v = _e27;
    let _e30 = v;
    let _e31 = a_1;
    let _e33 = v;
    let _e34 = a_1;
    let _e36 = v;
    let _e37 = a_1;
    p_1 = clamp((1f + (_e30 * (_e31.x + (_e33 * (_e34.y + (_e36 * _e37.z)))))), 0f, 1f);
    let _e49 = p_1;
    let _e50 = p_1;
    p2_1 = (_e49 * _e50);
    let _e53 = p2_1;
    let _e54 = p2_1;
    let _e56 = p_1;
    return ((_e53 * _e54) * _e56);
}

// Fitted lobe: the fifth power of a clamped cubic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   error:    At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
fn fr_lobe_fitted(c: f32, m: f32, k: i32) -> f32 {
    var c_13: f32;
    var m_15: f32;
    var k_17: i32;
    var param_6: f32;
    var param_1_5: f32;
    var param_2_4: f32;
    var param_3_2: i32;

    c_13 = c;
    m_15 = m;
    k_17 = k;
    let _e6 = c_13;
    param_6 = _e6;
    let _e8 = m_15;
    param_1_5 = _e8;
    let _e11 = m_15;
    let _e12 = m_15;
    param_2_4 = (1f / (_e11 * _e12));
    let _e16 = k_17;
    param_3_2 = _e16;
    let _e18 = param_6;
    let _e19 = param_1_5;
    let _e20 = param_2_4;
    let _e21 = param_3_2;
    let _e22 = fr_lobe_fitted_with_inverse_m2(_e18, _e19, _e20, _e21);
    return _e22;
}

// Numerators of the polynomial coefficients in fr_lobe_fitted_fine.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6, a4 m^8; each is a quartic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted_fine.
fn fr_lobe_fitted_fine_numerators(m: f32, k: i32) -> vec4<f32> {
    var m_17: f32;
    var k_19: i32;
    var w_1: f32;
    var a_2: vec4<f32>;

    m_17 = m;
    k_19 = k;
    let _e4 = m_17;
    let _e5 = m_17;
    w_1 = (_e4 * _e5);
    let _e9 = k_19;
    if (_e9 == 4i) {
        {
            let _e12 = w_1;
            w_1 = min(_e12, 0.49f);
            let _e50 = w_1;
            let _e53 = w_1;
            let _e56 = w_1;
            let _e59 = w_1;
            a_2 = (vec4<f32>(-0.24963108f, 0.030319914f, -0.0020734922f, 0f) + ((vec4<f32>(0.50360703f, -0.52566284f, 0.15216286f, -0.017956778f) + ((vec4<f32>(-0.013824908f, 0.5056545f, -0.924527f, 0.030042244f) + ((vec4<f32>(-0.08171914f, 0.47515005f, -1.4199605f, 1.6944034f) + (vec4<f32>(0.19363847f, -1.434821f, 4.5145226f, -5.6548033f) * _e50)) * _e53)) * _e56)) * _e59));
        }
    } else {
        {
            let _e62 = w_1;
            w_1 = min(_e62, 1f);
            let _e100 = w_1;
            let _e103 = w_1;
            let _e106 = w_1;
            let _e109 = w_1;
            a_2 = (vec4<f32>(-0.24950537f, 0.02981122f, -0.0017648838f, 0f) + ((vec4<f32>(0.0018034024f, -0.38853177f, 0.14142554f, -0.024093986f) + ((vec4<f32>(-0.0076809274f, 0.07839925f, -0.74785185f, 0.058197197f) + ((vec4<f32>(-0.0071770926f, 0.063575566f, -0.40797552f, 1.0990611f) + (vec4<f32>(0.015975844f, -0.20239128f, 1.087785f, -2.6305628f) * _e100)) * _e103)) * _e106)) * _e109));
        }
    }
    let _e112 = a_2;
    return _e112;
}

// Coefficients of fr_lobe_fitted_fine, for hosts that define FR_FITTED_FINE_COEFFICIENTS.
//
//   formula:  a1, a2, a3, a4; each a_i m^(2i) is a quartic in m^2
//   returns:  Factors of u, u^2, u^3, u^4.
//   error:    See fr_lobe_fitted_fine.
fn fr_lobe_fitted_fine_coefficients(m: f32, k: i32) -> vec4<f32> {
    var m_19: f32;
    var k_21: i32;
    var param_7: f32 = 1f;
    var param_1_6: f32;
    var param_2_5: i32;
    var r_1: f32;
    var param_3_3: f32;
    var param_4_2: i32;

    m_19 = m;
    k_21 = k;
    let _e7 = m_19;
    let _e8 = m_19;
    param_1_6 = (1f / (_e7 * _e8));
    let _e12 = k_21;
    param_2_5 = _e12;
    let _e14 = param_7;
    let _e15 = param_1_6;
    let _e16 = param_2_5;
    let _e17 = fr_lobe_fitted_variable(_e14, _e15, _e16);
    r_1 = _e17;
    let _e19 = m_19;
    param_3_3 = _e19;
    let _e21 = k_21;
    param_4_2 = _e21;
    let _e23 = param_3_3;
    let _e24 = param_4_2;
    let _e25 = fr_lobe_fitted_fine_numerators(_e23, _e24);
    let _e26 = r_1;
    let _e27 = r_1;
    let _e28 = r_1;
    let _e30 = r_1;
    let _e31 = r_1;
    let _e33 = r_1;
    let _e35 = r_1;
    let _e36 = r_1;
    let _e38 = r_1;
    let _e39 = r_1;
    return (_e25 * vec4<f32>(_e26, (_e27 * _e28), ((_e30 * _e31) * _e33), ((_e35 * _e36) * (_e38 * _e39))));
}

// Finer fitted lobe for callers that have 1/m^2: the eighth power of a clamped quartic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.04 % of the peak for both models.
fn fr_lobe_fitted_fine_with_inverse_m2(c: f32, m: f32, inverse_m2: f32, k: i32) -> f32 {
    var c_15: f32;
    var m_21: f32;
    var inverse_m2_5: f32;
    var k_23: i32;
    var param_8: f32;
    var param_1_7: i32;
    var a_3: vec4<f32>;
    var param_2_6: f32;
    var param_3_4: f32;
    var param_4_3: i32;
    var v_1: f32;
    var p_2: f32;
    var p2_2: f32;
    var p4_1: f32;

    c_15 = c;
    m_21 = m;
    inverse_m2_5 = inverse_m2;
    k_23 = k;
    let _e8 = m_21;
    param_8 = _e8;
    let _e10 = k_23;
    param_1_7 = _e10;
    let _e12 = param_8;
    let _e13 = param_1_7;
    let _e14 = fr_lobe_fitted_fine_numerators(_e12, _e13);
    a_3 = _e14;
    let _e17 = c_15;
    param_2_6 = (1f - _e17);
    let _e20 = inverse_m2_5;
    param_3_4 = _e20;
    let _e22 = k_23;
    param_4_3 = _e22;
    let _e24 = param_2_6;
    let _e25 = param_3_4;
    let _e26 = param_4_3;
    let _e27 = fr_lobe_fitted_variable(_e24, _e25, _e26);
    v_1 = _e27;
    let _e30 = v_1;
    let _e31 = a_3;
    let _e33 = v_1;
    let _e34 = a_3;
    let _e36 = v_1;
    let _e37 = a_3;
    let _e39 = v_1;
    let _e40 = a_3;
    p_2 = clamp((1f + (_e30 * (_e31.x + (_e33 * (_e34.y + (_e36 * (_e37.z + (_e39 * _e40.w)))))))), 0f, 1f);
    let _e54 = p_2;
    let _e55 = p_2;
    p2_2 = (_e54 * _e55);
    let _e58 = p2_2;
    let _e59 = p2_2;
    p4_1 = (_e58 * _e59);
    let _e62 = p4_1;
    let _e63 = p4_1;
    return (_e62 * _e63);
}

// Finer fitted lobe: the eighth power of a clamped quartic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   error:    At most 0.04 % of the peak for both models.
fn fr_lobe_fitted_fine(c: f32, m: f32, k: i32) -> f32 {
    var c_17: f32;
    var m_23: f32;
    var k_25: i32;
    var param_9: f32;
    var param_1_8: f32;
    var param_2_7: f32;
    var param_3_5: i32;

    c_17 = c;
    m_23 = m;
    k_25 = k;
    let _e6 = c_17;
    param_9 = _e6;
    let _e8 = m_23;
    param_1_8 = _e8;
    let _e11 = m_23;
    let _e12 = m_23;
    param_2_7 = (1f / (_e11 * _e12));
    let _e16 = k_25;
    param_3_5 = _e16;
    let _e18 = param_9;
    let _e19 = param_1_8;
    let _e20 = param_2_7;
    let _e21 = param_3_5;
    let _e22 = fr_lobe_fitted_fine_with_inverse_m2(_e18, _e19, _e20, _e21);
    return _e22;
}

// Lobe that the argument `lobe` selects, for callers, such as a BRDF, that already have 1/m^2.
//
//   inverse_m2:  1/m^2.
fn fr_lobe_with_inverse_m2(c: f32, m: f32, inverse_m2: f32, k: i32, lobe: i32) -> f32 {
    var c_19: f32;
    var m_25: f32;
    var inverse_m2_7: f32;
    var k_27: i32;
    var lobe_1: i32;
    var param_10: f32;
    var param_1_9: f32;
    var param_2_8: i32;
    var param_3_6: f32;
    var param_4_4: f32;
    var param_5_: f32;
    var param_6_: f32;
    var param_7_: i32 = 4i;
    var param_8_: f32;
    var param_9_: f32;
    var param_10_: i32 = 8i;
    var param_11_: f32;
    var param_12_: f32;
    var param_13_: i32 = 16i;
    var param_14_: f32;
    var param_15_: f32;
    var param_16_: f32;
    var param_17_: i32;
    var param_18_: f32;
    var param_19_: f32;
    var param_20_: f32;
    var param_21_: i32;
    var param_22_: f32;
    var param_23_: f32;
    var param_24_: i32 = 8i;

    c_19 = c;
    m_25 = m;
    inverse_m2_7 = inverse_m2;
    k_27 = k;
    lobe_1 = lobe;
    let _e10 = lobe_1;
    if (_e10 == 1i) {
        {
            let _e13 = c_19;
            param_10 = _e13;
            let _e15 = m_25;
            param_1_9 = _e15;
            let _e17 = k_27;
            param_2_8 = _e17;
            let _e19 = param_10;
            let _e20 = param_1_9;
            let _e21 = param_2_8;
            let _e22 = fr_lobe_exact(_e19, _e20, _e21);
            return _e22;
        }
    }
    let _e23 = lobe_1;
    if (_e23 == 2i) {
        {
            let _e26 = c_19;
            param_3_6 = _e26;
            let _e29 = inverse_m2_7;
            let _e31 = k_27;
            param_4_4 = ((2f * _e29) - f32(_e31));
            let _e35 = param_3_6;
            let _e36 = param_4_4;
            let _e37 = fr_lobe_power(_e35, _e36);
            return _e37;
        }
    }
    let _e38 = lobe_1;
    if (_e38 == 4i) {
        {
            let _e41 = c_19;
            param_5_ = _e41;
            let _e44 = inverse_m2_7;
            let _e47 = k_27;
            param_6_ = ((0.5f * _e44) - (0.25f * f32(_e47)));
            let _e54 = param_5_;
            let _e55 = param_6_;
            let _e56 = param_7_;
            let _e57 = fr_lobe_clamped_power(_e54, _e55, _e56);
            return _e57;
        }
    }
    let _e58 = lobe_1;
    if (_e58 == 8i) {
        {
            let _e61 = c_19;
            param_8_ = _e61;
            let _e64 = inverse_m2_7;
            let _e67 = k_27;
            param_9_ = ((0.25f * _e64) - (0.125f * f32(_e67)));
            let _e74 = param_8_;
            let _e75 = param_9_;
            let _e76 = param_10_;
            let _e77 = fr_lobe_clamped_power(_e74, _e75, _e76);
            return _e77;
        }
    }
    let _e78 = lobe_1;
    if (_e78 == 16i) {
        {
            let _e81 = c_19;
            param_11_ = _e81;
            let _e84 = inverse_m2_7;
            let _e87 = k_27;
            param_12_ = ((0.125f * _e84) - (0.0625f * f32(_e87)));
            let _e94 = param_11_;
            let _e95 = param_12_;
            let _e96 = param_13_;
            let _e97 = fr_lobe_clamped_power(_e94, _e95, _e96);
            return _e97;
        }
    }
    let _e98 = lobe_1;
    if (_e98 == 3i) {
        {
            let _e101 = c_19;
            param_14_ = _e101;
            let _e103 = m_25;
            param_15_ = _e103;
            let _e105 = inverse_m2_7;
            param_16_ = _e105;
            let _e107 = k_27;
            param_17_ = _e107;
            let _e109 = param_14_;
            let _e110 = param_15_;
            let _e111 = param_16_;
            let _e112 = param_17_;
            let _e113 = fr_lobe_fitted_with_inverse_m2(_e109, _e110, _e111, _e112);
            return _e113;
        }
    }
    let _e114 = lobe_1;
    if (_e114 == 5i) {
        {
            let _e117 = c_19;
            param_18_ = _e117;
            let _e119 = m_25;
            param_19_ = _e119;
            let _e121 = inverse_m2_7;
            param_20_ = _e121;
            let _e123 = k_27;
            param_21_ = _e123;
            let _e125 = param_18_;
            let _e126 = param_19_;
            let _e127 = param_20_;
            let _e128 = param_21_;
            let _e129 = fr_lobe_fitted_fine_with_inverse_m2(_e125, _e126, _e127, _e128);
            return _e129;
        }
    }
    let _e130 = lobe_1;
    if (_e130 == 6i) {
        {
            let _e133 = c_19;
            param_22_ = _e133;
            let _e136 = m_25;
            let _e137 = m_25;
            let _e140 = k_27;
            param_23_ = (((2f / (_e136 * _e137)) - f32(_e140)) / 8f);
            let _e148 = param_22_;
            let _e149 = param_23_;
            let _e150 = param_24_;
            let _e151 = fr_lobe_clamped_power(_e148, _e149, _e150);
            return _e151;
        }
    }
    return 0f;
}

// Lobe that the argument `lobe` selects.
fn fr_lobe_of(c: f32, m: f32, k: i32, lobe: i32) -> f32 {
    var c_21: f32;
    var m_27: f32;
    var k_29: i32;
    var lobe_3: i32;
    var param_11: f32;
    var param_1_10: f32;
    var param_2_9: f32;
    var param_3_7: i32;
    var param_4_5: i32;

    c_21 = c;
    m_27 = m;
    k_29 = k;
    lobe_3 = lobe;
    let _e8 = c_21;
    param_11 = _e8;
    let _e10 = m_27;
    param_1_10 = _e10;
    let _e13 = m_27;
    let _e14 = m_27;
    param_2_9 = (1f / (_e13 * _e14));
    let _e18 = k_29;
    param_3_7 = _e18;
    let _e20 = lobe_3;
    param_4_5 = _e20;
    let _e22 = param_11;
    let _e23 = param_1_10;
    let _e24 = param_2_9;
    let _e25 = param_3_7;
    let _e26 = param_4_5;
    let _e27 = fr_lobe_with_inverse_m2(_e22, _e23, _e24, _e25, _e26);
    return _e27;
}

// Lobe that the macro FR_LOBE selects, for example by #define FR_LOBE FR_LOBE_D16.
fn fr_lobe(c: f32, m: f32, k: i32) -> f32 {
    var c_23: f32;
    var m_29: f32;
    var k_31: i32;
    var param_12: f32;
    var param_1_11: f32;
    var param_2_10: i32;
    var param_3_8: i32 = 1i;

    c_23 = c;
    m_29 = m;
    k_31 = k;
    let _e6 = c_23;
    param_12 = _e6;
    let _e8 = m_29;
    param_1_11 = _e8;
    let _e10 = k_31;
    param_2_10 = _e10;
    let _e14 = param_12;
    let _e15 = param_1_11;
    let _e16 = param_2_10;
    let _e17 = param_3_8;
    let _e18 = fr_lobe_of(_e14, _e15, _e16, _e17);
    return _e18;
}

// Schlick's approximation of the Fresnel reflectance.
//
//   formula:  f0 + (1 - f0)(1 - V.H)^5
//   f0:       Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin, with index of
//             refraction 1.4.
//   v_dot_h:  Cosine of the angle between the direction to the camera (or to the light) and the
//             unit half vector, in [0, 1].
//   unit:     none
//   returns:  In [0, 1].
//   error:    At most 0.046 (absolute) for f0 = 0.028, reached at 84 degrees.
//   source:   Schlick (1994), eq. 15.
fn fr_fresnel_schlick(f0: f32, v_dot_h: f32) -> f32 {
    var f0_1: f32;
    var v_dot_h_1: f32;
    var u_2: f32;
    var u2: f32;

    f0_1 = f0;
    v_dot_h_1 = v_dot_h;
    let _e5 = v_dot_h_1;
    u_2 = abs((1f - _e5));
    let _e9 = u_2;
    let _e10 = u_2;
    u2 = (_e9 * _e10);
    let _e13 = f0_1;
    let _e15 = f0_1;
    let _e17 = u2;
    let _e18 = u2;
    let _e20 = u_2;
    return (_e13 + ((1f - _e15) * ((_e17 * _e18) * _e20)));
}

// Grazing part of Schlick's approximation times a constant factor.
// Compilers fold the fifth root of a constant `scale`, so that the multiplication costs nothing.
//
//   formula:  scale (1 - V.H)^5
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    The formula is exact; float32 rounding: 2e-6 of the scale.
fn fr_fresnel_schlick_grazing(scale: f32, v_dot_h: f32) -> f32 {
    var scale_1: f32;
    var v_dot_h_3: f32;
    var root: f32;
    var u_3: f32;
    var u2_1: f32;

    scale_1 = scale;
    v_dot_h_3 = v_dot_h;
    let _e4 = scale_1;
    root = pow(_e4, 0.2f);
    let _e8 = root;
    let _e9 = root;
    let _e10 = v_dot_h_3;
    u_3 = abs((_e8 - (_e9 * _e10)));
    let _e15 = u_3;
    let _e16 = u_3;
    u2_1 = (_e15 * _e16);
    let _e19 = u2_1;
    let _e20 = u2_1;
    let _e22 = u_3;
    return ((_e19 * _e20) * _e22);
}

// Schlick's approximation of the Fresnel reflectance times a constant factor.
//
//   formula:  scale (f0 + (1 - f0)(1 - V.H)^5)
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
fn fr_fresnel_schlick_times(scale: f32, f0: f32, v_dot_h: f32) -> f32 {
    var scale_3: f32;
    var f0_3: f32;
    var v_dot_h_5: f32;
    var param_13: f32;
    var param_1_12: f32;
    var grazing: f32;

    scale_3 = scale;
    f0_3 = f0;
    v_dot_h_5 = v_dot_h;
    let _e6 = scale_3;
    param_13 = _e6;
    let _e8 = v_dot_h_5;
    param_1_12 = _e8;
    let _e10 = param_13;
    let _e11 = param_1_12;
    let _e12 = fr_fresnel_schlick_grazing(_e10, _e11);
    grazing = _e12;
    let _e14 = f0_3;
    let _e15 = scale_3;
    let _e16 = grazing;
    let _e19 = grazing;
    return ((_e14 * (_e15 - _e16)) + _e19);
}

// Schlick's approximation in RGB times a constant factor, with a given reflectance at 90 degrees.
//
//   formula:  scale (f0 + (f90 - f0)(1 - V.H)^5)
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
fn fr_fresnel_schlick_rgb(scale: f32, f0: vec3<f32>, f90: vec3<f32>, v_dot_h: f32) -> vec3<f32> {
    var scale_5: f32;
    var f0_5: vec3<f32>;
    var f90_1: vec3<f32>;
    var v_dot_h_7: f32;
    var param_14: f32;
    var param_1_13: f32;
    var grazing_1: f32;

    scale_5 = scale;
    f0_5 = f0;
    f90_1 = f90;
    v_dot_h_7 = v_dot_h;
    let _e8 = scale_5;
    param_14 = _e8;
    let _e10 = v_dot_h_7;
    param_1_13 = _e10;
    let _e12 = param_14;
    let _e13 = param_1_13;
    let _e14 = fr_fresnel_schlick_grazing(_e12, _e13);
    grazing_1 = _e14;
    let _e16 = f0_5;
    let _e17 = scale_5;
    let _e18 = grazing_1;
    let _e21 = f90_1;
    let _e22 = grazing_1;
    return ((_e16 * (_e17 - _e18)) + (_e21 * _e22));
}

// Exact Fresnel reflectance of a dielectric in air for unpolarised light.
// The code uses q = eta^2 - 1 and g - c = q/(g + c), so that no digits cancel for eta near 1. At q
// = c = 0 the sum g + c is raised to 1e-20. This turns 0/0 into 0, the limit of a
// for q = 0 and c > 0.
//
//   formula:  a^2 (1 + b^2)/2, a = (g - c)/(g + c), b = (c (g + c) - 1)/(c (g - c) + 1), c = V.H,
//             g^2 = eta^2 + c^2 - 1, eta = (1 + sqrt(f0))/(1 - sqrt(f0))
//   f0:       Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin, with index of
//             refraction 1.4.
//   v_dot_h:  Cosine of the angle between the direction to the camera (or to the light) and the
//             unit half vector, in [0, 1].
//   unit:     none
//   returns:  In [0, 1].
//   error:    The formula is exact.
//   source:   Cook and Torrance (1982).
fn fr_fresnel_dielectric(f0: f32, v_dot_h: f32) -> f32 {
    var f0_7: f32;
    var v_dot_h_9: f32;
    var root_1: f32;
    var q: f32;
    var c_24: f32;
    var sum: f32;
    var difference: f32;
    var a_4: f32;
    var b: f32;

    f0_7 = f0;
    v_dot_h_9 = v_dot_h;
    let _e4 = f0_7;
    root_1 = sqrt(_e4);
    let _e8 = root_1;
    let _e11 = root_1;
    let _e14 = root_1;
    q = ((4f * _e8) / ((1f - _e11) * (1f - _e14)));
    let _e19 = v_dot_h_9;
    c_24 = min(_e19, 1f);
    let _e23 = q;
    let _e24 = c_24;
    let _e25 = c_24;
    let _e29 = c_24;
    sum = max((sqrt((_e23 + (_e24 * _e25))) + _e29), 1e-20f);
    let _e34 = q;
    let _e35 = sum;
    difference = (_e34 / _e35);
    let _e38 = difference;
    let _e39 = sum;
    a_4 = (_e38 / _e39);
    let _e42 = c_24;
    let _e43 = sum;
    let _e47 = c_24;
    let _e48 = difference;
    b = (((_e42 * _e43) - 1f) / ((_e47 * _e48) + 1f));
    let _e55 = a_4;
    let _e57 = a_4;
    let _e60 = b;
    let _e61 = b;
    return clamp((((0.5f * _e55) * _e57) * (1f + (_e60 * _e61))), 0f, 1f);
}

// Fresnel reflectance by the formula that the compile-time constant `fresnel` selects.
fn fr_fresnel_of(f0: f32, v_dot_h: f32, fresnel: i32) -> f32 {
    var f0_9: f32;
    var v_dot_h_11: f32;
    var fresnel_1: i32;
    var param_15: f32;
    var param_1_14: f32;
    var param_2_11: f32;
    var param_3_9: f32;

    f0_9 = f0;
    v_dot_h_11 = v_dot_h;
    fresnel_1 = fresnel;
    let _e6 = fresnel_1;
    if (_e6 == 2i) {
        {
            let _e9 = f0_9;
            return _e9;
        }
    }
    let _e10 = fresnel_1;
    if (_e10 == 1i) {
        {
            let _e13 = f0_9;
            param_15 = _e13;
            let _e15 = v_dot_h_11;
            param_1_14 = _e15;
            let _e17 = param_15;
            let _e18 = param_1_14;
            let _e19 = fr_fresnel_dielectric(_e17, _e18);
            return _e19;
        }
    }
    let _e20 = f0_9;
    param_2_11 = _e20;
    let _e22 = v_dot_h_11;
    param_3_9 = _e22;
    let _e24 = param_2_11;
    let _e25 = param_3_9;
    let _e26 = fr_fresnel_schlick(_e24, _e25);
    return _e26;
}

// Fresnel reflectance times a constant factor, by the formula that `fresnel` selects.
//
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
fn fr_fresnel_times(scale: f32, f0: f32, v_dot_h: f32, fresnel: i32) -> f32 {
    var scale_7: f32;
    var f0_11: f32;
    var v_dot_h_13: f32;
    var fresnel_3: i32;
    var param_16: f32;
    var param_1_15: f32;
    var param_2_12: f32;
    var param_3_10: f32;
    var param_4_6: f32;

    scale_7 = scale;
    f0_11 = f0;
    v_dot_h_13 = v_dot_h;
    fresnel_3 = fresnel;
    let _e8 = fresnel_3;
    if (_e8 == 2i) {
        {
            let _e11 = scale_7;
            let _e12 = f0_11;
            return (_e11 * _e12);
        }
    }
    let _e14 = fresnel_3;
    if (_e14 == 1i) {
        {
            let _e17 = f0_11;
            param_16 = _e17;
            let _e19 = v_dot_h_13;
            param_1_15 = _e19;
            let _e21 = scale_7;
            let _e22 = param_16;
            let _e23 = param_1_15;
            let _e24 = fr_fresnel_dielectric(_e22, _e23);
            return (_e21 * _e24);
        }
    }
    let _e26 = scale_7;
    param_2_12 = _e26;
    let _e28 = f0_11;
    param_3_10 = _e28;
    let _e30 = v_dot_h_13;
    param_4_6 = _e30;
    let _e32 = param_2_12;
    let _e33 = param_3_10;
    let _e34 = param_4_6;
    let _e35 = fr_fresnel_schlick_times(_e32, _e33, _e34);
    return _e35;
}

// Fresnel reflectance by the formula that the macro FR_FRESNEL selects.
fn fr_fresnel(f0: f32, v_dot_h: f32) -> f32 {
    var f0_13: f32;
    var v_dot_h_15: f32;
    var param_17: f32;
    var param_1_16: f32;
    var param_2_13: i32 = 0i;

    f0_13 = f0;
    v_dot_h_15 = v_dot_h;
    let _e4 = f0_13;
    param_17 = _e4;
    let _e6 = v_dot_h_15;
    param_1_16 = _e6;
    let _e10 = param_17;
    let _e11 = param_1_16;
    let _e12 = param_2_13;
    let _e13 = fr_fresnel_of(_e10, _e11, _e12);
    return _e13;
}

// Masking and shadowing by V-shaped cavities.
//
//   formula:           G = min(1, 2 (N.H)(N.V)/(V.H), 2 (N.H)(N.L)/(V.H))
//   n_dot_h, v_dot_h:  dot(n, h) and dot(v, h) > 0. The result depends only on their ratio, so that
//                      h may have any length.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in (0, 1].
//   unit:              none
//   returns:           In [0, 1].
//   error:             None.
//   source:            Torrance and Sparrow (1967); Cook and Torrance (1982).
fn fr_masking_v_cavity(n_dot_h: f32, v_dot_h: f32, n_dot_l: f32, n_dot_v: f32) -> f32 {
    var n_dot_h_3: f32;
    var v_dot_h_17: f32;
    var n_dot_l_1: f32;
    var n_dot_v_1: f32;

    n_dot_h_3 = n_dot_h;
    v_dot_h_17 = v_dot_h;
    n_dot_l_1 = n_dot_l;
    n_dot_v_1 = n_dot_v;
    let _e10 = n_dot_h_3;
    let _e12 = n_dot_l_1;
    let _e13 = n_dot_v_1;
    let _e16 = v_dot_h_17;
    return min(1f, (((2f * _e10) * min(_e12, _e13)) / _e16));
}

// V-cavity masking G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h), with FR_FLOOR added to y
//   n_dot_h, h_dot_h:  dot(n, h) and dot(h, h) for the half vector h = l + v.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   unit:              none
//   returns:           x >= 0 and y > 0; x is 0 if N.L or N.V is at most 0.
//   error:             FR_FLOOR in y lowers x/y by at most the fraction FR_FLOOR/((N.L)(N.V)).
fn fr_masking_v_cavity_ratio(n_dot_h: f32, h_dot_h: f32, n_dot_l: f32, n_dot_v: f32) -> vec2<f32> {
    var n_dot_h_5: f32;
    var h_dot_h_1: f32;
    var n_dot_l_3: f32;
    var n_dot_v_3: f32;
    var lower: f32;

    n_dot_h_5 = n_dot_h;
    h_dot_h_1 = h_dot_h;
    n_dot_l_3 = n_dot_l;
    n_dot_v_3 = n_dot_v;
    let _e8 = n_dot_l_3;
    let _e9 = n_dot_v_3;
    lower = clamp(min(_e8, _e9), 0f, 1f);
    let _e15 = h_dot_h_1;
    let _e17 = n_dot_h_5;
    let _e20 = lower;
    let _e23 = n_dot_l_3;
    let _e24 = n_dot_v_3;
    return vec2<f32>(min(_e15, ((4f * abs(_e17)) * _e20)), (abs((_e23 * _e24)) + 4e-13f));
}

// Kelemen masking, which cancels the divisor (N.L)(N.V) of a BRDF: G/((N.L)(N.V)) = 4/(h.h) for h =
// l + v.
//
//   formula:           G = (N.L)(N.V)/(V.H)^2
//   v_dot_h:           Cosine of the angle between the direction to the camera and the unit half
//                      vector; at least (N.L + N.V)/2, a condition that all unit vectors meet.
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in (0, 1].
//   unit:              none
//   returns:           In [0, 1].
//   error:             The value is between 0.5 and 1 times fr_masking_v_cavity; in the mirror
//                      direction both functions are equal. The command facerender plan measures the
//                      effect on a scene.
//   source:            Kelemen and Szirmay-Kalos (2001); for skin: GPU Gems 3, chapter 14 (2007).
fn fr_masking_kelemen(v_dot_h: f32, n_dot_l: f32, n_dot_v: f32) -> f32 {
    var v_dot_h_19: f32;
    var n_dot_l_5: f32;
    var n_dot_v_5: f32;
    var _inverse: f32;

    v_dot_h_19 = v_dot_h;
    n_dot_l_5 = n_dot_l;
    n_dot_v_5 = n_dot_v;
    let _e7 = v_dot_h_19;
    _inverse = (1f / _e7);
    let _e10 = n_dot_l_5;
    let _e11 = _inverse;
    let _e13 = n_dot_v_5;
    let _e14 = _inverse;
    return ((_e10 * _e11) * (_e13 * _e14));
}

// Kelemen masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h)
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   unit:              none
//   returns:           x >= 0 and y = 1; x is 0 if N.L or N.V is at most FR_MIN_COSINE.
//   error:             None.
fn fr_masking_kelemen_ratio(n_dot_l: f32, n_dot_v: f32) -> vec2<f32> {
    var n_dot_l_7: f32;
    var n_dot_v_7: f32;
    var local_2: f32;

    n_dot_l_7 = n_dot_l;
    n_dot_v_7 = n_dot_v;
    let _e4 = n_dot_l_7;
    let _e5 = n_dot_v_7;
    if (min(_e4, _e5) > 0.000001f) {
        local_2 = 4f;
    } else {
        local_2 = 0f;
    }
    let _e12 = local_2;
    return vec2<f32>(_e12, 1f);
}

// Masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h. The
// argument `masking` selects the term.
fn fr_masking_of(n_dot_h: f32, h_dot_h: f32, n_dot_l: f32, n_dot_v: f32, masking: i32) -> vec2<f32> {
    var n_dot_h_7: f32;
    var h_dot_h_3: f32;
    var n_dot_l_9: f32;
    var n_dot_v_9: f32;
    var masking_1: i32;
    var local_3: f32;
    var param_18: f32;
    var param_1_17: f32;
    var param_2_14: f32;
    var param_3_11: f32;
    var param_4_7: f32;
    var param_5_1: f32;

    n_dot_h_7 = n_dot_h;
    h_dot_h_3 = h_dot_h;
    n_dot_l_9 = n_dot_l;
    n_dot_v_9 = n_dot_v;
    masking_1 = masking;
    let _e10 = masking_1;
    if (_e10 == 2i) {
        {
            let _e13 = n_dot_l_9;
            let _e14 = n_dot_v_9;
            if (min(_e13, _e14) > 0.000001f) {
                let _e18 = h_dot_h_3;
                local_3 = _e18;
            } else {
                local_3 = 0f;
            }
            let _e21 = local_3;
            let _e22 = n_dot_l_9;
            let _e23 = n_dot_v_9;
            return vec2<f32>(_e21, (abs((_e22 * _e23)) + 4e-13f));
        }
    }
    let _e29 = masking_1;
    if (_e29 == 1i) {
        {
            let _e32 = n_dot_l_9;
            param_18 = _e32;
            let _e34 = n_dot_v_9;
            param_1_17 = _e34;
            let _e36 = param_18;
            let _e37 = param_1_17;
            let _e38 = fr_masking_kelemen_ratio(_e36, _e37);
            return _e38;
        }
    }
    let _e39 = n_dot_h_7;
    param_2_14 = _e39;
    let _e41 = h_dot_h_3;
    param_3_11 = _e41;
    let _e43 = n_dot_l_9;
    param_4_7 = _e43;
    let _e45 = n_dot_v_9;
    param_5_1 = _e45;
    let _e47 = param_2_14;
    let _e48 = param_3_11;
    let _e49 = param_4_7;
    let _e50 = param_5_1;
    let _e51 = fr_masking_v_cavity_ratio(_e47, _e48, _e49, _e50);
    return _e51;
}

// Constant factor of the Cook-Torrance BRDF: the argument `scale` of the Fresnel functions.
//
//   formula:  ln 2/(4 pi) for the exact lobe, where fr_cook_torrance_parts divides by m^2 ln 2
//             instead of m^2; 1/(4 pi) for other lobes
//   lobe:     FR_LOBE_EXACT or another macro of lobe.glsl, a constant.
//   unit:     1/sr
//   returns:  In (0, 1).
//   error:    None.
fn fr_cook_torrance_scale(lobe: i32) -> f32 {
    var lobe_5: i32;

    lobe_5 = lobe;
    let _e2 = lobe_5;
    if (_e2 == 1i) {
        {
            return 0.0551589f;
        }
    }
    return 0.07957747f;
}

// Pair (x, y): x is the Cook-Torrance BRDF without Fresnel term and constant factor, y is V.H.
//
//   formula:  x = G D/(pi (N.L)(N.V)) divided by fr_cook_torrance_scale, y = V.H
//   lobe:     FR_LOBE_EXACT or another macro of lobe.glsl, a constant.
//   masking:  FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
//   unit:     none
//   returns:  x and y, both >= 0; x is finite, 0 or NaN in the same cases as fr_cook_torrance.
fn fr_cook_torrance_parts(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32, lobe: i32, masking: i32) -> vec2<f32> {
    var n_6: vec3<f32>;
    var l_1: vec3<f32>;
    var v_3: vec3<f32>;
    var m_31: f32;
    var lobe_7: i32;
    var masking_3: i32;
    var n_dot_l_10: f32;
    var n_dot_v_10: f32;
    var h_4: vec3<f32>;
    var n_dot_h_8: f32;
    var slope2: f32;
    var param_19: vec3<f32>;
    var param_1_18: vec3<f32>;
    var param_2_15: f32;
    var squares: vec2<f32>;
    var param_3_12: f32;
    var param_4_8: f32;
    var param_5_2: f32;
    var param_6_1: f32;
    var param_7_1: i32;
    var masked: vec2<f32>;
    var along_1: f32;
    var w_2: f32;
    var _inverse_1: f32;
    var x_3: f32;
    var sec2_1: f32;
    var m2: f32;
    var param_8_1: vec3<f32>;
    var h_dot_h_4: f32;
    var param_9_1: f32;
    var param_10_1: f32;
    var param_11_1: f32;
    var param_12_1: f32;
    var param_13_1: i32;
    var masked_1: vec2<f32>;
    var divisor: f32;
    var _inverse_1_: f32;
    var inverse_m2_8: f32;
    var inverse_length: f32;
    var c_25: f32;
    var slope: f32;
    var param_14_1: f32;
    var param_15_1: f32;
    var param_16_1: f32;
    var param_17_1: i32 = 4i;
    var param_18_1: i32;
    var value: f32;

    n_6 = n;
    l_1 = l;
    v_3 = v;
    m_31 = m;
    lobe_7 = lobe;
    masking_3 = masking;
    let _e12 = n_6;
    let _e13 = l_1;
    n_dot_l_10 = clamp(dot(_e12, _e13), 0f, 1f);
    let _e19 = n_6;
    let _e20 = v_3;
    n_dot_v_10 = clamp(dot(_e19, _e20), 0f, 1f);
    let _e26 = l_1;
    let _e27 = v_3;
    h_4 = (_e26 + _e27);
    let _e30 = n_dot_l_10;
    let _e31 = n_dot_v_10;
    n_dot_h_8 = (_e30 + _e31);
    let _e34 = m_31;
    let _e35 = m_31;
    slope2 = (_e34 * _e35);
    let _e38 = lobe_7;
    if (_e38 == 1i) {
        {
            let _e41 = n_6;
            param_19 = _e41;
            let _e43 = h_4;
            param_1_18 = _e43;
            let _e45 = n_dot_h_8;
            param_2_15 = _e45;
            let _e47 = param_19;
            let _e48 = param_1_18;
            let _e49 = param_2_15;
            let _e50 = fr_half_vector(_e47, _e48, _e49);
            squares = _e50;
            let _e52 = n_dot_h_8;
            param_3_12 = _e52;
            let _e54 = squares;
            param_4_8 = _e54.x;
            let _e57 = n_dot_l_10;
            param_5_2 = _e57;
            let _e59 = n_dot_v_10;
            param_6_1 = _e59;
            let _e61 = masking_3;
            param_7_1 = _e61;
            let _e63 = param_3_12;
            let _e64 = param_4_8;
            let _e65 = param_5_2;
            let _e66 = param_6_1;
            let _e67 = param_7_1;
            let _e68 = fr_masking_of(_e63, _e64, _e65, _e66, _e67);
            masked = _e68;
            let _e70 = n_dot_h_8;
            let _e71 = n_dot_h_8;
            along_1 = ((_e70 * _e71) + 4e-13f);
            let _e77 = slope2;
            w_2 = ((0.6931472f * _e77) + 4e-13f);
            let _e83 = masked;
            let _e85 = along_1;
            let _e87 = w_2;
            _inverse_1 = (1f / ((_e83.y * _e85) * _e87));
            let _e91 = squares;
            let _e93 = masked;
            let _e96 = _inverse_1;
            x_3 = ((_e91.y * _e93.y) * _e96);
            let _e99 = x_3;
            let _e100 = w_2;
            sec2_1 = ((_e99 * _e100) + 1f);
            let _e105 = x_3;
            let _e108 = sec2_1;
            let _e110 = masked;
            let _e112 = _inverse_1;
            let _e116 = squares;
            return vec2<f32>(((exp2(-(_e105)) * _e108) * (_e110.x * _e112)), (0.5f * sqrt(_e116.x)));
        }
    }
    let _e121 = slope2;
    m2 = (_e121 + 4e-13f);
    let _e125 = h_4;
    param_8_1 = _e125;
    let _e127 = param_8_1;
    let _e128 = fr_half_vector_square(_e127);
    h_dot_h_4 = _e128;
    let _e130 = n_dot_h_8;
    param_9_1 = _e130;
    let _e132 = h_dot_h_4;
    param_10_1 = _e132;
    let _e134 = n_dot_l_10;
    param_11_1 = _e134;
    let _e136 = n_dot_v_10;
    param_12_1 = _e136;
    let _e138 = masking_3;
    param_13_1 = _e138;
    let _e140 = param_9_1;
    let _e141 = param_10_1;
    let _e142 = param_11_1;
    let _e143 = param_12_1;
    let _e144 = param_13_1;
    let _e145 = fr_masking_of(_e140, _e141, _e142, _e143, _e144);
    masked_1 = _e145;
    let _e147 = masked_1;
    let _e149 = h_dot_h_4;
    divisor = (_e147.y * _e149);
    let _e153 = divisor;
    let _e154 = m2;
    _inverse_1_ = (1f / (_e153 * _e154));
    let _e158 = divisor;
    let _e159 = _inverse_1_;
    inverse_m2_8 = (_e158 * _e159);
    let _e162 = h_dot_h_4;
    inverse_length = inverseSqrt(_e162);
    let _e165 = n_dot_h_8;
    let _e166 = inverse_length;
    c_25 = (_e165 * _e166);
    let _e169 = m_31;
    slope = max(_e169, 0.0001f);
    let _e173 = c_25;
    param_14_1 = _e173;
    let _e175 = slope;
    param_15_1 = _e175;
    let _e177 = inverse_m2_8;
    param_16_1 = _e177;
    let _e181 = lobe_7;
    param_18_1 = _e181;
    let _e183 = param_14_1;
    let _e184 = param_15_1;
    let _e185 = param_16_1;
    let _e186 = param_17_1;
    let _e187 = param_18_1;
    let _e188 = fr_lobe_with_inverse_m2(_e183, _e184, _e185, _e186, _e187);
    value = _e188;
    let _e190 = value;
    let _e191 = masked_1;
    let _e193 = _inverse_1_;
    let _e197 = h_dot_h_4;
    let _e199 = inverse_length;
    return vec2<f32>((_e190 * (_e191.x * _e193)), ((0.5f * _e197) * _e199));
}

// Cook-Torrance specular BRDF with the terms that the arguments select.
// Programs with different terms per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
//   fresnel:  Replaces FR_FRESNEL: FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   masking:  Replaces FR_MASKING: FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
fn fr_cook_torrance_terms(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32, f0: f32, lobe: i32, fresnel: i32, masking: i32) -> f32 {
    var n_8: vec3<f32>;
    var l_3: vec3<f32>;
    var v_5: vec3<f32>;
    var m_33: f32;
    var f0_15: f32;
    var lobe_9: i32;
    var fresnel_5: i32;
    var masking_5: i32;
    var param_20: vec3<f32>;
    var param_1_19: vec3<f32>;
    var param_2_16: vec3<f32>;
    var param_3_13: f32;
    var param_4_9: i32;
    var param_5_3: i32;
    var parts: vec2<f32>;
    var param_6_2: i32;
    var param_7_2: f32;
    var param_8_2: f32;
    var param_9_2: f32;
    var param_10_2: i32;

    n_8 = n;
    l_3 = l;
    v_5 = v;
    m_33 = m;
    f0_15 = f0;
    lobe_9 = lobe;
    fresnel_5 = fresnel;
    masking_5 = masking;
    let _e16 = n_8;
    param_20 = _e16;
    let _e18 = l_3;
    param_1_19 = _e18;
    let _e20 = v_5;
    param_2_16 = _e20;
    let _e22 = m_33;
    param_3_13 = _e22;
    let _e24 = lobe_9;
    param_4_9 = _e24;
    let _e26 = masking_5;
    param_5_3 = _e26;
    let _e28 = param_20;
    let _e29 = param_1_19;
    let _e30 = param_2_16;
    let _e31 = param_3_13;
    let _e32 = param_4_9;
    let _e33 = param_5_3;
    let _e34 = fr_cook_torrance_parts(_e28, _e29, _e30, _e31, _e32, _e33);
    parts = _e34;
    let _e36 = lobe_9;
    param_6_2 = _e36;
    let _e38 = param_6_2;
    let _e39 = fr_cook_torrance_scale(_e38);
    param_7_2 = _e39;
    let _e41 = f0_15;
    param_8_2 = _e41;
    let _e43 = parts;
    param_9_2 = _e43.y;
    let _e46 = fresnel_5;
    param_10_2 = _e46;
    let _e48 = parts;
    let _e50 = param_7_2;
    let _e51 = param_8_2;
    let _e52 = param_9_2;
    let _e53 = param_10_2;
    let _e54 = fr_fresnel_times(_e50, _e51, _e52, _e53);
    return (_e48.x * _e54);
}

// Cook-Torrance specular BRDF with the terms that the host's macros select.
fn fr_cook_torrance(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32, f0: f32) -> f32 {
    var n_10: vec3<f32>;
    var l_5: vec3<f32>;
    var v_7: vec3<f32>;
    var m_35: f32;
    var f0_17: f32;
    var param_21: vec3<f32>;
    var param_1_20: vec3<f32>;
    var param_2_17: vec3<f32>;
    var param_3_14: f32;
    var param_4_10: f32;
    var param_5_4: i32 = 1i;
    var param_6_3: i32 = 0i;
    var param_7_3: i32 = 0i;

    n_10 = n;
    l_5 = l;
    v_7 = v;
    m_35 = m;
    f0_17 = f0;
    let _e10 = n_10;
    param_21 = _e10;
    let _e12 = l_5;
    param_1_20 = _e12;
    let _e14 = v_7;
    param_2_17 = _e14;
    let _e16 = m_35;
    param_3_14 = _e16;
    let _e18 = f0_17;
    param_4_10 = _e18;
    let _e26 = param_21;
    let _e27 = param_1_20;
    let _e28 = param_2_17;
    let _e29 = param_3_14;
    let _e30 = param_4_10;
    let _e31 = param_5_4;
    let _e32 = param_6_3;
    let _e33 = param_7_3;
    let _e34 = fr_cook_torrance_terms(_e26, _e27, _e28, _e29, _e30, _e31, _e32, _e33);
    return _e34;
}

// Cook-Torrance specular BRDF in RGB, with Schlick's Fresnel term and a given reflectance at 90
// degrees.
//
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
fn fr_cook_torrance_rgb(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32, f0: vec3<f32>, f90: vec3<f32>) -> vec3<f32> {
    var n_12: vec3<f32>;
    var l_7: vec3<f32>;
    var v_9: vec3<f32>;
    var m_37: f32;
    var f0_19: vec3<f32>;
    var f90_3: vec3<f32>;
    var param_22: vec3<f32>;
    var param_1_21: vec3<f32>;
    var param_2_18: vec3<f32>;
    var param_3_15: f32;
    var param_4_11: i32 = 1i;
    var param_5_5: i32 = 0i;
    var parts_1: vec2<f32>;
    var param_6_4: i32 = 1i;
    var scale_8: f32;
    var param_7_4: f32;
    var param_8_3: vec3<f32>;
    var param_9_3: vec3<f32>;
    var param_10_3: f32;

    n_12 = n;
    l_7 = l;
    v_9 = v;
    m_37 = m;
    f0_19 = f0;
    f90_3 = f90;
    let _e12 = n_12;
    param_22 = _e12;
    let _e14 = l_7;
    param_1_21 = _e14;
    let _e16 = v_9;
    param_2_18 = _e16;
    let _e18 = m_37;
    param_3_15 = _e18;
    let _e24 = param_22;
    let _e25 = param_1_21;
    let _e26 = param_2_18;
    let _e27 = param_3_15;
    let _e28 = param_4_11;
    let _e29 = param_5_5;
    let _e30 = fr_cook_torrance_parts(_e24, _e25, _e26, _e27, _e28, _e29);
    parts_1 = _e30;
    let _e34 = param_6_4;
    let _e35 = fr_cook_torrance_scale(_e34);
    scale_8 = _e35;
    let _e37 = scale_8;
    param_7_4 = _e37;
    let _e39 = f0_19;
    param_8_3 = _e39;
    let _e41 = f90_3;
    param_9_3 = _e41;
    let _e43 = parts_1;
    param_10_3 = _e43.y;
    let _e46 = param_7_4;
    let _e47 = param_8_3;
    let _e48 = param_9_3;
    let _e49 = param_10_3;
    let _e50 = fr_fresnel_schlick_rgb(_e46, _e47, _e48, _e49);
    let _e51 = parts_1;
    return (_e50 * _e51.x);
}

// Ward's isotropic specular BRDF with the lobe that the argument `lobe` selects.
// Programs with different lobes per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
fn fr_ward_terms(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32, lobe: i32) -> f32 {
    var n_14: vec3<f32>;
    var l_9: vec3<f32>;
    var v_11: vec3<f32>;
    var m_39: f32;
    var lobe_11: i32;
    var n_dot_l_11: f32;
    var n_dot_v_11: f32;
    var h_5: vec3<f32>;
    var n_dot_h_9: f32;
    var product: f32;
    var m2_1: f32;
    var value_1: f32;
    var along_2: f32;
    var w_3: f32;
    var param_23: vec3<f32>;
    var param_1_22: vec3<f32>;
    var param_2_19: f32;
    var x_4: f32;
    var inverse_m2_9: f32;
    var param_3_16: vec3<f32>;
    var c_26: f32;
    var slope_1: f32;
    var param_4_12: f32;
    var param_5_6: f32;
    var param_6_5: f32;
    var param_7_5: i32 = 0i;
    var param_8_4: i32;
    var local_4: f32;

    n_14 = n;
    l_9 = l;
    v_11 = v;
    m_39 = m;
    lobe_11 = lobe;
    let _e10 = n_14;
    let _e11 = l_9;
    n_dot_l_11 = dot(_e10, _e11);
    let _e14 = n_14;
    let _e15 = v_11;
    n_dot_v_11 = clamp(dot(_e14, _e15), 0f, 1f);
    let _e21 = l_9;
    let _e22 = v_11;
    h_5 = (_e21 + _e22);
    let _e25 = n_dot_l_11;
    let _e26 = n_dot_v_11;
    n_dot_h_9 = (_e25 + _e26);
    let _e29 = n_dot_l_11;
    let _e30 = n_dot_v_11;
    product = (_e29 * _e30);
    let _e33 = m_39;
    let _e34 = m_39;
    m2_1 = ((_e33 * _e34) + 4e-13f);
    let _e40 = lobe_11;
    if (_e40 == 1i) {
        {
            let _e43 = n_dot_h_9;
            let _e44 = n_dot_h_9;
            along_2 = ((_e43 * _e44) + 4e-13f);
            let _e50 = m2_1;
            w_3 = (0.6931472f * _e50);
            let _e53 = n_14;
            param_23 = _e53;
            let _e55 = h_5;
            param_1_22 = _e55;
            let _e57 = n_dot_h_9;
            param_2_19 = _e57;
            let _e59 = param_23;
            let _e60 = param_1_22;
            let _e61 = param_2_19;
            let _e62 = fr_half_vector(_e59, _e60, _e61);
            let _e64 = along_2;
            let _e65 = w_3;
            x_4 = (_e62.y / (_e64 * _e65));
            let _e71 = x_4;
            let _e74 = w_3;
            let _e75 = w_3;
            let _e77 = product;
            value_1 = (exp2((-4.1802626f - _e71)) * inverseSqrt(((_e74 * _e75) * _e77)));
        }
    } else {
        {
            let _e82 = m2_1;
            inverse_m2_9 = (1f / _e82);
            let _e85 = h_5;
            param_3_16 = _e85;
            let _e87 = n_dot_h_9;
            let _e88 = param_3_16;
            let _e89 = fr_half_vector_square(_e88);
            c_26 = (_e87 * inverseSqrt(_e89));
            let _e93 = m_39;
            slope_1 = max(_e93, 0.0001f);
            let _e97 = c_26;
            param_4_12 = _e97;
            let _e99 = slope_1;
            param_5_6 = _e99;
            let _e101 = inverse_m2_9;
            param_6_5 = _e101;
            let _e105 = lobe_11;
            param_8_4 = _e105;
            let _e107 = param_4_12;
            let _e108 = param_5_6;
            let _e109 = param_6_5;
            let _e110 = param_7_5;
            let _e111 = param_8_4;
            let _e112 = fr_lobe_with_inverse_m2(_e107, _e108, _e109, _e110, _e111);
            let _e114 = inverse_m2_9;
            let _e116 = product;
            value_1 = (_e112 * ((0.07957747f * _e114) * inverseSqrt(_e116)));
        }
    }
    let _e120 = product;
    if (_e120 > 1e-12f) {
        let _e123 = value_1;
        local_4 = _e123;
    } else {
        local_4 = 0f;
    }
    let _e126 = local_4;
    return _e126;
}

// Ward's isotropic specular BRDF with the lobe that the macro FR_LOBE selects.
fn fr_ward(n: vec3<f32>, l: vec3<f32>, v: vec3<f32>, m: f32) -> f32 {
    var n_16: vec3<f32>;
    var l_11: vec3<f32>;
    var v_13: vec3<f32>;
    var m_41: f32;
    var param_24: vec3<f32>;
    var param_1_23: vec3<f32>;
    var param_2_20: vec3<f32>;
    var param_3_17: f32;
    var param_4_13: i32 = 1i;

    n_16 = n;
    l_11 = l;
    v_13 = v;
    m_41 = m;
    let _e8 = n_16;
    param_24 = _e8;
    let _e10 = l_11;
    param_1_23 = _e10;
    let _e12 = v_13;
    param_2_20 = _e12;
    let _e14 = m_41;
    param_3_17 = _e14;
    let _e18 = param_24;
    let _e19 = param_1_23;
    let _e20 = param_2_20;
    let _e21 = param_3_17;
    let _e22 = param_4_13;
    let _e23 = fr_ward_terms(_e18, _e19, _e20, _e21, _e22);
    return _e23;
}
