"""What a pixel, a texel or the size of a light leaves unresolved, as slopes of microfacets: the
float64 twin of ``shaders/facerender/slope_variance.glsl``. Variances are of slopes, along each of
two axes; those of independent slopes add."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE

Float = NDArray[np.float64]

MAP_DEVIATION, MAP_SHARE = 0.35, 0.5  # FR_MAP_DEVIATION, FR_MAP_SHARE
MAX_PIXEL_VARIANCE = 0.1  # FR_MAX_PIXEL_VARIANCE
MAX_RADIUS = 20.0  # degrees, of a disc
_LEAST_V_DOT_H2 = 0.05


def slope_filtered(m: ArrayLike, variance: ArrayLike) -> Float:
    """Return the slope that stands for m together with slopes of a variance, from 1e-4 to 2.

    Parameters
    ----------
    m : rms slope of the microfacets, in [0, 2]
    variance : of what is unresolved, >= 0; broadcasts with m
    """
    slope = np.asarray(m, dtype=np.float64)
    return np.clip(np.sqrt(slope**2 + 2.0 * np.asarray(variance)), MIN_SLOPE, MAX_SLOPE)


def slope_variance_map(alpha: ArrayLike) -> Float:
    """Return the variance by which a prepared normal map's alpha, in [0, 1], widens the lobe."""
    return np.asarray(MAP_SHARE * (MAP_DEVIATION * np.asarray(alpha, dtype=np.float64)) ** 2)


def slope_variance_pixel(n_x: ArrayLike, n_y: ArrayLike) -> Float:
    """Return the variance of a curved mesh over a pixel, at most 0.1.

    Parameters
    ----------
    n_x, n_y : (..., 3), how much the unit normal changes from a pixel to the next
    """
    x, y = np.asarray(n_x, dtype=np.float64), np.asarray(n_y, dtype=np.float64)
    variance = ((x * x).sum(axis=-1) + (y * y).sum(axis=-1)) / 24.0
    return np.asarray(np.minimum(variance, MAX_PIXEL_VARIANCE))


def slope_variance_disc(s: ArrayLike, k: ArrayLike, v_dot_h: ArrayLike) -> Float:
    """Return the variance that a light of the shape of a disc adds.

    Parameters
    ----------
    s, k : sin R and (1 + cos R)/2 of the angle R between the disc's centre and its rim, which is
        at most 20 degrees
    v_dot_h : cosine of eye and unit half vector, in [0, 1]; broadcasts with these
    """
    width = np.asarray(s, dtype=np.float64) / np.asarray(k, dtype=np.float64)
    along = np.maximum(np.asarray(v_dot_h, dtype=np.float64) ** 2, _LEAST_V_DOT_H2)
    return np.asarray(width**2 / 32.0 * (1.0 + 1.0 / along))


def cosine_disc(c: ArrayLike, s: ArrayLike, k: ArrayLike) -> Float:
    """Return the mean of max(N.L, 0) over the directions of a disc.

    Parameters
    ----------
    c : N.L of its centre, in [-1, 1]
    s, k : as of :func:`slope_variance_disc`; broadcast with c
    """
    cosine, sine = np.asarray(c, dtype=np.float64), np.asarray(s, dtype=np.float64)
    above = np.maximum(cosine + sine, 0.0)
    part = above**2 / (4.0 * np.maximum(sine, 1e-300))
    return np.where(cosine >= sine, cosine, part) * np.asarray(k, dtype=np.float64)
