"""Frame times on the current driver with readback: measurement, and interpolation between measured
frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.pricing.interval import Interval, bootstrap

Draw = Callable[[], object]

_FEWEST = 11  # smallest number of rounds before a time limit ends a measurement


def seconds(
    draws: Sequence[Draw],
    repeats: int,
    progress: Callable[[float], object] = lambda done: None,
    limit: float = math.inf,
) -> NDArray[np.float64]:
    """Return the duration of each draw, (rounds, draws) in seconds.

    The draws alternate. A first round, which compiles and uploads, is not measured.

    limit : seconds after which no further round begins, once there are _FEWEST rounds
    """
    for draw in draws:
        draw()
    times = np.empty((repeats, len(draws)))
    for turn in range(repeats):
        if turn >= _FEWEST and times[:turn].sum() > limit:
            return times[:turn]
        for index, draw in enumerate(draws):
            start = time.perf_counter()
            draw()
            times[turn, index] = time.perf_counter() - start
        progress((turn + 1) / repeats)
    return times


def ratio(draw: Draw, full: Draw, repeats: int) -> Interval:
    """Divide the time of ``draw`` by the time of ``full`` per round; return the median ratio."""
    times, baseline = seconds([draw, full], repeats).T
    return bootstrap(lambda turns: np.median((times / baseline)[turns], keepdims=True), repeats)[0]


def relative(draw: Draw, full: Draw, repeats: int, limit: float) -> Interval:
    """Divide the time of ``draw`` by the time of ``full`` per round; return the median and the 10 %
    and 90 % quantiles of the ratios.

    The load of a machine changes within seconds, and more rounds of one load do not show that. So
    these quantiles contain the median of a later measurement more often than a bootstrap interval.

    limit : as in :func:`seconds`
    """
    times, baseline = seconds([draw, full], repeats, limit=limit).T
    return Interval(*np.quantile(times / baseline, [0.5, 0.1, 0.9]).tolist())


@dataclass(frozen=True)
class Line:
    """Milliseconds of a frame as a linear function of its fragment price.

    Attributes
    ----------
    fixed : milliseconds that do not depend on the shading: geometry, coverage, maps, readback
    slope : increase of the frame time in milliseconds per unit of the fragment price
    """

    fixed: float
    slope: float

    @classmethod
    def through(cls, full: tuple[float, float], cheap: tuple[float, float]) -> Line:
        """Return the line through two frames, each given by its fragment price and milliseconds.

        The slope is 0 if the cheaper frame was not faster. If noise makes the line steep, the line
        ends at the origin instead, so that no shading saves more than the whole frame.
        """
        (price, time), (low_price, low_time) = full, cheap
        slope = (time - low_time) / (price - low_price) if price > low_price else 0.0
        slope = min(max(slope, 0.0), time / price)
        return cls(time - slope * price, slope)

    def cost(self, total: float, specular: float) -> tuple[float, float]:
        """Return milliseconds of a frame and of its specular terms, from their fragment prices."""
        return self.fixed + self.slope * total, self.slope * specular


@dataclass(frozen=True)
class Frames:
    """Frame times of a plan.

    Attributes
    ----------
    full, own : time as a function of the fragment price, with the full and with the chosen
        level of detail
    taken : milliseconds of frames with the full shading, keyed by the last choice in effect:
        "full", "cull_back_faces", "samples", "shading_rate" or "triangles"
    source : origin of the times, as text
    """

    full: Line
    own: Line
    taken: Mapping[str, float]
    source: str
