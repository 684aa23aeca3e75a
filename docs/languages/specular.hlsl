// specular.glsl with what it includes of facerender 0.1.0.
// SPDX-License-Identifier: MIT, (c) 2026 the facerender contributors

#define FR_LOBE_EXACT 1
#define FR_LOBE_COSINE 2
#define FR_LOBE_D4 4
#define FR_LOBE_D8 8
#define FR_LOBE_D16 16
#define FR_LOBE_FITTED 3
#define FR_LOBE_FITTED_FINE 5
#define FR_LOBE_G_POWER 6
#define FR_LOBE_OWN 90
#define FR_LOBE_EVERY 91
#define FR_FRESNEL_SCHLICK 0
#define FR_FRESNEL_DIELECTRIC 1
#define FR_FRESNEL_CONSTANT 2
#define FR_MASKING_V_CAVITY 0
#define FR_MASKING_KELEMEN 1
#define FR_MASKING_NONE 2

// Squared length of the half vector, plus FR_FLOOR.
//
//   formula:  |h|^2 + FR_FLOOR; because of FR_FLOOR, the result may be a divisor
//   returns:  > 0.
//   error:    float32 rounding: 3e-7 times |h|^2, plus FR_FLOOR.
float fr_half_vector_square(float3 h)
{
    return (h.x * h.x) + ((h.y * h.y) + ((h.z * h.z) + 4e-13f));
}

float2 fr_half_vector(float3 n, float3 h, float n_dot_h)
{
    float along = n_dot_h * n_dot_h;
    float3 across = h - (n * n_dot_h);
    float across2 = dot(across, across);
    return float2(along + across2, across2);
}

// Slope factor E of the exact lobe.
//
//   formula:  E = exp(-x)
//   returns:  1 at x = 0.
float fr_slope_factor(float x)
{
    return exp2((-1.442695f) * x);
}

// Exact lobe from tan^2(gamma), which keeps the digits of small angles, unlike c.
float fr_lobe_exact_tan2(float tan2, float m, int k)
{
    float t = clamp(tan2, 0.0f, 1000000.0f);
    float param = t / (m * m);
    float e = fr_slope_factor(param);
    if (k == 4)
    {
        float sec2 = 1.0f + t;
        e *= (sec2 * sec2);
    }
    return e;
}

float fr_lobe_exact(float c, float m, int k)
{
    float x = clamp(c, 0.001f, 1.0f);
    float param = ((1.0f - x) * (1.0f + x)) / (x * x);
    float param_1 = m;
    int param_2 = k;
    return fr_lobe_exact_tan2(param, param_1, param_2);
}

// Power of a cosine.
//
//   formula:  c^n
//   n:        Exponent; clamped to at least 0.
//   error:    The formula is exact. For the difference between c^n and E/c^k see fr_lobe_cosine.
float fr_lobe_power(float c, float n)
{
    return exp2(max(n, 0.0f) * log2(clamp(c, 1e-30f, 1.0f)));
}

// Cosine-power lobe.
float fr_lobe_cosine(float c, float m, int k)
{
    float param = c;
    float param_1 = (2.0f / (m * m)) - float(k);
    return fr_lobe_power(param, param_1);
}

// Factor linear in c, clamped and raised to a power: the g-power lobe with free g and steepness.
//
//   formula:    max(1 - steepness (1 - c), 0)^g
//   steepness:  Steepness of the linear factor, >= 0; (2/m^2 - k)/g gives D4, D8 and D16.
//   g:          Power, 1 to 31, a constant.
//   error:      The formula is exact. Its difference from E/c^k depends on the steepness, which
//               facerender plan fits to a given m.
//   source:     Lyon (1993).
float fr_lobe_clamped_power(float c, float steepness, int g)
{
    float p = clamp(1.0f - (steepness * (1.0f - c)), 0.0f, 1.0f);
    float p2 = p * p;
    float p4 = p2 * p2;
    float p8 = p4 * p4;
    float power = ((g & 1) != 0) ? p : 1.0f;
    if ((g & 2) != 0)
    {
        power *= p2;
    }
    if ((g & 4) != 0)
    {
        power *= p4;
    }
    if ((g & 8) != 0)
    {
        power *= p8;
    }
    if ((g & 16) != 0)
    {
        power *= (p8 * p8);
    }
    return power;
}

// g-power lobe D4, D8 or D16, for g = 4, 8 or 16.
float fr_lobe_g_power(float c, float m, int k, int g)
{
    float n = (2.0f / (m * m)) - float(k);
    float param = c;
    float param_1 = n / float(g);
    int param_2 = g;
    return fr_lobe_clamped_power(param, param_1, param_2);
}

// Variable of the polynomials, u/m^2, with m clamped to the lobe's domain.
//
//   formula:     u/m^2
//   u:           1 - c, in [0, 1].
//   inverse_m2:  1/m^2; clamped to at least 1/m^2 at the largest m of the domain.
//   returns:     >= 0.
//   error:       The formula is exact.
float fr_lobe_fitted_variable(float u, float inverse_m2, int k)
{
    return u * max(inverse_m2, (k == 4) ? 2.0408163f : 1.0f);
}

// Numerators of the polynomial coefficients in fr_lobe_fitted.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6; each is a cubic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted.
float3 fr_lobe_fitted_numerators(float m, int k)
{
    float w = m * m;
    float3 a;
    if (k == 4)
    {
        w = min(w, 0.49f);
        a = float3(-0.39700398f, 0.07498738f, -0.006093595f) + ((float3(0.6738297f, -0.586297f, 0.002621735f) + ((float3(0.71936625f, -1.6754473f, 1.1615276f) + (float3(-1.0351326f, 4.1195316f, -5.0082765f) * w)) * w)) * w);
    }
    else
    {
        w = min(w, 1.0f);
        a = float3(-0.40198097f, 0.08352605f, -0.010091574f) + ((float3(-0.020725707f, -0.49894732f, 0.08771378f) + ((float3(0.0773726f, -0.42975122f, 0.18764888f) + (float3(-0.06750309f, 0.5130421f, -1.5410764f) * w)) * w)) * w);
    }
    return a;
}

// Coefficients of fr_lobe_fitted, for hosts that define FR_FITTED_COEFFICIENTS.
//
//   formula:  a1, a2, a3; each a_i m^(2i) is a cubic in m^2
//   returns:  Factors of u, u^2, u^3.
//   error:    See fr_lobe_fitted.
float3 fr_lobe_fitted_coefficients(float m, int k)
{
    float param = 1.0f;
    float param_1 = 1.0f / (m * m);
    int param_2 = k;
    float r = fr_lobe_fitted_variable(param, param_1, param_2);
    float param_3 = m;
    int param_4 = k;
    return fr_lobe_fitted_numerators(param_3, param_4) * float3(r, r * r, (r * r) * r);
}

// Fitted lobe for callers that already have 1/m^2: the fifth power of a clamped cubic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
float fr_lobe_fitted_with_inverse_m2(float c, float m, float inverse_m2, int k)
{
    float param = m;
    int param_1 = k;
    float3 a = fr_lobe_fitted_numerators(param, param_1);
    float param_2 = 1.0f - c;
    float param_3 = inverse_m2;
    int param_4 = k;
    float v = fr_lobe_fitted_variable(param_2, param_3, param_4);
    float p = clamp(1.0f + (v * (a.x + (v * (a.y + (v * a.z))))), 0.0f, 1.0f);
    float p2 = p * p;
    return (p2 * p2) * p;
}

// Fitted lobe: the fifth power of a clamped cubic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3, 0)^5, u = 1 - c
//   error:    At most 0.19 % of the peak for Cook-Torrance, 0.13 % for Ward.
float fr_lobe_fitted(float c, float m, int k)
{
    float param = c;
    float param_1 = m;
    float param_2 = 1.0f / (m * m);
    int param_3 = k;
    return fr_lobe_fitted_with_inverse_m2(param, param_1, param_2, param_3);
}

// Numerators of the polynomial coefficients in fr_lobe_fitted_fine.
//
//   formula:  a1 m^2, a2 m^4, a3 m^6, a4 m^8; each is a quartic in m^2
//   returns:  Factors of u/m^2, (u/m^2)^2 and so on, in this order.
//   error:    See fr_lobe_fitted_fine.
float4 fr_lobe_fitted_fine_numerators(float m, int k)
{
    float w = m * m;
    float4 a;
    if (k == 4)
    {
        w = min(w, 0.49f);
        a = float4(-0.24963108f, 0.030319914f, -0.0020734922f, 0.0f) + ((float4(0.50360703f, -0.52566284f, 0.15216286f, -0.017956778f) + ((float4(-0.013824908f, 0.5056545f, -0.924527f, 0.030042244f) + ((float4(-0.08171914f, 0.47515005f, -1.4199605f, 1.6944034f) + (float4(0.19363847f, -1.434821f, 4.5145226f, -5.6548033f) * w)) * w)) * w)) * w);
    }
    else
    {
        w = min(w, 1.0f);
        a = float4(-0.24950537f, 0.02981122f, -0.0017648838f, 0.0f) + ((float4(0.0018034024f, -0.38853177f, 0.14142554f, -0.024093986f) + ((float4(-0.0076809274f, 0.07839925f, -0.74785185f, 0.058197197f) + ((float4(-0.0071770926f, 0.063575566f, -0.40797552f, 1.0990611f) + (float4(0.015975844f, -0.20239128f, 1.087785f, -2.6305628f) * w)) * w)) * w)) * w);
    }
    return a;
}

// Coefficients of fr_lobe_fitted_fine, for hosts that define FR_FITTED_FINE_COEFFICIENTS.
//
//   formula:  a1, a2, a3, a4; each a_i m^(2i) is a quartic in m^2
//   returns:  Factors of u, u^2, u^3, u^4.
//   error:    See fr_lobe_fitted_fine.
float4 fr_lobe_fitted_fine_coefficients(float m, int k)
{
    float param = 1.0f;
    float param_1 = 1.0f / (m * m);
    int param_2 = k;
    float r = fr_lobe_fitted_variable(param, param_1, param_2);
    float param_3 = m;
    int param_4 = k;
    return fr_lobe_fitted_fine_numerators(param_3, param_4) * float4(r, r * r, (r * r) * r, (r * r) * (r * r));
}

// Finer fitted lobe for callers that have 1/m^2: the eighth power of a clamped quartic in 1 - c.
//
//   formula:     max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   inverse_m2:  1/m^2.
//   error:       At most 0.04 % of the peak for both models.
float fr_lobe_fitted_fine_with_inverse_m2(float c, float m, float inverse_m2, int k)
{
    float param = m;
    int param_1 = k;
    float4 a = fr_lobe_fitted_fine_numerators(param, param_1);
    float param_2 = 1.0f - c;
    float param_3 = inverse_m2;
    int param_4 = k;
    float v = fr_lobe_fitted_variable(param_2, param_3, param_4);
    float p = clamp(1.0f + (v * (a.x + (v * (a.y + (v * (a.z + (v * a.w))))))), 0.0f, 1.0f);
    float p2 = p * p;
    float p4 = p2 * p2;
    return p4 * p4;
}

// Finer fitted lobe: the eighth power of a clamped quartic in 1 - c.
//
//   formula:  max(1 + a1 u + a2 u^2 + a3 u^3 + a4 u^4, 0)^8, u = 1 - c
//   error:    At most 0.04 % of the peak for both models.
float fr_lobe_fitted_fine(float c, float m, int k)
{
    float param = c;
    float param_1 = m;
    float param_2 = 1.0f / (m * m);
    int param_3 = k;
    return fr_lobe_fitted_fine_with_inverse_m2(param, param_1, param_2, param_3);
}

// Lobe that the argument `lobe` selects, for callers, such as a BRDF, that already have 1/m^2.
//
//   inverse_m2:  1/m^2.
float fr_lobe_with_inverse_m2(float c, float m, float inverse_m2, int k, int lobe)
{
    if (lobe == 1)
    {
        float param = c;
        float param_1 = m;
        int param_2 = k;
        return fr_lobe_exact(param, param_1, param_2);
    }
    if (lobe == 2)
    {
        float param_3 = c;
        float param_4 = (2.0f * inverse_m2) - float(k);
        return fr_lobe_power(param_3, param_4);
    }
    if (lobe == 4)
    {
        float param_5 = c;
        float param_6 = (0.5f * inverse_m2) - (0.25f * float(k));
        int param_7 = 4;
        return fr_lobe_clamped_power(param_5, param_6, param_7);
    }
    if (lobe == 8)
    {
        float param_8 = c;
        float param_9 = (0.25f * inverse_m2) - (0.125f * float(k));
        int param_10 = 8;
        return fr_lobe_clamped_power(param_8, param_9, param_10);
    }
    if (lobe == 16)
    {
        float param_11 = c;
        float param_12 = (0.125f * inverse_m2) - (0.0625f * float(k));
        int param_13 = 16;
        return fr_lobe_clamped_power(param_11, param_12, param_13);
    }
    if (lobe == 3)
    {
        float param_14 = c;
        float param_15 = m;
        float param_16 = inverse_m2;
        int param_17 = k;
        return fr_lobe_fitted_with_inverse_m2(param_14, param_15, param_16, param_17);
    }
    if (lobe == 5)
    {
        float param_18 = c;
        float param_19 = m;
        float param_20 = inverse_m2;
        int param_21 = k;
        return fr_lobe_fitted_fine_with_inverse_m2(param_18, param_19, param_20, param_21);
    }
    if (lobe == 6)
    {
        float param_22 = c;
        float param_23 = ((2.0f / (m * m)) - float(k)) / 8.0f;
        int param_24 = 8;
        return fr_lobe_clamped_power(param_22, param_23, param_24);
    }
    return 0.0f;
}

// Lobe that the argument `lobe` selects.
float fr_lobe_of(float c, float m, int k, int lobe)
{
    float param = c;
    float param_1 = m;
    float param_2 = 1.0f / (m * m);
    int param_3 = k;
    int param_4 = lobe;
    return fr_lobe_with_inverse_m2(param, param_1, param_2, param_3, param_4);
}

// Lobe that the macro FR_LOBE selects, for example by #define FR_LOBE FR_LOBE_D16.
float fr_lobe(float c, float m, int k)
{
    float param = c;
    float param_1 = m;
    int param_2 = k;
    int param_3 = 1;
    return fr_lobe_of(param, param_1, param_2, param_3);
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
float fr_fresnel_schlick(float f0, float v_dot_h)
{
    float u = abs(1.0f - v_dot_h);
    float u2 = u * u;
    return f0 + ((1.0f - f0) * ((u2 * u2) * u));
}

// Grazing part of Schlick's approximation times a constant factor.
// Compilers fold the fifth root of a constant `scale`, so that the multiplication costs nothing.
//
//   formula:  scale (1 - V.H)^5
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    The formula is exact; float32 rounding: 2e-6 of the scale.
float fr_fresnel_schlick_grazing(float scale, float v_dot_h)
{
    float root = pow(scale, 0.2f);
    float u = abs(root - (root * v_dot_h));
    float u2 = u * u;
    return (u2 * u2) * u;
}

// Schlick's approximation of the Fresnel reflectance times a constant factor.
//
//   formula:  scale (f0 + (1 - f0)(1 - V.H)^5)
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
float fr_fresnel_schlick_times(float scale, float f0, float v_dot_h)
{
    float param = scale;
    float param_1 = v_dot_h;
    float grazing = fr_fresnel_schlick_grazing(param, param_1);
    return (f0 * (scale - grazing)) + grazing;
}

// Schlick's approximation in RGB times a constant factor, with a given reflectance at 90 degrees.
//
//   formula:  scale (f0 + (f90 - f0)(1 - V.H)^5)
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
//   error:    float32 rounding: 2e-6 of the scale.
float3 fr_fresnel_schlick_rgb(float scale, float3 f0, float3 f90, float v_dot_h)
{
    float param = scale;
    float param_1 = v_dot_h;
    float grazing = fr_fresnel_schlick_grazing(param, param_1);
    return (f0 * (scale - grazing)) + (f90 * grazing);
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
float fr_fresnel_dielectric(float f0, float v_dot_h)
{
    float root = sqrt(f0);
    float q = (4.0f * root) / ((1.0f - root) * (1.0f - root));
    float c = min(v_dot_h, 1.0f);
    float sum = max(sqrt(q + (c * c)) + c, 1e-20f);
    float difference = q / sum;
    float a = difference / sum;
    float b = ((c * sum) - 1.0f) / ((c * difference) + 1.0f);
    return clamp(((0.5f * a) * a) * (1.0f + (b * b)), 0.0f, 1.0f);
}

// Fresnel reflectance by the formula that the compile-time constant `fresnel` selects.
float fr_fresnel_of(float f0, float v_dot_h, int fresnel)
{
    if (fresnel == 2)
    {
        return f0;
    }
    if (fresnel == 1)
    {
        float param = f0;
        float param_1 = v_dot_h;
        return fr_fresnel_dielectric(param, param_1);
    }
    float param_2 = f0;
    float param_3 = v_dot_h;
    return fr_fresnel_schlick(param_2, param_3);
}

// Fresnel reflectance times a constant factor, by the formula that `fresnel` selects.
//
//   scale:    Constant factor, in (0, 1].
//   returns:  In [0, scale].
float fr_fresnel_times(float scale, float f0, float v_dot_h, int fresnel)
{
    if (fresnel == 2)
    {
        return scale * f0;
    }
    if (fresnel == 1)
    {
        float param = f0;
        float param_1 = v_dot_h;
        return scale * fr_fresnel_dielectric(param, param_1);
    }
    float param_2 = scale;
    float param_3 = f0;
    float param_4 = v_dot_h;
    return fr_fresnel_schlick_times(param_2, param_3, param_4);
}

// Fresnel reflectance by the formula that the macro FR_FRESNEL selects.
float fr_fresnel(float f0, float v_dot_h)
{
    float param = f0;
    float param_1 = v_dot_h;
    int param_2 = 0;
    return fr_fresnel_of(param, param_1, param_2);
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
float fr_masking_v_cavity(float n_dot_h, float v_dot_h, float n_dot_l, float n_dot_v)
{
    return min(1.0f, ((2.0f * n_dot_h) * min(n_dot_l, n_dot_v)) / v_dot_h);
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
float2 fr_masking_v_cavity_ratio(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v)
{
    float lower = clamp(min(n_dot_l, n_dot_v), 0.0f, 1.0f);
    return float2(min(h_dot_h, (4.0f * abs(n_dot_h)) * lower), abs(n_dot_l * n_dot_v) + 4e-13f);
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
float fr_masking_kelemen(float v_dot_h, float n_dot_l, float n_dot_v)
{
    float _inverse = 1.0f / v_dot_h;
    return (n_dot_l * _inverse) * (n_dot_v * _inverse);
}

// Kelemen masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h.
//
//   formula:           G/((N.L)(N.V)) = x/(y h.h)
//   n_dot_l, n_dot_v:  dot(n, l) and dot(n, v) for the directions l to the light and v to the
//                      camera, in [-1, 1].
//   unit:              none
//   returns:           x >= 0 and y = 1; x is 0 if N.L or N.V is at most FR_MIN_COSINE.
//   error:             None.
float2 fr_masking_kelemen_ratio(float n_dot_l, float n_dot_v)
{
    return float2((min(n_dot_l, n_dot_v) > 1e-06f) ? 4.0f : 0.0f, 1.0f);
}

// Masking term G divided by (N.L)(N.V): pair (x, y) whose quotient lacks the factor 1/h.h. The
// argument `masking` selects the term.
float2 fr_masking_of(float n_dot_h, float h_dot_h, float n_dot_l, float n_dot_v, int masking)
{
    if (masking == 2)
    {
        return float2((min(n_dot_l, n_dot_v) > 1e-06f) ? h_dot_h : 0.0f, abs(n_dot_l * n_dot_v) + 4e-13f);
    }
    if (masking == 1)
    {
        float param = n_dot_l;
        float param_1 = n_dot_v;
        return fr_masking_kelemen_ratio(param, param_1);
    }
    float param_2 = n_dot_h;
    float param_3 = h_dot_h;
    float param_4 = n_dot_l;
    float param_5 = n_dot_v;
    return fr_masking_v_cavity_ratio(param_2, param_3, param_4, param_5);
}

// Constant factor of the Cook-Torrance BRDF: the argument `scale` of the Fresnel functions.
//
//   formula:  ln 2/(4 pi) for the exact lobe, where fr_cook_torrance_parts divides by m^2 ln 2
//             instead of m^2; 1/(4 pi) for other lobes
//   lobe:     FR_LOBE_EXACT or another macro of lobe.glsl, a constant.
//   unit:     1/sr
//   returns:  In (0, 1).
//   error:    None.
float fr_cook_torrance_scale(int lobe)
{
    if (lobe == 1)
    {
        return 0.0551589f;
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
float2 fr_cook_torrance_parts(float3 n, float3 l, float3 v, float m, int lobe, int masking)
{
    float n_dot_l = clamp(dot(n, l), 0.0f, 1.0f);
    float n_dot_v = clamp(dot(n, v), 0.0f, 1.0f);
    float3 h = l + v;
    float n_dot_h = n_dot_l + n_dot_v;
    float slope2 = m * m;
    if (lobe == 1)
    {
        float3 param = n;
        float3 param_1 = h;
        float param_2 = n_dot_h;
        float2 squares = fr_half_vector(param, param_1, param_2);
        float param_3 = n_dot_h;
        float param_4 = squares.x;
        float param_5 = n_dot_l;
        float param_6 = n_dot_v;
        int param_7 = masking;
        float2 masked = fr_masking_of(param_3, param_4, param_5, param_6, param_7);
        float along = (n_dot_h * n_dot_h) + 4e-13f;
        float w = (0.6931472f * slope2) + 4e-13f;
        float _inverse = 1.0f / ((masked.y * along) * w);
        float x = (squares.y * masked.y) * _inverse;
        float sec2 = (x * w) + 1.0f;
        return float2((exp2(-x) * sec2) * (masked.x * _inverse), 0.5f * sqrt(squares.x));
    }
    float m2 = slope2 + 4e-13f;
    float3 param_8 = h;
    float h_dot_h = fr_half_vector_square(param_8);
    float param_9 = n_dot_h;
    float param_10 = h_dot_h;
    float param_11 = n_dot_l;
    float param_12 = n_dot_v;
    int param_13 = masking;
    float2 masked_1 = fr_masking_of(param_9, param_10, param_11, param_12, param_13);
    float divisor = masked_1.y * h_dot_h;
    float _inverse_1 = 1.0f / (divisor * m2);
    float inverse_m2 = divisor * _inverse_1;
    float inverse_length = rsqrt(h_dot_h);
    float c = n_dot_h * inverse_length;
    float slope = max(m, 1e-04f);
    float param_14 = c;
    float param_15 = slope;
    float param_16 = inverse_m2;
    int param_17 = 4;
    int param_18 = lobe;
    float value = fr_lobe_with_inverse_m2(param_14, param_15, param_16, param_17, param_18);
    return float2(value * (masked_1.x * _inverse_1), (0.5f * h_dot_h) * inverse_length);
}

// Cook-Torrance specular BRDF with the terms that the arguments select.
// Programs with different terms per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
//   fresnel:  Replaces FR_FRESNEL: FR_FRESNEL_SCHLICK, _DIELECTRIC or _CONSTANT, a constant.
//   masking:  Replaces FR_MASKING: FR_MASKING_V_CAVITY, _KELEMEN or _NONE, a constant.
float fr_cook_torrance_terms(float3 n, float3 l, float3 v, float m, float f0, int lobe, int fresnel, int masking)
{
    float3 param = n;
    float3 param_1 = l;
    float3 param_2 = v;
    float param_3 = m;
    int param_4 = lobe;
    int param_5 = masking;
    float2 parts = fr_cook_torrance_parts(param, param_1, param_2, param_3, param_4, param_5);
    int param_6 = lobe;
    float param_7 = fr_cook_torrance_scale(param_6);
    float param_8 = f0;
    float param_9 = parts.y;
    int param_10 = fresnel;
    return parts.x * fr_fresnel_times(param_7, param_8, param_9, param_10);
}

// Cook-Torrance specular BRDF with the terms that the host's macros select.
float fr_cook_torrance(float3 n, float3 l, float3 v, float m, float f0)
{
    float3 param = n;
    float3 param_1 = l;
    float3 param_2 = v;
    float param_3 = m;
    float param_4 = f0;
    int param_5 = 1;
    int param_6 = 0;
    int param_7 = 0;
    return fr_cook_torrance_terms(param, param_1, param_2, param_3, param_4, param_5, param_6, param_7);
}

// Cook-Torrance specular BRDF in RGB, with Schlick's Fresnel term and a given reflectance at 90
// degrees.
//
//   f0, f90:  RGB reflectances at normal incidence and at 90 degrees, each in [0, 1].
float3 fr_cook_torrance_rgb(float3 n, float3 l, float3 v, float m, float3 f0, float3 f90)
{
    float3 param = n;
    float3 param_1 = l;
    float3 param_2 = v;
    float param_3 = m;
    int param_4 = 1;
    int param_5 = 0;
    float2 parts = fr_cook_torrance_parts(param, param_1, param_2, param_3, param_4, param_5);
    int param_6 = 1;
    float scale = fr_cook_torrance_scale(param_6);
    float param_7 = scale;
    float3 param_8 = f0;
    float3 param_9 = f90;
    float param_10 = parts.y;
    return fr_fresnel_schlick_rgb(param_7, param_8, param_9, param_10) * parts.x;
}

// Ward's isotropic specular BRDF with the lobe that the argument `lobe` selects.
// Programs with different lobes per light use this function.
//
//   lobe:     Replaces FR_LOBE: FR_LOBE_EXACT or another macro of lobe.glsl, a constant that the
//             compiler folds. #define FR_LOBE FR_LOBE_EVERY makes all lobes available.
float fr_ward_terms(float3 n, float3 l, float3 v, float m, int lobe)
{
    float n_dot_l = dot(n, l);
    float n_dot_v = clamp(dot(n, v), 0.0f, 1.0f);
    float3 h = l + v;
    float n_dot_h = n_dot_l + n_dot_v;
    float product = n_dot_l * n_dot_v;
    float m2 = (m * m) + 4e-13f;
    float value;
    if (lobe == 1)
    {
        float along = (n_dot_h * n_dot_h) + 4e-13f;
        float w = 0.6931472f * m2;
        float3 param = n;
        float3 param_1 = h;
        float param_2 = n_dot_h;
        float x = fr_half_vector(param, param_1, param_2).y / (along * w);
        value = exp2((-4.1802626f) - x) * rsqrt((w * w) * product);
    }
    else
    {
        float inverse_m2 = 1.0f / m2;
        float3 param_3 = h;
        float c = n_dot_h * rsqrt(fr_half_vector_square(param_3));
        float slope = max(m, 1e-04f);
        float param_4 = c;
        float param_5 = slope;
        float param_6 = inverse_m2;
        int param_7 = 0;
        int param_8 = lobe;
        value = fr_lobe_with_inverse_m2(param_4, param_5, param_6, param_7, param_8) * ((0.07957747f * inverse_m2) * rsqrt(product));
    }
    return (product > 1e-12f) ? value : 0.0f;
}

// Ward's isotropic specular BRDF with the lobe that the macro FR_LOBE selects.
float fr_ward(float3 n, float3 l, float3 v, float m)
{
    float3 param = n;
    float3 param_1 = l;
    float3 param_2 = v;
    float param_3 = m;
    int param_4 = 1;
    return fr_ward_terms(param, param_1, param_2, param_3, param_4);
}
