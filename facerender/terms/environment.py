"""Integrals of the models over directions, in float64: directional albedo, importance sampling and
environment lighting. References for ``albedo.glsl``, ``*_sample.glsl`` and ``environment.glsl``.

``scene/environment.py`` computes the maps and coefficients of an environment,
``tools/fits/albedo.py`` the fit of the albedo. Sampled models have the exact lobe; Cook-Torrance
has V-cavity masking. Vectors have the shape (..., 3), random numbers (..., 2) or (..., 3), m (...);
the leading axes broadcast against one another. ``brdf.NAME`` is ``fr_NAME`` in GLSL, with the same
arguments in the same order. The parameter ``samples`` replaces the macro FR_ENVIRONMENT_SAMPLES."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError
from facerender.terms.lobe import check_slope
from facerender.terms.model import MIN_COSINE, checked_unit, cook_torrance, dot, ward

Float = NDArray[np.float64]
Axes = tuple[Float, Float]

_checked_slope = partial(check_slope, name="exact", k=4)  # all models have this domain

ENDS = (0.05, 1.0)  # Range of m; values outside are clamped.
LOWEST = 0.02  # Lowest square root of the cosine; smaller values are clamped.
# Coefficients of s^i t^j in row i and column j, with s = 2 sqrt(cosine) - 1 and t = m scaled to
# [-1, 1]. The albedo is f0 times the first polynomial, plus the second polynomial. 0.0061 is added
# to the fit, so that it is nowhere below the integral of BRDF (N.L).
FITS = np.array(
    [
        (0.863348, 0.0781893, -0.12987, -0.0220138, 0.0837679),
        (0.0726275, -0.135827, 0.369948, -0.308854, -0.0602395),
        (-0.313448, -0.321842, 0.878571, 0.427615, -1.03386),
        (0.189434, -0.568655, -1.02757, 0.877151, 0.367696),
        (0.290153, 0.2594, -1.82168, -0.57507, 1.86765),
        (-0.22919, 0.62927, 1.10468, -0.822087, -0.544213),
        (-0.078561, -0.114966, 0.914632, 0.308167, -0.932605),
        (0.0763889, -0.212311, -0.517819, 0.236421, 0.336868),
        (0.0798003, -0.0509785, 0.0701351, -0.0488855, -0.00373464),
        (-0.2461, 0.0662001, 0.143383, 0.229181, -0.36135),
        (0.298349, -0.15041, -0.518808, 0.134066, 0.467996),
        (0.126182, 0.361314, -1.55276, -0.77729, 1.9972),
        (-0.369746, 0.207035, 1.60055, -0.415289, -1.32783),
        (-0.147346, -0.64708, 2.69811, 1.22936, -3.37024),
        (0.178681, -0.113359, -1.13989, 0.283205, 0.944013),
        (0.0918043, 0.327341, -1.34385, -0.634385, 1.69686),
    ]
).reshape(2, 8, 5)
# Cosine-weighted mean of s^i over the hemisphere: the integral of 4 x^3 (2 x - 1)^i from 0 to 1.
MEANS = np.array([1, 3 / 5, 7 / 15, 13 / 35, 11 / 35, 17 / 63, 5 / 21, 7 / 33])


def cook_torrance_albedo(n_dot_v: ArrayLike, m: ArrayLike, f0: ArrayLike) -> Float:
    """Return the fraction of the light from one direction that Cook-Torrance reflects.

    The value is a fit for the exact lobe, Schlick's Fresnel term and V-cavities. It is 0 to 0.0125
    above the integral of BRDF (N.L).

    Parameters
    ----------
    n_dot_v : cosine of the angle between direction and normal, in [0, 1]; clamped to at least 4e-4
    m : roughness: RMS slope of the microfacets; clamped to [0.05, 1]
    f0 : Fresnel reflectance at normal incidence, in [0, 0.1]; for larger f0 the error grows by up
        to 0.008 f0

    References: Kelemen and Szirmay-Kalos (2001), who tabulate the albedo.
    """
    x = np.clip(np.sqrt(np.clip(n_dot_v, 0.0, 1.0)), LOWEST, 1.0)
    powers = (2.0 * x - 1.0)[..., None] ** np.arange(len(MEANS))
    return np.asarray((_coefficients(m, f0) * powers).sum(axis=-1))


def cook_torrance_albedo_mean(m: ArrayLike, f0: ArrayLike) -> Float:
    """Return the cosine-weighted mean of :func:`cook_torrance_albedo` over the hemisphere."""
    return np.asarray(_coefficients(m, f0) @ MEANS)


def diffuse_coupled(albedo_l: ArrayLike, albedo_v: ArrayLike, mean: ArrayLike) -> Float:
    """Return the factor that makes a Lambertian term energy-conserving.

    The factor is (1 - albedo_l) (1 - albedo_v)/(1 - mean). It keeps the BRDF reciprocal.

    Parameters
    ----------
    albedo_l, albedo_v : directional albedos of the specular term for the directions to the light
        and to the camera, times the specular weight; clamped to at most 1
    mean : cosine-weighted mean of the directional albedo over the hemisphere, at most 0.5 (clamped)

    References: Kelemen and Szirmay-Kalos (2001).
    """
    product = (1.0 - np.minimum(albedo_l, 1.0)) * (1.0 - np.minimum(albedo_v, 1.0))
    return np.asarray(product / (1.0 - np.minimum(mean, 0.5)))


def _coefficients(m: ArrayLike, f0: ArrayLike) -> Float:
    """Return the factors of s^0 to s^7, (..., 8)."""
    slope = np.clip(np.asarray(m, dtype=np.float64), *ENDS)
    t = (2.0 * slope - sum(ENDS)) / (ENDS[1] - ENDS[0])
    powers = t[..., None] ** np.arange(FITS.shape[2])
    first, second = (powers @ fit.T for fit in FITS)
    return np.asarray(np.asarray(f0, dtype=np.float64)[..., None] * first + second)


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
    normal, slope = checked_unit("n", n), _checked_slope(m)
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

    The density is 0 if N.V or N.L + N.V is at most 1e-6. For n, v and m see that function; l is the
    unit vector to the light.
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
    """Return N.V, N.h, h.h, tan² γ (0 if N.h is at most 1e-6) and m for h = l + v."""
    normal, light, eye = checked_unit("n", n), checked_unit("l", l), checked_unit("v", v)
    h = light + eye
    n_dot_v, n_dot_h = dot(normal, eye), dot(normal, light) + dot(normal, eye)
    cross = np.cross(normal, h)
    above = n_dot_h > MIN_COSINE
    tan2 = np.where(above, dot(cross, cross) / np.where(above, n_dot_h, 1.0) ** 2, 0.0)
    return n_dot_v, n_dot_h, dot(h, h), tan2, _checked_slope(m)


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
    map : all levels side by side, (size + 2, W, 3), see ``scene.environment.atlas``
    size : side of the first level in texels, a power of two
    l : unit vectors (..., 3)
    solid_angle : in sr, (...)
    """
    x, y, z = np.moveaxis(np.asarray(l, dtype=np.float64), -1, 0)
    norm = np.abs(x) + np.abs(y) + np.abs(z)
    position = np.stack([x, z], axis=-1) / norm[..., None]
    folded = (1.0 - np.abs(position[..., ::-1])) * np.where(position >= 0.0, 1.0, -1.0)
    position = 0.5 * np.where((y < 0.0)[..., None], folded, position) + 0.5
    texels = np.asarray(solid_angle) * (0.5 * size) ** 2 / norm**3
    last = int(size).bit_length() - 1 - _COARSEST
    level = np.clip(0.5 * np.log2(np.maximum(texels, 1e-30)), 0.0, last)
    low = np.minimum(np.floor(level), last - 1).astype(int)
    share = (level - low)[..., None]
    near, far = (level_at(np.asarray(map), size, position, low + i) for i in (0, 1))
    return np.asarray((1.0 - share) * near + share * far)


def level_at(map: NDArray[np.generic], size: int, point: Float, level: NDArray[np.int64]) -> Float:
    """Return the values (..., 3) of a map at positions (..., 2) in [0, 1], in levels (...)."""
    side = size >> level
    texel = point * side[..., None] + 0.5
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
    brdf = partial(cook_torrance, f0=f0, fresnel_term=fresnel_term, masking_term=masking_term)
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

    brdf : function of n, l, v (K, 3) and m (K,)

    For the other parameters see :func:`environment_cook_torrance`.
    """
    normal, eye = np.broadcast_arrays(checked_unit("n", n), checked_unit("v", v))
    slope = np.broadcast_to(_checked_slope(m), normal.shape[:-1])
    n_dot_v, axes = dot(normal, eye), environment_axes(normal, eye)
    total = np.zeros(normal.shape)
    for i in range(samples):
        j = i // 2  # Index of the slope; each is also sampled in the opposite direction.
        towards = (-1.0) ** i * np.array([np.cos(_TURN * j), np.sin(_TURN * j)])
        l, steradians = environment_sample(normal, eye, slope, axes, towards, j, samples=samples)
        n_dot_l = dot(normal, l)
        visible = (steradians > 0.0) & (np.minimum(n_dot_l, n_dot_v) > MIN_COSINE)
        light = environment_radiance(map, size, l[visible], steradians[visible])
        weight = brdf(normal[visible], l[visible], eye[visible], slope[visible])
        total[visible] += (weight * n_dot_l[visible] * steradians[visible])[:, None] * light
    return total


def environment_axes(n: Float, v: Float) -> Axes:
    """Return two tangent axes of normals (..., 3). The first axis points along the tangential part
    of the camera direction. It is arbitrary where the camera looks along the normal."""
    aside = v - dot(n, v)[..., None] * n
    length = np.sqrt(dot(aside, aside))[..., None]
    side = np.where(np.abs(n[..., :1]) < 0.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    fallback = np.cross(n, side)
    fallback /= np.sqrt(dot(fallback, fallback))[..., None]
    tangent = np.where(length > _NEAR, aside / np.maximum(length, _NEAR), fallback)
    return tangent, np.cross(n, tangent)


def environment_sample(
    n: Float, v: Float, m: Float, axes: Axes, towards: Float, i: int, *, samples: int = SAMPLES
) -> tuple[Float, Float]:
    """Return direction (..., 3) and solid angle (...), in sr, of one sample of the lobe.

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
