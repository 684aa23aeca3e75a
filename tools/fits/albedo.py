"""The directional albedo of Cook-Torrance as an integral, and its polynomial fit.

``python -m tools.fits.albedo`` computes FITS of ``facerender/terms/environment.py`` and the
coefficients of ``shaders/facerender/albedo.glsl``, and prints them. It takes two minutes.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from facerender.terms.environment import ENDS, LOWEST

Float = NDArray[np.float64]


def albedo_integral(n_dot_v: float, m: float, f0: float, nodes: int = 128) -> float:
    """Return the directional albedo with Schlick's Fresnel term and V-cavity masking, by quadrature
    over half vectors with the distribution of their slopes."""
    first, rest = _integrals(n_dot_v, m, nodes)
    return f0 * first + rest


def _integrals(mu: float, m: float, nodes: int) -> tuple[float, float]:
    """Return the integrals with the Fresnel factors 1 - s and s, where s = (1 - V.H)^5."""
    u, weight = np.polynomial.legendre.leggauss(nodes)
    r = m * np.sqrt(-np.log(0.5 * (u + 1.0)))[:, None]
    turn = (np.arange(nodes) + 0.5) / nodes * 2.0 * np.pi
    n_dot_h = 1.0 / np.sqrt(1.0 + r * r)
    v_dot_h = (r * np.cos(turn) * np.sqrt(1.0 - mu * mu) + mu) * n_dot_h
    n_dot_l = 2.0 * v_dot_h * n_dot_h - mu
    seen = (v_dot_h > 0.0) & (n_dot_l > 0.0)
    masked = np.minimum(1.0, 2.0 * n_dot_h * np.minimum(n_dot_l, mu) / np.where(seen, v_dot_h, 1.0))
    share = np.where(seen, masked * v_dot_h / (mu * n_dot_h), 0.0) * weight[:, None] / (2.0 * nodes)
    s = np.clip(1.0 - v_dot_h, 0.0, 1.0) ** 5
    return float((share * (1.0 - s)).sum()), float((share * s).sum())


def fitted(degrees: tuple[int, int] = (7, 4), turns: int = 300) -> tuple[Float, Float]:
    """Return FITS and their largest errors, by iterated least squares whose weights grow where the
    error is large."""
    x = 0.5 * (1.0 + LOWEST) - 0.5 * (1.0 - LOWEST) * np.cos(np.linspace(0.0, np.pi, 48))
    t = -np.cos(np.linspace(0.0, np.pi, 24))
    m = 0.5 * (sum(ENDS) + (ENDS[1] - ENDS[0]) * t)
    values = np.array([[_integrals(each * each, slope, 128) for slope in m] for each in x])
    basis = chebyshev.chebvander2d(*np.meshgrid(2.0 * x - 1.0, t, indexing="ij"), degrees)
    basis = basis.reshape(values[..., 0].size, -1)
    fits, errors = [], []
    for wanted in (values[..., 0].ravel(), values[..., 1].ravel()):
        weights, least = np.ones(wanted.size), np.inf
        for _ in range(turns):
            found = np.linalg.lstsq(basis * weights[:, None], wanted * weights, rcond=None)[0]
            error = np.abs(basis @ found - wanted)
            weights *= np.sqrt(0.4 + error / error.max())
            weights /= weights.mean()
            if error.max() < least:
                least, best = float(error.max()), found
        table = best.reshape(degrees[0] + 1, degrees[1] + 1)
        for axis in (0, 1):
            table = np.apply_along_axis(_power_series, axis, table)
        fits.append(table)
        errors.append(least)
    return np.array(fits), np.array(errors)


def _power_series(coefficients: Float) -> Float:
    series = chebyshev.cheb2poly(coefficients)
    return np.pad(series, (0, len(coefficients) - len(series)))


def main() -> None:
    fits, errors = fitted()
    print(f"errors {errors}")
    for fit in fits:
        for row in fit:
            print("(" + ", ".join(f"{value:.6g}" for value in row) + "),")


if __name__ == "__main__":
    main()
