"""Minimax fits of the lobe E/c^k by a clamped polynomial to a power.

``python -m tools.fits.lobes`` computes the constants of the fitted lobes in
``facerender/terms/lobe.py`` and ``shaders/facerender/lobe/fitted.glsl``, and prints them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog

from facerender.errors import InputError
from facerender.terms import lobe as lobes
from facerender.terms.lobe import PowerPolynomial

Array = NDArray[np.float64]


def fit(
    k: int, power: int, degree: int, slopes: ArrayLike, order: int = 0
) -> tuple[PowerPolynomial, float]:
    """Return the best uniform approximation over all angles and the given slopes, and its error.

    For a fixed error ε, (f - ε)^(1/power) <= P <= (f + ε)^(1/power) and P' <= 0 are linear in the
    constants. P(0) = 1 is always true. Bisection of ε with a linear program at each step finds the
    best fit among all fits that are monotone and exact at γ = 0.

    Parameters
    ----------
    k : 4 for Cook-Torrance, 0 for Ward
    power : exponent of the clamped polynomial
    degree : degree of the polynomial P in u = 1 - cos γ
    slopes : RMS slopes m of the fit, (M,), in the domain of the exact lobe
    order : degree of the polynomials in m² for the coefficients of P; 0 for a single slope

    Returns
    -------
    the fit, and its largest error on a grid of angles; the peak of the lobe is 1

    Raises
    ------
    InputError : a slope is outside its domain, or no monotone fit is within half of the peak

    References: Boyd and Vandenberghe (2004), section 4.2.5, for the bisection.
    """
    rms = np.asarray(slopes, dtype=np.float64).reshape(-1)
    end = float(rms.max())
    programs = _Programs.of(k, power, degree, rms, order)
    below, above = 0.0, 0.5
    best = programs.constants_within(above)
    if best is None:
        raise InputError(f"no monotone fit of power {power} for m up to {end:g}, k = {k}")
    while above > 1.005 * below + 1e-7:
        middle = float(np.sqrt(above * max(below, above / 100.0)))
        constants = programs.constants_within(middle)
        if constants is None:
            below = middle
        else:
            above, best = middle, constants
    value = np.maximum(1.0 + programs.value @ best, 0.0) ** power
    error = float(np.abs(value - programs.exact).max())
    table = best.reshape(order + 1, degree) / end ** (2 * np.arange(order + 1))[:, None]
    return PowerPolynomial(power, end, tuple(tuple(row) for row in table.tolist())), error


@dataclass(frozen=True, eq=False)
class _Programs:
    """The linear programs of a fit, one per bound of the error.

    Attributes
    ----------
    power : exponent of the clamped polynomial
    exact : the lobe at the angles and slopes of the grid, (N,)
    value, falling : (N, constants); the product with the constants is P - 1 and its scaled
        derivative
    scale : divisors of the rows of value, (N,). Rows in the tail are large; without scaling, the
        tolerance of the solver would hide errors
    bounds : lower and upper bound of each constant
    """

    power: int
    exact: Array
    value: Array
    falling: Array
    scale: Array
    bounds: Sequence[tuple[float | None, float | None]]

    @classmethod
    def of(cls, k: int, power: int, degree: int, rms: Array, order: int) -> _Programs:
        u, m = (
            np.concatenate(part) for part in zip(*(_grid(k, each) for each in rms), strict=True)
        )
        v, w = u / m**2, (m / float(rms.max())) ** 2
        columns = [(j, i) for j in range(order + 1) for i in range(1, degree + 1)]
        value = np.stack([w**j * v**i for j, i in columns], axis=-1)
        derivative = np.stack([w**j * i * v ** (i - 1) for j, i in columns], axis=-1)
        falling = derivative / np.maximum(1.0, v ** (degree - 1))[:, None]
        # With coefficients for all m, v is unbounded at m = 0: its highest power must not rise.
        last = (0, degree) if order > 0 else None
        bounds = [(None, 0.0 if column == last else None) for column in columns]
        scale = np.maximum(1.0, v**degree)
        return cls(power, _exact(u, m, k), value, falling, scale, bounds)

    def constants_within(self, epsilon: float) -> Array | None:
        """Return constants with an error of at most epsilon, or None if none exist."""
        seen = self.exact > epsilon
        high = (self.exact + epsilon) ** (1.0 / self.power) - 1.0
        low = (self.exact[seen] - epsilon) ** (1.0 / self.power) - 1.0
        rows = self.value / self.scale[:, None]
        result = linprog(
            np.zeros(len(self.bounds)),
            A_ub=np.concatenate([rows, -rows[seen], self.falling]),
            b_ub=np.concatenate([high / self.scale, -low / self.scale[seen], 0.0 * high]),
            bounds=self.bounds,
            method="highs-ds",
        )
        return np.asarray(result.x) if result.status == 0 else None


def _exact(u: Array, m: Array, k: int) -> Array:
    with np.errstate(divide="ignore"):
        tan2 = u * (2.0 - u) / (1.0 - u) ** 2
    return lobes.exact_tan2(tan2, m, k)


def _grid(k: int, m: float) -> tuple[Array, Array]:
    """Return a grid of u for one slope, and m repeated to the same length.

    The grid is dense at both ends of the visible range of the lobe, and sparse in its tail.
    """
    angle = np.linspace(0.0, np.pi / 2, 2001)[1:]
    covered = _exact(1.0 - np.cos(angle), np.full_like(angle, m), k) > 1e-6
    edge = angle[covered][-1] if covered.any() else angle[0]
    angle = np.concatenate(
        [
            edge * 0.5 * (1.0 - np.cos(np.pi * np.arange(1, 49) / 48)),
            edge + (np.pi / 2 - edge) * (np.arange(1, 13) / 12) ** 2,
        ]
    )
    u = np.minimum(2.0 * np.sin(angle / 2.0) ** 2, 1.0)
    return u, np.full_like(u, m)


def main() -> None:
    for (name, k), lobe in lobes.FITTED.items():
        slopes = np.linspace(0.01, lobe.max_slope, 36)
        best, error = fit(k, lobe.power, len(lobe.table[0]), slopes, len(lobe.table) - 1)
        print(f"{name}, k = {k}, m <= {lobe.max_slope:g}: {100.0 * error:.4f} % of the peak")
        for row in best.table:
            print("    (" + ", ".join(f"{constant:.8g}" for constant in row) + "),")


if __name__ == "__main__":
    main()
