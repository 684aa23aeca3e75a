"""Cook-Torrance, Ward, Fresnel and masking in float64: the reference for the BRDFs of
``shaders/facerender``. ``brdf.f`` is ``fr_f`` in GLSL, with the same arguments in the same order.

Directions are arrays of shape (..., 3) that broadcast against one another: ``n`` the normal, ``l``
towards the light, ``v`` towards the eye, unit vectors. BRDFs are in 1/sr, without N.L, for a
specular weight of 1, and exactly 0 where N.L or N.V is not above 1e-6, as in the shaders.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender import lobes
from facerender.errors import InputError
from facerender.lobes import AnyLobe

Fresnel = Literal["schlick", "dielectric", "constant"]
Masking = Literal["v-cavity", "kelemen", "none"]

K_COOK_TORRANCE = 4
K_WARD = 0
MIN_COSINE = 1e-6  # FR_MIN_COSINE of shaders/facerender/constants.glsl


def _check_f0(f0: ArrayLike) -> NDArray[np.float64]:
    value = np.asarray(f0, dtype=np.float64)
    inside = (value >= 0.0) & (value < 1.0)
    if not inside.all():
        raise InputError(f"f0 = {value[~inside].flat[0]:g} is outside [0, 1); skin: 0.028")
    return value


def _unit(name: str, vectors: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(vectors, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise InputError(f"{name} has shape {array.shape}: its last axis must hold x, y, z")
    length = np.sqrt(_dot(array, array))
    if not (np.abs(length - 1.0) <= 1e-5).all():
        worst = length.flat[np.argmax(np.abs(length - 1.0))]
        raise InputError(f"{name} holds a vector of length {worst:g}: give unit vectors")
    return array


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.einsum("...i,...i", a, b))  # six times as fast as a sum


def fresnel_schlick(f0: ArrayLike, v_dot_h: ArrayLike) -> NDArray[np.float64]:
    """Approximate Fresnel reflectance, f0 + (1 - f0)(1 - V.H)^5, in [0, 1].

    Parameters
    ----------
    f0 : reflectance at normal incidence, in [0, 1)
    v_dot_h : cosine between eye and unit half vector, clamped to [0, 1]

    Raises
    ------
    InputError : f0 outside its domain

    References: Schlick (1994), eq. 15.
    """
    base = _check_f0(f0)
    u = np.clip(1.0 - np.asarray(v_dot_h, dtype=np.float64), 0.0, 1.0)
    return np.asarray(base + (1.0 - base) * u**5)


def fresnel_dielectric(f0: ArrayLike, v_dot_h: ArrayLike) -> NDArray[np.float64]:
    """Exact Fresnel reflectance of a dielectric in air for unpolarised light, in [0, 1].

    Parameters and errors as in :func:`fresnel_schlick`; the index of refraction is
    (1 + sqrt(f0)) / (1 - sqrt(f0)).

    References: Cook and Torrance (1982).
    """
    root = np.sqrt(_check_f0(f0))
    q = 4.0 * root / (1.0 - root) ** 2  # eta^2 - 1
    c = np.clip(np.asarray(v_dot_h, dtype=np.float64), 0.0, 1.0)
    g = np.sqrt(q + c**2)  # eta times the cosine of the refracted ray
    # (c - g)/(c + g) and (eta^2 c - g)/(eta^2 c + g), with c - g = -q/(c + g): nothing cancels. At
    # c = 0 and f0 = 0 both are 0/0; the limit from c > 0 is no reflection.
    total = np.maximum(c + g, 1e-300)
    s = q / total / total
    p = q * (c - 1.0 / total) / np.maximum((1.0 + q) * c + g, 1e-300)
    return np.asarray(np.where(c + g > 0.0, 0.5 * (s**2 + p**2), 0.0))


def fresnel(f0: ArrayLike, v_dot_h: ArrayLike, kind: Fresnel = "schlick") -> NDArray[np.float64]:
    """Evaluate the named Fresnel term; "constant" is f0 itself."""
    if kind == "schlick":
        return fresnel_schlick(f0, v_dot_h)
    if kind == "dielectric":
        return fresnel_dielectric(f0, v_dot_h)
    if kind == "constant":
        return np.broadcast_to(_check_f0(f0), np.broadcast(f0, v_dot_h).shape)
    raise InputError(f"unknown Fresnel term {kind!r}; known: schlick, dielectric, constant")


def masking_v_cavity(
    n_dot_h: ArrayLike, v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike
) -> NDArray[np.float64]:
    """Masking and shadowing by V-shaped cavities, min(1, 2 N.H N.V/V.H, 2 N.H N.L/V.H), in [0, 1].

    Parameters
    ----------
    n_dot_h, v_dot_h : cosines with the half vector (of any length), v_dot_h > 0
    n_dot_l, n_dot_v : cosines of light and eye, in (0, 1]

    References: Torrance and Sparrow (1967); Cook and Torrance (1982).
    """
    ratio = 2.0 * np.asarray(n_dot_h, dtype=np.float64) / np.asarray(v_dot_h, dtype=np.float64)
    return np.asarray(np.minimum(1.0, ratio * np.minimum(n_dot_l, n_dot_v)))


def masking_kelemen(
    v_dot_h: ArrayLike, n_dot_l: ArrayLike, n_dot_v: ArrayLike
) -> NDArray[np.float64]:
    """Approximate masking and shadowing by (N.L)(N.V)/(V.H)², which cancels the BRDF's divisor;
    from half of :func:`masking_v_cavity` to all of it.

    Parameters
    ----------
    v_dot_h : cosine of eye and unit half vector, at least (N.L + N.V)/2 as of any directions
    n_dot_l, n_dot_v : cosines of light and eye, in (0, 1]

    References: Kelemen and Szirmay-Kalos (2001); for skin: d'Eon and Luebke (2007), GPU Gems 3,
    chapter 14.
    """
    product = np.multiply(n_dot_l, n_dot_v, dtype=np.float64)
    return np.asarray(product / np.asarray(v_dot_h, dtype=np.float64) ** 2)


class _Geometry:
    """The cosines that the BRDFs share; placeholders of 1 where the result is 0."""

    def __init__(self, n: ArrayLike, l: ArrayLike, v: ArrayLike) -> None:
        normal, light, eye = _unit("n", n), _unit("l", l), _unit("v", v)
        half = light + eye
        n_dot_l, n_dot_v, n_dot_h = _dot(normal, light), _dot(normal, eye), _dot(normal, half)
        self.above = (n_dot_l > MIN_COSINE) & (n_dot_v > MIN_COSINE)
        length = np.where(self.above, np.sqrt(_dot(half, half)), 1.0)
        self.n_dot_l = np.where(self.above, n_dot_l, 1.0)
        self.n_dot_v = np.where(self.above, n_dot_v, 1.0)
        self.n_dot_h = np.minimum(np.where(self.above, n_dot_h / length, 1.0), 1.0)
        self.v_dot_h = np.where(self.above, 0.5 * length, 1.0)  # |l + v| = 2 V.H
        # From the cross product: 1 - c^2 would lose the digits of a small angle.
        cross = np.cross(normal, half)
        self.tan2 = np.where(self.above, _dot(cross, cross), 0.0) / (self.n_dot_h * length) ** 2

    def masking(self, kind: Masking) -> NDArray[np.float64]:
        if kind == "v-cavity":
            return masking_v_cavity(self.n_dot_h, self.v_dot_h, self.n_dot_l, self.n_dot_v)
        if kind == "kelemen":
            return masking_kelemen(self.v_dot_h, self.n_dot_l, self.n_dot_v)
        if kind == "none":
            return np.ones_like(self.n_dot_h)
        raise InputError(f"unknown masking term {kind!r}; known: v-cavity, kelemen, none")

    def lobe(self, name: AnyLobe, m: ArrayLike, k: int) -> NDArray[np.float64]:
        if name == "exact":
            return lobes.exact_tan2(self.tan2, m, k)
        return lobes.lobe(name, self.n_dot_h, m, k)


def cook_torrance(
    n: ArrayLike,
    l: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    f0: ArrayLike,
    *,
    lobe: AnyLobe = "exact",
    fresnel_term: Fresnel = "schlick",
    masking_term: Masking = "v-cavity",
) -> NDArray[np.float64]:
    """Cook-Torrance specular BRDF F G D/(π (N.L)(N.V)), D = E/(4 m² c⁴), in 1/sr.

    Parameters
    ----------
    n, l, v : unit vectors (..., 3): normal, towards the light, towards the eye
    m : rms slope, in the domain of the lobe; broadcasts with the directions' leading axes
    f0 : Fresnel reflectance at normal incidence, in [0, 1); skin: 0.028
    lobe : name of the lobe, or a GPower
    fresnel_term : "schlick", "dielectric", or "constant": f0
    masking_term : "v-cavity", "kelemen", or "none": 1, with which it grows as 1/(N.V)

    Raises
    ------
    InputError : a vector that is no unit vector, or a value outside its domain

    References: Cook and Torrance (1982); Walter et al. (2007) for the normalisation.
    """
    at = _Geometry(n, l, v)
    f = fresnel(f0, at.v_dot_h, fresnel_term)
    g = at.masking(masking_term)
    d = at.lobe(lobe, m, K_COOK_TORRANCE) / (4.0 * np.asarray(m, dtype=np.float64) ** 2)
    return np.where(at.above, f * g * d / (np.pi * at.n_dot_l * at.n_dot_v), 0.0)


def ward(
    n: ArrayLike,
    l: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    *,
    lobe: AnyLobe = "exact",
) -> NDArray[np.float64]:
    """Ward's isotropic specular BRDF E/(4 π m² sqrt((N.L)(N.V))), in 1/sr.

    Parameters and errors as in :func:`cook_torrance`; m is Ward's alpha.

    References: Ward (1992), eq. 4.
    """
    at = _Geometry(n, l, v)
    scale = 4.0 * np.pi * np.asarray(m, dtype=np.float64) ** 2
    value = at.lobe(lobe, m, K_WARD) / (scale * np.sqrt(at.n_dot_l * at.n_dot_v))
    return np.where(at.above, value, 0.0)


def ward_printed(
    n: ArrayLike,
    l: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    *,
    lobe: AnyLobe = "exact",
) -> NDArray[np.float64]:
    """Ward as Romanyuk et al. (2020) print it, E/(4 π m² sqrt(N.V + L.H)), in 1/sr.

    Not reciprocal, and 0.707 times Ward at normal incidence: it serves to reproduce the paper.
    Parameters and errors as in :func:`cook_torrance`.
    """
    at = _Geometry(n, l, v)
    scale = 4.0 * np.pi * np.asarray(m, dtype=np.float64) ** 2
    value = at.lobe(lobe, m, K_WARD) / (scale * np.sqrt(at.n_dot_v + at.v_dot_h))
    return np.where(at.above, value, 0.0)
