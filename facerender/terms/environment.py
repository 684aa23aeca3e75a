"""Environment lighting in float64: the reference for ``shaders/facerender/environment.glsl``.

``scenes/environment.py`` computes the maps and coefficients.

Vectors are arrays of shape (..., 3) that broadcast against one another; m has the shape (...).
``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order. The parameter
``samples`` replaces the macro FR_ENVIRONMENT_SAMPLES.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.terms.lobe import check_slope
from facerender.terms.masking import MIN_COSINE
from facerender.terms.model import K_COOK_TORRANCE, checked_unit, cook_torrance, dot, ward

Float = NDArray[np.float64]

SAMPLES = 32  # Value of FR_ENVIRONMENT_SAMPLES in GLSL.
_COARSEST = 2  # Logarithm (base 2) of the side of the last level in texels.
_NEAR = 1e-3  # Sine of the angle between v and n; for smaller sines the tangent is arbitrary.
_TURN = 1.94161104  # Radians between consecutive sampled slopes: pi over the golden ratio.


def harmonics(n: ArrayLike) -> Float:
    """Return 1, y, z, x, xy, yz, 3 z² - 1, xz, x² - y² of vectors n = (x, y, z), (..., 9)."""
    x, y, z = np.moveaxis(np.asarray(n, dtype=np.float64), -1, 0)
    of_degree_2 = (x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y)
    return np.stack([np.ones_like(x), y, z, x, *of_degree_2], axis=-1)


def environment_irradiance(sh: ArrayLike, n: ArrayLike) -> Float:
    """Return the irradiance (..., 3), at least 0, from nine harmonic coefficients sh (9, 3).

    References: Ramamoorthi and Hanrahan (2001), "An efficient representation for irradiance
    environment maps".
    """
    return np.maximum(harmonics(checked_unit("n", n)) @ np.asarray(sh, dtype=np.float64), 0.0)


def environment_radiance(map: ArrayLike, size: int, l: ArrayLike, solid_angle: ArrayLike) -> Float:
    """Return the mean radiance (..., 3) within a solid angle around each direction.

    Parameters
    ----------
    map : all levels side by side, (size + 2, W, 3), see ``scenes.environment.atlas``
    size : side of the first level in texels, a power of two
    l : unit vectors (..., 3)
    solid_angle : in sr, (...)
    """
    x, y, z = np.moveaxis(np.asarray(l, dtype=np.float64), -1, 0)
    norm = np.abs(x) + np.abs(y) + np.abs(z)
    place = np.stack([x, z], axis=-1) / norm[..., None]
    folded = (1.0 - np.abs(place[..., ::-1])) * np.where(place >= 0.0, 1.0, -1.0)
    place = 0.5 * np.where((y < 0.0)[..., None], folded, place) + 0.5
    texels = np.asarray(solid_angle) * (0.5 * size) ** 2 / norm**3
    last = int(size).bit_length() - 1 - _COARSEST
    level = np.clip(0.5 * np.log2(np.maximum(texels, 1e-30)), 0.0, last)
    low = np.minimum(np.floor(level), last - 1).astype(int)
    share = (level - low)[..., None]
    near, far = (level_at(np.asarray(map), size, place, low + i) for i in (0, 1))
    return np.asarray((1.0 - share) * near + share * far)


def level_at(map: NDArray[np.generic], size: int, place: Float, level: NDArray[np.int64]) -> Float:
    """Return the values (..., 3) of a map at positions (..., 2) in [0, 1], in levels (...)."""
    side = size >> level
    texel = place * side[..., None] + 0.5
    low = np.floor(texel)
    share = texel - low
    column = low[..., 0].astype(int) + 2 * (size - side + level)
    row = low[..., 1].astype(int)
    value = np.zeros((*side.shape, 3))
    for i, j in np.ndindex(2, 2):
        weight = np.where([i, j], share, 1.0 - share).prod(axis=-1)
        value += weight[..., None] * map[row + j, column + i]
    return value


def environment_cook_torrance(
    map: ArrayLike,
    size: int,
    n: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    f0: float,
    fresnel_term: str = "schlick",
    masking_term: str = "v-cavity",
    *,
    samples: int = SAMPLES,
) -> Float:
    """Return the environment light (..., 3) that Cook-Torrance with the exact lobe reflects.

    Parameters
    ----------
    map, size : see :func:`environment_radiance`
    n, v : unit vectors: normal, direction to the camera
    m : roughness: RMS slope of the microfacets, in [1e-4, 2]
    f0, fresnel_term, masking_term : see :func:`facerender.brdf.cook_torrance`
    samples : number of sampled directions, even
    """
    factors = {"fresnel_term": fresnel_term, "masking_term": masking_term}
    brdf = partial(cook_torrance, f0=f0, **factors)
    return reflected(map, size, n, v, m, brdf, samples)


def environment_ward(
    map: ArrayLike, size: int, n: ArrayLike, v: ArrayLike, m: ArrayLike, *, samples: int = SAMPLES
) -> Float:
    """Return the environment light (..., 3) that Ward's BRDF with the exact lobe reflects.

    For the parameters see :func:`environment_cook_torrance`.
    """
    return reflected(map, size, n, v, m, ward, samples)


def reflected(
    map: ArrayLike,
    size: int,
    n: ArrayLike,
    v: ArrayLike,
    m: ArrayLike,
    brdf: Callable[[Float, Float, Float, Float], Float],
    samples: int = SAMPLES,
) -> Float:
    """Return the environment light (..., 3) that a BRDF with the exact lobe reflects.

    The result is the mean of BRDF (N.L) (radiance of the map)/density over the samples. The density
    of the samples is E/(4 π m² (N.H)³ (V.H)).

    Parameters
    ----------
    brdf : function of n, l, v (K, 3) and m (K,)

    For the other parameters see :func:`environment_cook_torrance`.
    """
    normal, eye = np.broadcast_arrays(checked_unit("n", n), checked_unit("v", v))
    slope = np.broadcast_to(check_slope(m, "exact", K_COOK_TORRANCE), normal.shape[:-1])
    n_dot_v, axes = dot(normal, eye), environment_axes(normal, eye)
    total = np.zeros(normal.shape)
    for i in range(samples):
        towards = (-1.0) ** i * np.array([np.cos(_TURN * (i // 2)), np.sin(_TURN * (i // 2))])
        l, steradians = environment_sample(
            normal, eye, slope, axes, towards, i // 2, samples=samples
        )
        n_dot_l = dot(normal, l)
        visible = (steradians > 0.0) & (np.minimum(n_dot_l, n_dot_v) > MIN_COSINE)
        light = environment_radiance(map, size, l[visible], steradians[visible])
        weight = brdf(normal[visible], l[visible], eye[visible], slope[visible])
        total[visible] += (weight * n_dot_l[visible] * steradians[visible])[:, None] * light
    return total


def environment_axes(n: Float, v: Float) -> tuple[Float, Float]:
    """Return two tangent axes of normals (..., 3).

    The first axis points along the tangential part of the camera direction. It is arbitrary
    where the camera looks along the normal.
    """
    aside = v - dot(n, v)[..., None] * n
    length = np.sqrt(dot(aside, aside))[..., None]
    side = np.where(np.abs(n[..., :1]) < 0.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    fallback = np.cross(n, side)
    fallback /= np.sqrt(dot(fallback, fallback))[..., None]
    tangent = np.where(length > _NEAR, aside / np.maximum(length, _NEAR), fallback)
    return tangent, np.cross(n, tangent)


def environment_sample(
    n: Float,
    v: Float,
    m: Float,
    axes: tuple[Float, Float],
    towards: Float,
    i: int,
    *,
    samples: int = SAMPLES,
) -> tuple[Float, Float]:
    """Return direction (..., 3) and solid angle (...), in sr, of one sample of the lobe.

    Parameters
    ----------
    axes : result of :func:`environment_axes`
    towards : direction of the slope relative to `axes`, (2,)
    i : index of the slope, from 0 to samples/2 - 1
    """
    slope_factor = 1.0 - (i + 0.5) / (samples // 2)
    radius = m * np.sqrt(-np.log(slope_factor))
    h = n + radius[..., None] * (towards[0] * axes[0] + towards[1] * axes[1])
    v_dot_h, h_dot_h = dot(v, h), dot(h, h)
    steradians = 4.0 * np.pi * m**2 * v_dot_h / (h_dot_h**2 * slope_factor * samples)
    return 2.0 * (v_dot_h / h_dot_h)[..., None] * h - v, steradians
