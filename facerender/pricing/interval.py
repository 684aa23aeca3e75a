"""Bootstrap intervals of measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95 % interval, by bootstrap over the repeats of a measurement.

    The interval of :func:`facerender.pricing.frame.relative` contains 80 % of the repeats instead.
    """

    value: float
    low: float
    high: float


def bootstrap(
    estimate: Callable[[NDArray[np.int64]], NDArray[np.float64]], repeats: int
) -> list[Interval]:
    """Return estimates (N,) with 95 % intervals; ``estimate`` takes indices of repeats."""
    draws = np.random.default_rng(0).integers(repeats, size=(500, repeats))
    low, high = np.percentile([estimate(turns) for turns in draws], [2.5, 97.5], axis=0)
    value = estimate(np.arange(repeats))
    return [Interval(*map(float, row)) for row in zip(value, low, high, strict=True)]
