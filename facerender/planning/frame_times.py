"""Frame times of a plan on this driver, estimated from a few measured frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from facerender.planning.search import Choice
from facerender.planning.views import DrawnViews, draw
from facerender.pricing.frame import Frames, Line, relative, seconds
from facerender.pricing.interval import Interval
from facerender.scenes.lod import LevelOfDetail
from facerender.shading import Shading

_VIEWPOINTS, _REPEATS = 3, 5
_ROUNDS, _SECONDS = 25, 5.0  # most rounds of the chosen and the full frame, and their time


def measured_frames(choice: Choice, drawn: DrawnViews) -> Frames:
    """Measure a few frames, and return frame time as a linear function of the fragment price.

    With the full shading, the full frame and a frame for each change of the level of detail are
    measured. The full and the final level of detail are also measured with the cheapest shading.
    For each of these two levels of detail, a line through the times of the two shadings gives the
    time of every other shading.
    """
    full, cheap = choice.full, choice.ordered[0]
    detail = drawn.finest
    steps = {"full": detail}
    for name in ("cull_back_faces", "samples", "shading_rate", "triangles"):
        detail = steps[name] = replace(detail, **{name: getattr(drawn.detail, name)})
    asked = {(detail, full) for detail in steps.values()}
    asked |= {(detail, cheap) for detail in (drawn.finest, drawn.detail)}
    frames = sorted(asked, key=lambda frame: frame[1] is not full)
    draws = [_frame(drawn, *frame) for frame in frames]
    durations = seconds(draws, _REPEATS)
    medians = 1e3 * np.median(durations[:, 0]) * np.median(durations / durations[:, :1], axis=0)
    times = dict(zip(frames, medians.tolist(), strict=True))
    prices = choice.total(full), choice.total(cheap)

    def line(detail: LevelOfDetail) -> Line:
        detail_times = times[detail, full], times[detail, cheap]
        return Line.through((prices[0], detail_times[0]), (prices[1], detail_times[1]))

    driver = drawn.viewpoints[0].renderer.context.renderer
    source = f"drawn in turns on {driver}"
    step_times = {name: times[detail, full] for name, detail in steps.items()}
    return Frames(line(drawn.finest), line(drawn.detail), step_times, source)


def relative_time(full: Shading, shading: Shading, drawn: DrawnViews) -> Interval:
    """Draw a shading's frame and the full frame alternately; see
    :func:`facerender.pricing.frame.relative`."""
    planned_frame = _frame(drawn, drawn.detail, shading)
    return relative(planned_frame, _frame(drawn, drawn.finest, full), _ROUNDS, _SECONDS)


def _frame(drawn: DrawnViews, detail: LevelOfDetail, shading: Shading) -> Callable[[], object]:
    """Return a function that draws up to _VIEWPOINTS of the viewpoints, one after the other."""
    step = max(len(drawn.viewpoints) // _VIEWPOINTS, 1)
    viewpoints = drawn.viewpoints[::step][:_VIEWPOINTS]
    return lambda: [draw(viewpoint, shading, detail) for viewpoint in viewpoints]
