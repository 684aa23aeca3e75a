"""The one-dimensional lobe E/c^k and its approximations, in float64: the reference for
``shaders/facerender/lobe``. BRDFs are in ``brdf.py``; nothing here knows vectors or OpenGL.

Both models need the same function, the slope factor E = exp(-tan² γ / m²) over a power of
c = cos γ: k = 4 in Cook-Torrance, k = 0 in Ward. Every function here has its peak, 1, at c = 1;
the model multiplies by its scale. ``lobes.f`` is ``fr_lobe_f`` in GLSL.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError

Lobe = Literal["exact", "cosine", "d4", "d8", "d16"]

NAMES: tuple[Lobe, ...] = ("exact", "cosine", "d4", "d8", "d16")
MIN_SLOPE = 1e-4
MAX_SLOPE = 2.0
_POWERS = {"d4": 4, "d8": 8, "d16": 16}
_MODELS = {4: "Cook-Torrance", 0: "Ward"}


def max_slope(name: str, k: int) -> float:
    """Return the upper end of a lobe's domain of m.

    It is excluded for the approximations: their exponent n = 2/m² - k must be positive.
    """
    if name == "exact" or k == 0:
        return MAX_SLOPE
    return math.sqrt(2.0 / k)


def check_slope(m: ArrayLike, name: str, k: int) -> NDArray[np.float64]:
    """Return m as float64, or raise InputError when a value lies outside the lobe's domain."""
    if k not in _MODELS:
        raise InputError(f"k = {k} is neither 4 (Cook-Torrance) nor 0 (Ward)")
    slope = np.asarray(m, dtype=np.float64)
    end = max_slope(name, k)
    inside = (slope >= MIN_SLOPE) & ((slope <= end) if end == MAX_SLOPE else (slope < end))
    if not inside.all():
        value = slope[~inside].flat[0]
        bracket = "]" if end == MAX_SLOPE else ")"
        remedy = "" if end == MAX_SLOPE else ", or use the lobe exact"
        raise InputError(
            f"m = {value:g} is outside the domain of lobe {name} for {_MODELS[k]}: "
            f"give m in [{MIN_SLOPE:g}, {end:.4g}{bracket}{remedy}"
        )
    return slope


def _check_cosine(c: ArrayLike) -> NDArray[np.float64]:
    cosine = np.asarray(c, dtype=np.float64)
    inside = (cosine >= 0.0) & (cosine <= 1.0)
    if not inside.all():
        raise InputError(f"cosine {cosine[~inside].flat[0]:g} is outside [0, 1]")
    return cosine


def _exact(tan2: NDArray[np.floating], m: NDArray[np.float64], k: int) -> NDArray[np.float64]:
    # A relative error e of the exponent x becomes e x in the result, and x reaches 690 before
    # the result leaves float64: extended precision, where the platform has it, keeps 1e-13.
    exponent = tan2 / np.asarray(m, dtype=np.longdouble) ** 2
    exponent = np.minimum(exponent, 1e4)  # exp(-1e4) is 0, and infinity - infinity is not
    head = exponent.astype(np.float64)
    tail = (exponent - head).astype(np.float64)
    slope_factor = np.exp(-head) * np.exp(-tail)
    sec2 = 1.0 + np.minimum(tan2, 1e100).astype(np.float64)  # E is 0 long before
    return np.asarray(slope_factor * sec2 ** (k // 2), dtype=np.float64)


def exact_tan2(tan2: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate E/c^k from the squared tangent of the angle between normal and half vector.

    Parameters
    ----------
    tan2 : tan² γ, >= 0, infinity allowed; any shape
    m : rms slope of the microfacets, in [1e-4, 2]; broadcasts with tan2
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : tan2 or m outside its domain

    References: Beckmann and Spizzichino (1963); Cook and Torrance (1982); Ward (1992), eq. 4.
    """
    slope = check_slope(m, "exact", k)
    t = np.asarray(tan2, dtype=np.float64)
    if not (t >= 0.0).all():
        raise InputError(f"tan2 = {t[~(t >= 0.0)].flat[0]:g} is negative or not a number")
    return _exact(t.astype(np.longdouble), slope, k)


def exact(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate E/c^k from the cosine of the angle between normal and half vector.

    Relative error at most 1e-13 where the result is above 1e-300 and ``numpy.longdouble`` has 64
    bits of mantissa or more; 5e-13 elsewhere.

    Parameters
    ----------
    c : cos γ, in [0, 1]; any shape
    m : rms slope of the microfacets, in [1e-4, 2]; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : c or m outside its domain
    """
    slope = check_slope(m, "exact", k)
    x = _check_cosine(c).astype(np.longdouble)
    with np.errstate(divide="ignore"):
        tan2 = (1.0 - x) * (1.0 + x) / (x * x)
    return _exact(tan2, slope, k)


def cosine(c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Approximate E/c^k by c^n, n = 2/m² - k.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    m : rms slope, in [1e-4, sqrt(2/k)), at most 2; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward

    Raises
    ------
    InputError : c or m outside its domain

    References: Romanyuk et al. (2020), section 3.
    """
    slope = check_slope(m, "cosine", k)
    return np.asarray(_check_cosine(c) ** (2.0 / slope**2 - k), dtype=np.float64)


def g_power(c: ArrayLike, m: ArrayLike, k: int, g: int) -> NDArray[np.float64]:
    """Approximate E/c^k by one clamped linear factor to the power g, max((n/g)(c - 1) + 1, 0)^g.

    Parameters
    ----------
    c : cosine of the angle between normal and half vector, in [0, 1]; any shape
    m : rms slope, in [1e-4, sqrt(2/k)), at most 2; broadcasts with c
    k : 4 for Cook-Torrance, 0 for Ward
    g : 4, 8 or 16

    Raises
    ------
    InputError : c, m or g outside its domain

    References: Romanyuk et al. (2020), D4, D8, D16; Lyon (1993) for the clamp.
    """
    if g not in _POWERS.values():
        raise InputError(f"g = {g} is none of {', '.join(map(str, _POWERS.values()))}")
    n = 2.0 / check_slope(m, f"d{g}", k) ** 2 - k
    return np.asarray(np.maximum(n / g * (_check_cosine(c) - 1.0) + 1.0, 0.0) ** g)


def lobe(name: Lobe, c: ArrayLike, m: ArrayLike, k: int) -> NDArray[np.float64]:
    """Evaluate the named lobe; parameters as in :func:`exact` and the function of that name."""
    if name == "exact":
        return exact(c, m, k)
    if name == "cosine":
        return cosine(c, m, k)
    if name not in _POWERS:
        raise InputError(f"unknown lobe {name!r}; known: {', '.join(NAMES)}")
    return g_power(c, m, k, _POWERS[name])
