"""Specular BRDFs with their Fresnel and masking terms: registry entries and float64 references.

``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order. Directions are unit
vectors (..., 3) that broadcast against one another: ``n`` is the normal, ``l`` the direction to the
light, ``v`` the direction to the camera. BRDFs are in 1/sr, without N.L, for a specular weight of
1. As in the shaders, BRDFs are exactly 0 if N.L or N.V is at most 0. Cook-Torrance with Kelemen
masking or without masking is also 0 if N.L or N.V is at most 1e-6. Ward is also 0 if (N.L)(N.V) is
at most 1e-12.

A slope variance is the variance of the slopes along each tangent axis. Variances of independent
slopes add; the variance of detail that a pixel does not resolve thus widens m."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_range
from facerender.terms.lobe import SLOPES, ULP, AnyLobe, Entry, lobe_entry, named, registry

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Fresnel(Entry):
    """A Fresnel term. The GLSL call uses float f0 and v_dot_h."""

    evaluate: Callable[[ArrayLike, ArrayLike], Float]  # float64 reference; checks the domain
    # float32 error bounds, relative and absolute, as a function of f0 and V.H.
    rounding: Callable[[Float, Float], tuple[Float | float, Float | float]]
    exactness: int  # rank; a plan may replace a term by terms of equal or lower rank
    prefix = "FR_FRESNEL_"


def _check_f0(f0: ArrayLike) -> Float:
    value = np.asarray(f0, dtype=np.float64)
    inside = (value >= 0.0) & (value < 1.0)
    if not inside.all():
        raise InputError(f"f0 = {value[~inside].flat[0]:g} is outside [0, 1): give 0.028 for skin")
    return value


def fresnel_schlick(f0: ArrayLike, v_dot_h: ArrayLike) -> Float:
    """Return Schlick's Fresnel reflectance f0 + (1 - f0)(1 - V.H)^5, in [0, 1].

    Parameters
    ----------
    f0 : reflectance at normal incidence, in [0, 1)
    v_dot_h : cosine of the angle between the direction to the camera and the unit half vector;
        clamped to [0, 1]

    References: Schlick (1994), eq. 15.
    """
    base = _check_f0(f0)
    u = np.clip(1.0 - np.asarray(v_dot_h, dtype=np.float64), 0.0, 1.0)
    return np.asarray(base + (1.0 - base) * u**5)


def fresnel_dielectric(f0: ArrayLike, v_dot_h: ArrayLike) -> Float:
    """Return the exact Fresnel reflectance of a dielectric in air for unpolarised light, in [0, 1].

    For the parameters and exceptions see :func:`fresnel_schlick`. The index of refraction is
    (1 + sqrt(f0)) / (1 - sqrt(f0)).

    References: Cook and Torrance (1982).
    """
    root = np.sqrt(_check_f0(f0))
    q = 4.0 * root / (1.0 - root) ** 2  # eta^2 - 1.
    c = np.clip(np.asarray(v_dot_h, dtype=np.float64), 0.0, 1.0)
    g = np.sqrt(q + c**2)  # eta times the cosine of the angle of refraction.
    # Amplitudes (c - g)/(c + g) and (eta^2 c - g)/(eta^2 c + g): with c - g = -q/(c + g) no digits
    # cancel. At c = 0 and f0 = 0 both amplitudes are 0/0; their limit for c > 0 is 0.
    total = np.maximum(c + g, 1e-300)
    s = q / total / total
    p = q * (c - 1.0 / total) / np.maximum((1.0 + q) * c + g, 1e-300)
    return np.asarray(np.where(c + g > 0.0, 0.5 * (s**2 + p**2), 0.0))


FRESNEL: dict[str, Fresnel] = registry(
    Fresnel(
        name="schlick",
        number=0,
        file="fresnel/schlick",
        call="fr_fresnel_schlick(f0, v_dot_h)",
        evaluate=fresnel_schlick,
        rounding=lambda f0, v_dot_h: (8.0 * ULP, 8.0 * ULP),
        exactness=1,
    ),
    Fresnel(
        name="dielectric",
        number=1,
        file="fresnel/dielectric",
        call="fr_fresnel_dielectric(f0, v_dot_h)",
        evaluate=fresnel_dielectric,
        # Square root, division and square: 10 ulp. The cancellation in c (g + c) - 1 causes an
        # absolute error.
        rounding=lambda f0, v_dot_h: (16.0 * ULP, 16.0 * ULP * f0),
        exactness=2,
    ),
    Fresnel(
        name="constant",
        number=2,
        file="constants",
        call="f0",
        evaluate=lambda f0, c: np.broadcast_to(_check_f0(f0), np.broadcast(f0, c).shape),
        rounding=lambda f0, v_dot_h: (0.0, 0.0),
        exactness=0,
    ),
)


def fresnel(f0: ArrayLike, v_dot_h: ArrayLike, kind: str = "schlick") -> Float:
    """Return the reflectance of the Fresnel term `kind`; "constant" returns f0."""
    return named("Fresnel term", FRESNEL, kind).evaluate(f0, v_dot_h)


MIN_COSINE = 1e-6  # Value of FR_MIN_COSINE in shaders/facerender/constants.glsl.


@dataclass(frozen=True, eq=False, kw_only=True)
class Masking(Entry):
    """A masking term. The GLSL call uses float n_dot_h, h_dot_h, n_dot_l and n_dot_v for h = l + v,
    not normalised, and returns a vec2 (x, y) with G/((N.L)(N.V)) = x/(y h_dot_h)."""

    cut: float = 0.0  # the BRDF is exactly 0 if N.L or N.V is at most this cosine
    # G in float64 as a function of n_dot_h, v_dot_h, n_dot_l, n_dot_v, for a unit half vector.
    evaluate: Callable[[Float, Float, Float, Float], Float]
    prefix = "FR_MASKING_"


def masking_v_cavity(
    n_dot_h: ArrayLike, v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike
) -> Float:
    """Return the masking term of V-shaped cavities, min(1, 2 N.H N.V/V.H, 2 N.H N.L/V.H), in
    [0, 1].

    Parameters
    ----------
    n_dot_h, v_dot_h : N.H and V.H > 0 for a half vector H of any length
    n_dot_l, n_dot_v : N.L and N.V for the directions L to the light and V to the camera, in (0, 1]

    References: Torrance and Sparrow (1967); Cook and Torrance (1982).
    """
    ratio = 2.0 * np.asarray(n_dot_h, dtype=np.float64) / np.asarray(v_dot_h, dtype=np.float64)
    return np.asarray(np.minimum(1.0, ratio * np.minimum(n_dot_l, n_dot_v)))


def masking_kelemen(v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike) -> Float:
    """Return Kelemen masking (N.L)(N.V)/(V.H)², which cancels (N.L)(N.V) in the BRDF's divisor.

    The value is between 0.5 and 1 times :func:`masking_v_cavity`.

    Parameters
    ----------
    v_dot_h : cosine of the angle between the direction to the camera and the unit half vector; at
        least (N.L + N.V)/2, a condition that all unit vectors meet
    n_dot_l, n_dot_v : N.L and N.V for the directions L to the light and V to the camera, in (0, 1]

    References: Kelemen and Szirmay-Kalos (2001); for skin: d'Eon and Luebke (2007), GPU Gems 3,
    chapter 14.
    """
    product = np.multiply(n_dot_l, n_dot_v, dtype=np.float64)
    return np.asarray(product / np.asarray(v_dot_h, dtype=np.float64) ** 2)


MASKING: dict[str, Masking] = registry(
    Masking(
        name="v-cavity",
        number=0,
        file="masking/v_cavity",
        call="fr_masking_v_cavity_ratio(n_dot_h, h_dot_h, n_dot_l, n_dot_v)",
        evaluate=masking_v_cavity,
    ),
    Masking(
        name="kelemen",
        number=1,
        file="masking/kelemen",
        call="fr_masking_kelemen_ratio(n_dot_l, n_dot_v)",
        cut=MIN_COSINE,
        evaluate=lambda n_dot_h, *cosines: masking_kelemen(*cosines),
    ),
    Masking(
        name="none",
        number=2,
        file="constants",
        call="vec2("
        "min(n_dot_l, n_dot_v) > FR_MIN_COSINE ? h_dot_h : 0.0, abs(n_dot_l * n_dot_v) + FR_FLOOR)",
        cut=MIN_COSINE,
        evaluate=lambda n_dot_h, *cosines: np.ones_like(n_dot_h),
    ),
)


MAP_DEVIATION, MAP_SHARE = 0.35, 0.5  # FR_MAP_DEVIATION, and default of FR_MAP_SHARE.
MAX_RADIUS = 20.0  # Largest angular radius of a disc light, in degrees.
_LEAST_V_DOT_H2 = 0.05


def slope_filtered(m: ArrayLike, variance: ArrayLike) -> Float:
    """Return m after adding unresolved slope variance, clamped to [1e-4, 2].

    Parameters
    ----------
    m : RMS slope of the microfacets, in [0, 2]
    variance : unresolved slope variance, >= 0; broadcasts with m
    """
    slope = np.asarray(m, dtype=np.float64)
    return np.clip(np.sqrt(slope**2 + 2.0 * np.asarray(variance)), SLOPES.low, SLOPES.high)


def slope_variance_map(alpha: ArrayLike) -> Float:
    """Return the slope variance that alpha, in [0, 1], encodes in a prepared normal map."""
    return np.asarray(MAP_SHARE * (MAP_DEVIATION * np.asarray(alpha, dtype=np.float64)) ** 2)


def slope_variance_disc(s: ArrayLike, k: ArrayLike, v_dot_h: ArrayLike) -> Float:
    """Return the slope variance that represents the extent of a disc light.

    Parameters
    ----------
    s, k : sin R and (1 + cos R)/2 for the angle R between the centre and the rim of the disc, at
        most 20 degrees
    v_dot_h : cosine of the angle between the direction to the camera and the unit half vector, in
        [0, 1]; broadcasts with s and k
    """
    width = np.asarray(s, dtype=np.float64) / np.asarray(k, dtype=np.float64)
    along = np.maximum(np.asarray(v_dot_h, dtype=np.float64) ** 2, _LEAST_V_DOT_H2)
    return np.asarray(width**2 / 32.0 * (1.0 + 1.0 / along))


def cosine_disc(c: ArrayLike, s: ArrayLike, k: ArrayLike) -> Float:
    """Return the mean of max(N.L, 0) over the directions of a disc light.

    Parameters
    ----------
    c : N.L of the centre of the disc, in [-1, 1]
    s, k : see :func:`slope_variance_disc`; broadcast with c
    """
    cosine, sine = np.asarray(c, dtype=np.float64), np.asarray(s, dtype=np.float64)
    part = np.maximum(cosine + sine, 0.0) ** 2 / (4.0 * np.maximum(sine, 1e-300))
    return np.where(cosine >= sine, cosine, part) * np.asarray(k, dtype=np.float64)


K_COOK_TORRANCE = 4
K_WARD = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Model(Entry):
    """A specular model. The GLSL call uses vec3 n, l, v, float f0, and placeholders: ``{m}`` for
    the slope, ``{lobe}``, ``{fresnel}`` and ``{masking}`` for the macros of the terms."""

    title: str  # name of the model in texts
    k: int  # power of 1/cos γ in the lobe
    # float64 reference as a function of n, l, v, m and ``lobe``; checks the domain. If ``factors``
    # is true, f0 follows m, and ``fresnel_term`` and ``masking_term`` are further parameters. If
    # ``factors`` is false, the result excludes the factor f0 of the GLSL call.
    evaluate: Callable[..., Float]
    factors: bool = False  # whether the model has a Fresnel term and a masking term
    # Name of a group of models that agree if the directions to the light and to the camera equal
    # the normal; a plan may replace a model by another model of its family.
    family: str
    printed: str = ""  # GLSL call of the formula as published by Romanyuk et al. (2020)
    # Entry of the model with two lobes; its call also uses ``{second}``, the second slope, and
    # float lobe_weight. None if the weighted mean of two calls costs the same.
    two: Entry | None = None
    # Entry whose call computes the radiance (vec3) that the exact lobe reflects from
    # ``environment_map``. The call uses environment_size and the variables of the model except l
    # and ``{lobe}``. None if not implemented: there is then no specular environment light.
    environment: Entry | None = None


def checked_unit(name: str, vectors: ArrayLike) -> Float:
    """Return vectors (..., 3) as float64, or raise InputError if one is not a unit vector."""
    array = np.asarray(vectors, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(f"{name} has shape {array.shape}: its last axis must hold x, y, z")
    length = np.sqrt(dot(array, array))
    if not (np.abs(length - 1.0) <= 1e-5).all():
        worst = length.flat[np.argmax(np.abs(length - 1.0))]
        raise InputError(f"{name} holds a vector of length {worst:g}: give unit vectors")
    return array


def dot(a: Float, b: Float) -> Float:
    """Return the dot products of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i", a, b))  # Six times as fast as (a * b).sum(axis=-1).


class _Geometry:
    """Cosines that the BRDFs share; all 1 where the BRDF is 0, so that no divisor is 0."""

    def __init__(
        self, n: ArrayLike, l: ArrayLike, v: ArrayLike, cut: float, product: float = 0.0
    ) -> None:
        normal, light, eye = checked_unit("n", n), checked_unit("l", l), checked_unit("v", v)
        half = light + eye
        n_dot_l, n_dot_v, n_dot_h = dot(normal, light), dot(normal, eye), dot(normal, half)
        self.above = (np.minimum(n_dot_l, n_dot_v) > cut) & (n_dot_l * n_dot_v > product)
        length = np.where(self.above, np.sqrt(dot(half, half)), 1.0)
        self.n_dot_l = np.where(self.above, n_dot_l, 1.0)
        self.n_dot_v = np.where(self.above, n_dot_v, 1.0)
        self.n_dot_h = np.minimum(np.where(self.above, n_dot_h / length, 1.0), 1.0)
        self.v_dot_h = np.where(self.above, 0.5 * length, 1.0)  # |l + v| = 2 V.H.
        # 1 - c^2 would lose the digits of small angles; the cross product keeps them.
        cross = np.cross(normal, half)
        self.tan2 = np.where(self.above, dot(cross, cross), 0.0) / (self.n_dot_h * length) ** 2

    def lobe(self, lobe: AnyLobe, m: ArrayLike, k: int) -> Float:
        entry = lobe_entry(lobe)
        if entry.of_tan2 is not None:
            return entry.of_tan2(self.tan2, m, k)
        return entry.evaluate(self.n_dot_h, m, k)


def cook_torrance(
    n: ArrayLike,
    l: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    f0: ArrayLike,
    *,
    lobe: AnyLobe = "exact",
    fresnel_term: str = "schlick",
    masking_term: str = "v-cavity",
) -> Float:
    """Return the Cook-Torrance specular BRDF F G D/(π (N.L)(N.V)), D = E/(4 m² c⁴), in 1/sr.

    Parameters
    ----------
    n, l, v : unit vectors (..., 3): normal, direction to the light, direction to the camera
    m : roughness: RMS slope of the microfacets, in the domain of the lobe; broadcasts with the
        leading axes of the directions
    f0 : Fresnel reflectance at normal incidence, in [0, 1); 0.028 for skin
    lobe : name of the lobe, or a GPower
    fresnel_term : "schlick", "dielectric", or "constant" for f0
    masking_term : "v-cavity", "kelemen", or "none" for G = 1, where the BRDF grows as 1/(N.V)

    References: Cook and Torrance (1982); Walter et al. (2007) for the normalisation.
    """
    masking = named("masking term", MASKING, masking_term)
    geometry = _Geometry(n, l, v, masking.cut)
    f = fresnel(f0, geometry.v_dot_h, fresnel_term)
    g = masking.evaluate(geometry.n_dot_h, geometry.v_dot_h, geometry.n_dot_l, geometry.n_dot_v)
    d = geometry.lobe(lobe, m, K_COOK_TORRANCE) / (4.0 * np.asarray(m, dtype=np.float64) ** 2)
    return np.where(geometry.above, f * g * d / (np.pi * geometry.n_dot_l * geometry.n_dot_v), 0.0)


def cook_torrance_two(
    n: ArrayLike,
    l: ArrayLike,
    v: ArrayLike,
    m0: ArrayLike,
    m1: ArrayLike,
    weight: ArrayLike,
    f0: ArrayLike,
    *,
    lobe: AnyLobe = "exact",
    fresnel_term: str = "schlick",
    masking_term: str = "v-cavity",
) -> Float:
    """Return the Cook-Torrance specular BRDF with two lobes, in 1/sr.

    The formula is F G (w D(m0) + (1 - w) D(m1))/(π (N.L)(N.V)).

    For the other parameters and the exceptions see :func:`cook_torrance`.

    Parameters
    ----------
    m0, m1 : RMS slopes of the two lobes, in the domain of the lobe
    weight : fraction w of the first lobe, in [0, 1]
    """
    w = np.asarray(weight, dtype=np.float64)
    check_range("weight", float(w.min()), 0.0, 1.0)
    check_range("weight", float(w.max()), 0.0, 1.0)
    terms: Any = {"lobe": lobe, "fresnel_term": fresnel_term, "masking_term": masking_term}
    first, second = (cook_torrance(n, l, v, m, f0, **terms) for m in (m0, m1))
    return w * first + (1.0 - w) * second


def ward(
    n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, *, lobe: AnyLobe = "exact"
) -> Float:
    """Return Ward's isotropic specular BRDF E/(4 π m² sqrt((N.L)(N.V))), in 1/sr.

    For the parameters and exceptions see :func:`cook_torrance`; m is Ward's alpha.

    References: Ward (1992), eq. 4.
    """
    geometry = _Geometry(n, l, v, 0.0, MIN_COSINE**2)
    scale = 4.0 * np.pi * np.asarray(m, dtype=np.float64) ** 2
    value = geometry.lobe(lobe, m, K_WARD) / (scale * np.sqrt(geometry.n_dot_l * geometry.n_dot_v))
    return np.where(geometry.above, value, 0.0)


def ward_printed(
    n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, *, lobe: AnyLobe = "exact"
) -> Float:
    """Return Ward's BRDF as published by Romanyuk et al. (2020), in 1/sr.

    The formula is E/(4 π m² sqrt(N.V + L.H)). The function serves only to reproduce the paper: the
    BRDF is not reciprocal, and at normal incidence it is 0.707 times Ward's BRDF. For the
    parameters and exceptions see :func:`cook_torrance`.
    """
    geometry = _Geometry(n, l, v, 0.0, MIN_COSINE**2)
    scale = 4.0 * np.pi * np.asarray(m, dtype=np.float64) ** 2
    value = geometry.lobe(lobe, m, K_WARD) / (scale * np.sqrt(geometry.n_dot_v + geometry.v_dot_h))
    return np.where(geometry.above, value, 0.0)


MODELS: dict[str, Model] = registry(
    Model(
        name="cook-torrance",
        title="Cook-Torrance",
        file="cook_torrance",
        call="fr_cook_torrance_terms(n, l, v, {m}, f0, {lobe}, {fresnel}, {masking})",
        k=K_COOK_TORRANCE,
        evaluate=cook_torrance,
        factors=True,
        family="physical",
        printed="fr_printed_cook_torrance(n, l, v, m, f0)",
        two=Entry(
            name="cook-torrance-two",
            file="cook_torrance_two",
            call="fr_cook_torrance_two_terms("
            "n, l, v, {m}, {second}, lobe_weight, f0, {lobe}, {fresnel}, {masking})",
        ),
        environment=Entry(
            name="cook-torrance-environment",
            file="environment",
            call="fr_environment_cook_torrance("
            "environment_map, environment_size, n, v, {m}, f0, {fresnel}, {masking})",
        ),
    ),
    Model(
        name="ward",
        title="Ward",
        file="ward",
        call="f0 * fr_ward_terms(n, l, v, {m}, {lobe})",
        k=K_WARD,
        evaluate=ward,
        family="physical",
        printed="fr_printed_ward(n, l, v, m)",
        environment=Entry(
            name="ward-environment",
            file="environment",
            call="f0 * fr_environment_ward(environment_map, environment_size, n, v, {m})",
        ),
    ),
    Model(
        name="ward-printed",
        title="Ward as printed",
        file="ward_printed",
        call="f0 * fr_ward_printed_terms(n, l, v, {m}, {lobe})",
        k=K_WARD,
        evaluate=ward_printed,
        family="printed",
    ),
)
