"""Lens distortion of OpenCV's model, in float64.

Points are normalised camera coordinates: x / z and y / z in OpenCV's camera space. Coefficients
are (k1, k2, p1, p2[, k3[, k4, k5, k6]]); left-out ones are 0. No image and no OpenGL here.
Source: OpenCV 4, "Camera Calibration and 3D Reconstruction".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Float = NDArray[np.float64]
Coefficients = tuple[float, ...]

_STEPS = 20  # Newton's steps; 4 suffice unless the distortion nearly folds
_PRECISE = 1e-12  # largest residual of a solution, relative to 1 + the length of the point
_TABLE = 1024  # entries of the table of radii that Newton's method starts from


def distort(points: Float, coefficients: Coefficients) -> Float:
    """Return distorted points (N, 2); NaN at and beyond the fold, where several points would have
    the same distorted point."""
    with np.errstate(all="ignore"):
        distorted, slopes = _distorted(points, coefficients)
        square = np.einsum("ni,ni->n", points, points)
        folded = ~((_determinant(slopes) > 0.0) & (square < fold(coefficients) ** 2))
    distorted[folded] = np.nan
    return distorted


def jacobian(points: Float, coefficients: Coefficients) -> Float:
    """Return the derivatives (N, 2, 2) of distorted points by undistorted points (N, 2)."""
    return _distorted(points, coefficients)[1]


def undistort(points: Float, coefficients: Coefficients) -> Float:
    """Return the points (N, 2) whose distorted points are given; NaN if there are none.

    The residual is at most 1e-12, relative to 1 + the length of the point.
    """
    if not len(points):
        return points
    with np.errstate(all="ignore"):
        radii = np.hypot(*points.T)
        table = _radii(coefficients, float(radii.max()))
        start = np.interp(radii, _radial(table, coefficients), table)
        solution = points * np.where(radii > 0.0, start / radii, 1.0)[:, None]
        for _ in range(_STEPS):
            distorted, slopes = _distorted(solution, coefficients)
            residual = distorted - points
            (x, y), ((a, b), (c, d)) = residual.T, np.moveaxis(slopes, 0, -1)
            steps = np.stack([d * x - b * y, a * y - c * x], axis=-1)
            solution = solution - steps / _determinant(slopes)[:, None]
            if np.nanmax(np.abs(residual), initial=0.0) < 1e-15:
                break
        residual = np.abs(distort(solution, coefficients) - points).max(axis=-1)
        solution[~(residual <= _PRECISE * (1.0 + radii))] = np.nan
    return solution


def fold(coefficients: Coefficients) -> float:
    """Return the radius at which the radial function stops to increase; inf if there is none."""
    upper, lower = _polynomials(coefficients)
    q = Polynomial([0.0, 1.0])
    increase = upper * lower + 2.0 * q * (upper.deriv() * lower - upper * lower.deriv())
    roots = np.concatenate([increase.trim().roots(), lower.trim().roots()])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return math.sqrt(squares.min()) if squares.size else math.inf


def _polynomials(coefficients: Coefficients) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator of the radial factor as polynomials in r^2."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    return Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])


def _radial(radii: Float, coefficients: Coefficients) -> Float:
    upper, lower = _polynomials(coefficients)
    return np.asarray(radii * upper(radii**2) / lower(radii**2))


def _radii(coefficients: Coefficients, largest: float) -> Float:
    """Return increasing radii up to one whose distorted radius is `largest`, but below the fold."""
    limit, end = fold(coefficients), max(largest, 1e-9)
    while end < limit and _radial(np.array(end), coefficients) < largest:
        end *= 2.0
    return np.linspace(0.0, min(end, limit), _TABLE, endpoint=end < limit)


def _distorted(points: Float, coefficients: Coefficients) -> tuple[Float, Float]:
    """Return distorted points (N, 2) and their derivatives by the given points, (N, 2, 2)."""
    _, _, p1, p2, *_ = coefficients
    upper, lower = _polynomials(coefficients)
    x, y = points.T
    square = x * x + y * y
    above, below = upper(square), lower(square)
    factor = above / below
    # Derivative of the factor by r^2, doubled.
    change = 2.0 * (upper.deriv()(square) - factor * lower.deriv()(square)) / below
    distorted = np.empty((len(points), 2))
    distorted[:, 0] = x * factor + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    distorted[:, 1] = y * factor + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    slopes = np.empty((len(points), 2, 2))
    slopes[:, 0, 0] = factor + x * x * change + 2.0 * p1 * y + 6.0 * p2 * x
    slopes[:, 0, 1] = slopes[:, 1, 0] = x * y * change + 2.0 * (p1 * x + p2 * y)
    slopes[:, 1, 1] = factor + y * y * change + 6.0 * p1 * y + 2.0 * p2 * x
    return distorted, slopes


def _determinant(slopes: Float) -> Float:
    return np.asarray(slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0])
