"""Directional albedo of Cook-Torrance from a fit (``tools/fits/albedo.py``), and the factor of an
energy-conserving diffuse term."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]

ENDS = (0.05, 1.0)  # Range of m; values outside are clamped.
LOWEST = 0.02  # Lowest square root of the cosine; smaller values are clamped.
# Coefficients of s^i t^j in row i and column j, with s = 2 sqrt(cosine) - 1 and t = m scaled to
# [-1, 1]. The albedo is f0 times the first polynomial, plus the second polynomial. 0.0061 is added
# to the fit, so that it is nowhere below the integral of BRDF (N.L).
FITS = np.array(
    [
        [
            (0.863348, 0.0781893, -0.12987, -0.0220138, 0.0837679),
            (0.0726275, -0.135827, 0.369948, -0.308854, -0.0602395),
            (-0.313448, -0.321842, 0.878571, 0.427615, -1.03386),
            (0.189434, -0.568655, -1.02757, 0.877151, 0.367696),
            (0.290153, 0.2594, -1.82168, -0.57507, 1.86765),
            (-0.22919, 0.62927, 1.10468, -0.822087, -0.544213),
            (-0.078561, -0.114966, 0.914632, 0.308167, -0.932605),
            (0.0763889, -0.212311, -0.517819, 0.236421, 0.336868),
        ],
        [
            (0.0798003, -0.0509785, 0.0701351, -0.0488855, -0.00373464),
            (-0.2461, 0.0662001, 0.143383, 0.229181, -0.36135),
            (0.298349, -0.15041, -0.518808, 0.134066, 0.467996),
            (0.126182, 0.361314, -1.55276, -0.77729, 1.9972),
            (-0.369746, 0.207035, 1.60055, -0.415289, -1.32783),
            (-0.147346, -0.64708, 2.69811, 1.22936, -3.37024),
            (0.178681, -0.113359, -1.13989, 0.283205, 0.944013),
            (0.0918043, 0.327341, -1.34385, -0.634385, 1.69686),
        ],
    ]
)
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
    """Return the cosine-weighted mean of :func:`cook_torrance_albedo` over the hemisphere; for
    m and f0 see that function."""
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
