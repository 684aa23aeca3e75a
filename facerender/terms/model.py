"""Specular BRDFs: registry entries and float64 references for the BRDFs of ``shaders/facerender``.

``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order. Directions are unit
vectors (..., 3) that broadcast against one another: ``n`` is the normal, ``l`` the direction to
the light, ``v`` the direction to the camera. BRDFs are in 1/sr, without N.L, for a specular weight
of 1. As in the shaders, BRDFs are exactly 0 if N.L or N.V is at most 0. Cook-Torrance with Kelemen
masking or without masking is also 0 if N.L or N.V is at most 1e-6. Ward is also 0 if (N.L)(N.V) is
at most 1e-12.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_range
from facerender.terms.entry import Entry, named, registry
from facerender.terms.fresnel import fresnel
from facerender.terms.lobe import AnyLobe, lobe_entry
from facerender.terms.masking import MASKING, MIN_COSINE

Float = NDArray[np.float64]

K_COOK_TORRANCE = 4
K_WARD = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Model(Entry):
    """A specular model.

    The GLSL call uses vec3 n, l, v, float f0, and placeholders: ``{m}`` for the slope, ``{lobe}``,
    ``{fresnel}`` and ``{masking}`` for the macros of the terms.

    Attributes
    ----------
    title : name of the model in texts
    k : power of 1/cos γ in the lobe
    evaluate : float64 reference as a function of n, l, v, m and ``lobe``; checks the domain. If
        ``factors`` is true, f0 follows m, and ``fresnel_term`` and ``masking_term`` are further
        parameters. If ``factors`` is false, the result excludes the factor f0 of the GLSL call
    factors : whether the model has a Fresnel term and a masking term
    family : name of a group of models that agree if the directions to the light and to the camera
        equal the normal; a plan may replace a model by another model of its family
    printed : GLSL call of the formula as published by Romanyuk et al. (2020); "" if there is none
    two : entry of the model with two lobes; its call also uses ``{second}``, the second slope, and
        float lobe_weight. None if the weighted mean of two calls costs the same
    environment : entry whose call computes the radiance (vec3) that the exact lobe reflects from
        ``environment_map``. The call uses environment_size and the variables of the model except l
        and ``{lobe}``. None if not implemented: there is then no specular environment light
    """

    title: str
    k: int
    evaluate: Callable[..., Float]
    factors: bool = False
    family: str
    printed: str = ""
    two: Entry | None = None
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

    def masking(self, name: str) -> Float:
        term = named("masking term", MASKING, name)
        return term.evaluate(self.n_dot_h, self.v_dot_h, self.n_dot_l, self.n_dot_v)

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

    Raises
    ------
    InputError : a vector is not a unit vector, or a value is outside its domain

    References: Cook and Torrance (1982); Walter et al. (2007) for the normalisation.
    """
    geometry = _Geometry(n, l, v, named("masking term", MASKING, masking_term).cut)
    f = fresnel(f0, geometry.v_dot_h, fresnel_term)
    g = geometry.masking(masking_term)
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
    first, second = (
        cook_torrance(
            n, l, v, m, f0, lobe=lobe, fresnel_term=fresnel_term, masking_term=masking_term
        )
        for m in (m0, m1)
    )
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
