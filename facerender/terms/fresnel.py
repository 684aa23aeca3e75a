"""Fresnel terms: registry entries and float64 references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError
from facerender.terms.entry import ULP, Entry, named, registry

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Fresnel(Entry):
    """A Fresnel term. The GLSL call uses float f0 and v_dot_h; the macro is FR_FRESNEL_NAME.

    Attributes
    ----------
    number : value of the macro, unique
    evaluate : float64 reference; checks the domain
    rounding : float32 error bounds, relative and absolute, as a function of f0 and V.H
    exactness : rank among Fresnel terms; a plan may replace a term by terms of equal or lower rank
    """

    number: int
    evaluate: Callable[[ArrayLike, ArrayLike], Float]
    rounding: Callable[[Float, Float], tuple[Float | float, Float | float]]
    exactness: int

    @property
    def macro(self) -> str:
        return f"FR_FRESNEL_{self.word}"


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

    Raises
    ------
    InputError : f0 outside its domain

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


def _constant(f0: ArrayLike, v_dot_h: ArrayLike) -> Float:
    return np.broadcast_to(_check_f0(f0), np.broadcast(f0, v_dot_h).shape)


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
        evaluate=_constant,
        rounding=lambda f0, v_dot_h: (0.0, 0.0),
        exactness=0,
    ),
)


def fresnel(f0: ArrayLike, v_dot_h: ArrayLike, kind: str = "schlick") -> Float:
    """Return the reflectance of the Fresnel term `kind`; "constant" returns f0."""
    return named("Fresnel term", FRESNEL, kind).evaluate(f0, v_dot_h)
