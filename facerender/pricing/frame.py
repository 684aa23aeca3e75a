"""What whole frames cost on the driver at hand, readback included: measured in turns."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from facerender.pricing.interval import Interval, bootstrap

Draw = Callable[[], object]


def seconds(draws: Sequence[Draw], repeats: int) -> NDArray[np.float64]:
    """Return how long each draw takes, (repeats, draws) in seconds; they take turns, after one that
    compiles and uploads."""
    for draw in draws:
        draw()
    times = np.empty((repeats, len(draws)))
    for turn in range(repeats):
        for index, draw in enumerate(draws):
            start = time.perf_counter()
            draw()
            times[turn, index] = time.perf_counter() - start
    return times


def ratio(draw: Draw, full: Draw, repeats: int) -> Interval:
    """Return the median of the ratios of two frames' times within a turn."""
    own, other = seconds([draw, full], repeats).T
    return bootstrap(lambda turns: np.median((own / other)[turns], keepdims=True), repeats)[0]
