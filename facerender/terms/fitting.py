"""Minimax fits of the lobe E/c^k by a clamped polynomial to a power: where the constants of the
fitted lobes in ``lobe.py`` and ``shaders/facerender/lobe/fitted.glsl`` come from. No OpenGL here.

``python -m facerender.terms.fitting`` computes the constants anew and prints them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError
from facerender.terms import lobe as lobes
from facerender.terms.lobe import GPower, PowerPolynomial

Array = NDArray[np.float64]

G_POWERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24)  # few products each


def fit(
    k: int, power: int, degree: int, slopes: ArrayLike, order: int = 0
) -> tuple[PowerPolynomial, float]:
    """Return the best uniform approximation over all angles and the given slopes, and its error.

    For a fixed error ε, (f - ε)^(1/power) <= P <= (f + ε)^(1/power) and P' <= 0 are linear in the
    constants, and P(0) = 1 is built in: bisecting ε over linear programs finds the best of all
    fits that are monotone and exact at γ = 0.

    Parameters
    ----------
    k : 4 for Cook-Torrance, 0 for Ward
    power : of the clamped polynomial
    degree : of the polynomial P in u = 1 - cos γ
    slopes : rms slopes m that the fit must serve, (M,), in the domain of the exact lobe
    order : degree of the polynomials in m² that give the coefficients of P; 0 for a single slope

    Returns
    -------
    the fit, and its largest error on a grid of angles, where the lobe's peak is 1

    Raises
    ------
    InputError : a slope outside its domain, or no monotone fit is within half of the peak

    References: Boyd and Vandenberghe (2004), section 4.2.5, for the bisection.
    """
    from scipy.optimize import linprog

    rms = np.asarray(slopes, dtype=np.float64).reshape(-1)
    end = float(rms.max())
    grids = [_grid(k, m) for m in rms]
    u, m = (np.concatenate(part) for part in zip(*grids, strict=True))
    exact = _exact(u, m, k)
    v, w = u / m**2, (m / end) ** 2
    columns = [(j, i) for j in range(order + 1) for i in range(1, degree + 1)]
    value = np.stack([w**j * v**i for j, i in columns], axis=-1)
    derivative = np.stack([w**j * i * v ** (i - 1) for j, i in columns], axis=-1)
    # In the tail v is large: unscaled rows would hide errors in the solver's tolerance.
    scale = np.maximum(1.0, v**degree)
    falling = derivative / np.maximum(1.0, v ** (degree - 1))[:, None]
    # A closed form holds down to m = 0, where v is unbounded: its highest power must not rise.
    last = (0, degree) if order > 0 else None
    bounds = [(None, 0.0 if column == last else None) for column in columns]

    def constants_within(epsilon: float) -> Array | None:
        seen = exact > epsilon
        high = (exact + epsilon) ** (1.0 / power) - 1.0
        low = (exact[seen] - epsilon) ** (1.0 / power) - 1.0
        result = linprog(
            np.zeros(len(columns)),
            A_ub=np.concatenate([value / scale[:, None], -(value / scale[:, None])[seen], falling]),
            b_ub=np.concatenate([high / scale, -low / scale[seen], np.zeros(len(u))]),
            bounds=bounds,
            method="highs-ds",
        )
        return np.asarray(result.x) if result.status == 0 else None

    below, above = 0.0, 0.5
    best = constants_within(above)
    if best is None:
        raise InputError(f"no monotone fit of power {power} for m up to {end:g}, k = {k}")
    while above > 1.005 * below + 1e-7:
        middle = float(np.sqrt(above * max(below, above / 100.0)))
        constants = constants_within(middle)
        if constants is None:
            below = middle
        else:
            above, best = middle, constants
    error = float(np.abs(np.maximum(1.0 + value @ best, 0.0) ** power - exact).max())
    table = best.reshape(order + 1, degree) / end ** (2 * np.arange(order + 1))[:, None]
    return PowerPolynomial(power, end, tuple(tuple(row) for row in table.tolist())), error


@lru_cache(maxsize=1024)
def fit_g_power(k: int, g: int, smallest: float, largest: float) -> GPower | None:
    """Return the g-power that is best for slopes from smallest to largest: of one slope the best
    uniform approximation, of several the nearest to their best ones; None where none serves.

    Parameters
    ----------
    k : 4 for Cook-Torrance, 0 for Ward
    g : the power, in 1 to 31
    smallest, largest : rms slopes in the domain of the exact lobe
    """
    slopes = np.unique(np.geomspace(smallest, largest, 5)) if smallest < largest else [smallest]
    best = np.array([_steepness(k, g, m) for m in slopes])
    # steepness = factor/m² - offset, in relative least squares
    terms = np.stack([np.asarray(slopes) ** -2.0, -np.ones(len(slopes))], axis=-1)
    columns = 2 if len(slopes) > 1 else 1
    relative = terms[:, :columns] / best[:, None]
    solution = np.linalg.lstsq(relative, np.ones(len(slopes)), rcond=None)[0]
    factor, offset = solution if columns == 2 else (solution[0], 0.0)
    lobe = GPower(g, float(factor), float(offset))
    return lobe if lobes.in_domain([smallest, largest], lobe, k).all() else None


def _steepness(k: int, g: int, m: float) -> float:
    """The steepness at which a g-power is as far above the exact lobe as below: a steeper one is
    lower at every angle."""
    c = np.cos(np.linspace(0.0, np.arctan(5.0 * m), 800))  # beyond, nothing is left
    exact = lobes.exact(c, m, k)
    low, high = 0.0, 40.0 / (g * m * m)
    for _ in range(50):
        middle = 0.5 * (low + high)
        difference = lobes.clamped_power(c, middle, g) - exact
        if difference.max() > -difference.min():
            low = middle
        else:
            high = middle
    return middle


def _exact(u: Array, m: Array, k: int) -> Array:
    with np.errstate(divide="ignore"):
        tan2 = u * (2.0 - u) / (1.0 - u) ** 2
    return lobes.exact_tan2(tan2, m, k)


def _grid(k: int, m: float) -> tuple[Array, Array]:
    """Values of u for one slope, dense near both ends of what the lobe covers and sparse in its
    tail; and m, as often."""
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
