"""Importance sampling of the models in float64: the reference for
``shaders/facerender/*_sample.glsl``.

The models have the exact lobe; Cook-Torrance has V-cavity masking. Vectors have the shape (..., 3),
random numbers (..., 2) or (..., 3), m (...); the leading axes broadcast against one another.
``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same arguments in the same order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError
from facerender.terms.lobe import check_slope
from facerender.terms.masking import MIN_COSINE
from facerender.terms.model import K_COOK_TORRANCE, checked_unit, dot

Float = NDArray[np.float64]

_LAST = 2.0**-24  # Smallest 1 - x for a float32 x < 1.


def slope_sample(n: ArrayLike, m: ArrayLike, u: ArrayLike) -> Float:
    """Return random slopes from the Beckmann distribution: tangent vectors (..., 3).

    The sum of n and a slope points along the normal of a microfacet.

    Parameters
    ----------
    n : unit vectors (..., 3): normal
    m : RMS slope, in [1e-4, 2]
    u : two random numbers (..., 2), uniform in [0, 1)

    References: Walter et al. (2007), eq. 28; Duff et al. (2017) for the tangent frame.
    """
    normal, slope = checked_unit("n", n), check_slope(m, "exact", K_COOK_TORRANCE)
    first, second = _checked_random(u, 2)
    x, y, z = (normal[..., i] for i in range(3))
    side = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (side + z)
    b = x * y * a
    tangent = np.stack([1.0 + side * x * x * a, side * b, -side * x], axis=-1)
    bitangent = np.stack([b, side + y * y * a, -y], axis=-1)
    length = slope * np.sqrt(-np.log(np.maximum(1.0 - first, _LAST)))
    angle = 2.0 * np.pi * second
    along, beside = length * np.cos(angle), length * np.sin(angle)
    return np.asarray(along[..., None] * tangent + beside[..., None] * bitangent)


def cook_torrance_sample(n: ArrayLike, v: ArrayLike, m: ArrayLike, u: ArrayLike) -> Float:
    """Return random directions to the light (..., 3), sampled from the visible normals of
    V-cavities.

    The BRDF is 0 for directions with N.L <= 0. The weight of a direction, BRDF (N.L)/density,
    is F G/G1, at most F.

    Parameters
    ----------
    n, v : unit vectors: normal, direction to the camera, with N.V > 0
    m : RMS slope, in [1e-4, 2]
    u : three random numbers (..., 3), uniform in [0, 1)

    References: Heitz and d'Eon (2014).
    """
    random = np.asarray(u, dtype=np.float64)
    third = _checked_random(random, 3)[2]
    normal, eye = checked_unit("n", n), checked_unit("v", v)
    across = slope_sample(normal, m, random[..., :2])
    sides = normal + across, normal - across
    weight, other_weight = (np.maximum(dot(*np.broadcast_arrays(eye, h)), 0.0) for h in sides)
    return _mirrored(eye, np.where((third * (weight + other_weight) < weight)[..., None], *sides))


def cook_torrance_pdf(n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike) -> Float:
    """Return the density G1 D/(4 N.V) of :func:`cook_torrance_sample` at l, in 1/sr.

    The density is 0 if N.V or N.L + N.V is at most 1e-6.

    Parameters
    ----------
    n, l, v : unit vectors: normal, direction to the light, direction to the camera
    m : RMS slope, in [1e-4, 2]
    """
    n_dot_v, n_dot_h, h_dot_h, tan2, slope = _half(n, l, v, m)
    above = np.minimum(n_dot_v, n_dot_h) > MIN_COSINE
    g1 = np.minimum(1.0, 4.0 * n_dot_h * n_dot_v / np.where(above, h_dot_h, 1.0))
    d = np.exp(-tan2 / slope**2) * (1.0 + tan2) ** 2 / (np.pi * slope**2)
    return np.where(above, d * g1 / (4.0 * np.where(above, n_dot_v, 1.0)), 0.0)


def ward_sample(n: ArrayLike, v: ArrayLike, m: ArrayLike, u: ArrayLike) -> Float:
    """Return random directions to the light (..., 3), sampled from half vectors of Ward's
    distribution.

    The BRDF is 0 for directions with N.L <= 0. If the half vector points away from the camera, the
    direction is -n.

    Parameters
    ----------
    n, v, m : see :func:`cook_torrance_sample`
    u : two random numbers (..., 2), uniform in [0, 1)

    References: Walter (2005).
    """
    normal, eye = checked_unit("n", n), checked_unit("v", v)
    h = normal + slope_sample(normal, m, u)
    towards = dot(*np.broadcast_arrays(eye, h)) > 0.0
    return np.where(towards[..., None], _mirrored(eye, h), -normal)


def ward_pdf(n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike) -> Float:
    """Return the density E/(4 π m² c³ (V.H)) of :func:`ward_sample` at l, in 1/sr.

    The density is 0 if N.L or N.V is at most 1e-6. For the parameters see
    :func:`cook_torrance_pdf`.
    """
    n_dot_v, n_dot_h, _, tan2, slope = _half(n, l, v, m)
    above = np.minimum(n_dot_v, n_dot_h - n_dot_v) > MIN_COSINE
    e = np.exp(-tan2 / slope**2) * (1.0 + tan2)
    return np.where(above, e / (2.0 * np.pi * slope**2 * np.where(above, n_dot_h, 1.0)), 0.0)


def _half(
    n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike
) -> tuple[Float, Float, Float, Float, Float]:
    """Return N.V, N.h, h.h, tan² γ and m for h = l + v, not normalised; tan² γ is 0 if N.h is
    at most 1e-6."""
    normal, light, eye = checked_unit("n", n), checked_unit("l", l), checked_unit("v", v)
    h = light + eye
    n_dot_v, n_dot_h = dot(normal, eye), dot(normal, light) + dot(normal, eye)
    cross = np.cross(normal, h)
    above = n_dot_h > MIN_COSINE
    tan2 = np.where(above, dot(cross, cross) / np.where(above, n_dot_h, 1.0) ** 2, 0.0)
    return n_dot_v, n_dot_h, dot(h, h), tan2, check_slope(m, "exact", K_COOK_TORRANCE)


def _mirrored(v: Float, h: Float) -> Float:
    v, h = np.broadcast_arrays(v, h)
    return np.asarray((2.0 * dot(v, h) / dot(h, h))[..., None] * h - v)


def _checked_random(u: ArrayLike, count: int) -> list[Float]:
    numbers = np.asarray(u, dtype=np.float64)
    if numbers.ndim == 0 or numbers.shape[-1] != count:
        raise InputError(f"u has shape {numbers.shape}: its last axis must hold {count} numbers")
    if not ((numbers >= 0.0) & (numbers <= 1.0)).all():
        worst = numbers.flat[np.argmax(np.abs(numbers - 0.5))]
        raise InputError(f"u holds {worst:g}: give numbers in [0, 1)")
    return [numbers[..., i] for i in range(count)]
