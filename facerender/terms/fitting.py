"""Functions that fit a g-power lobe to a range of m. ``tools/fits/lobes.py`` computes the constants
of the lobes "fitted" and "fitted-fine"."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from facerender.terms import lobe as lobes
from facerender.terms.lobe import GPower

G_POWERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24)  # Each power needs few products.


@lru_cache(maxsize=1024)
def fit_g_power(k: int, g: int, smallest: float, largest: float) -> GPower | None:
    """Return the g-power lobe that fits a range of m best; None if the range leaves the lobe's
    domain.

    For one m the lobe is the best uniform approximation of the exact lobe. For a range, least
    squares fit the steepness to the best steepness at each of five values of m.

    Parameters
    ----------
    k : 4 for Cook-Torrance, 0 for Ward
    g : power, in 1 to 31
    smallest, largest : ends of the range of m, in the domain of the exact lobe
    """
    slopes = np.unique(np.geomspace(smallest, largest, 5)) if smallest < largest else [smallest]
    best = np.array([_steepness(k, g, m) for m in slopes])
    # Least squares minimise the relative error of steepness = factor/m² - offset.
    terms = np.stack([np.asarray(slopes) ** -2.0, -np.ones(len(slopes))], axis=-1)
    relative = terms[:, : len(slopes)] / best[:, None]  # one m determines no offset
    solution = np.linalg.lstsq(relative, np.ones(len(slopes)), rcond=None)[0]
    factor, offset = (*solution, 0.0)[:2]
    lobe = GPower(g, float(factor), float(offset))
    return lobe if lobes.in_domain([smallest, largest], lobe, k).all() else None


def _steepness(k: int, g: int, m: float) -> float:
    """Return the steepness of the g-power lobe whose largest errors above and below the exact lobe
    are equal. Bisection finds this steepness, because a steeper lobe is lower at every
    angle."""
    c = np.cos(np.linspace(0.0, np.arctan(5.0 * m), 800))  # The lobe is tiny at larger angles.
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
