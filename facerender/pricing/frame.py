"""What whole frames cost on the driver at hand, readback included: measured in turns, and a model
between what was measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.pricing.interval import Interval, bootstrap

Draw = Callable[[], object]


def seconds(
    draws: Sequence[Draw], repeats: int, progress: Callable[[float], object] = lambda done: None
) -> NDArray[np.float64]:
    """Return the duration of each draw, (repeats, draws) in seconds; they take turns, after one
    that compiles and uploads. progress is called with the fraction that is done."""
    for draw in draws:
        draw()
    times = np.empty((repeats, len(draws)))
    for turn in range(repeats):
        for index, draw in enumerate(draws):
            start = time.perf_counter()
            draw()
            times[turn, index] = time.perf_counter() - start
        progress((turn + 1) / repeats)
    return times


def ratios(draws: Sequence[Draw], repeats: int) -> list[Interval]:
    """Return of each draw the median of the ratios of its time to the first one's within a turn."""
    times = seconds(draws, repeats)
    over_first = times / times[:, :1]
    return bootstrap(lambda turns: np.median(over_first[turns], axis=0), repeats)


def ratio(draw: Draw, full: Draw, repeats: int) -> Interval:
    """Return the median of the ratios of two frames' times within a turn."""
    own, other = seconds([draw, full], repeats).T
    return bootstrap(lambda turns: np.median((own / other)[turns], keepdims=True), repeats)[0]


@dataclass(frozen=True)
class Line:
    """Milliseconds of a frame, by what a fragment of it costs.

    Attributes
    ----------
    fixed : of what no shading changes: geometry, coverage, maps, readback
    slope : of the whole frame, for one of the prices' units
    """

    fixed: float
    slope: float

    @classmethod
    def through(cls, full: tuple[float, float], cheap: tuple[float, float]) -> Line:
        """Return the line through two frames' prices of a fragment and milliseconds; where the
        cheaper one was not faster, the price counts for nothing."""
        (price, time), (low_price, low_time) = full, cheap
        slope = (time - low_time) / (price - low_price) if price > low_price else 0.0
        slope = max(slope, 0.0)
        return cls(time - slope * price, slope)

    def cost(self, total: float, specular: float) -> tuple[float, float]:
        """Return milliseconds of a frame, and of its specular terms."""
        return self.fixed + self.slope * total, self.slope * specular


@dataclass(frozen=True)
class Frames:
    """What frames cost.

    Attributes
    ----------
    full, own : by shading, with the full detail and with the one that was chosen
    taken : milliseconds with the full shading: "full", with the "cull_back_faces" that was chosen,
        then with "samples", "shading_rate" and "triangles"
    source : where they are from, in words
    """

    full: Line
    own: Line
    taken: Mapping[str, float]
    source: str
