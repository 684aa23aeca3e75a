"""Slope variance of unresolved detail: the float64 reference for
``shaders/facerender/slope_variance.glsl``.

A slope variance is the variance of the slopes along each tangent axis. Variances of independent
slopes add."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE

Float = NDArray[np.float64]

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
    return np.clip(np.sqrt(slope**2 + 2.0 * np.asarray(variance)), MIN_SLOPE, MAX_SLOPE)


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
    above = np.maximum(cosine + sine, 0.0)
    part = above**2 / (4.0 * np.maximum(sine, 1e-300))
    return np.where(cosine >= sine, cosine, part) * np.asarray(k, dtype=np.float64)
