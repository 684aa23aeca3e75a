"""Plots of a measurement as PNG in memory; needs matplotlib (extra ``measure``).

``pareto.py`` and ``report.py`` select the data.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.measure.measurement import Curves
from facerender.measure.pareto import EXACT, Row
from facerender.terms import LOBES

WIDTH = 6.4  # inches: the text stays legible on a phone
DPI = 110
COLOURS = {name: lobe.colour for name, lobe in LOBES.items()}
MARKERS: dict[str, dict[str, Any]] = {
    "not dominated": {"marker": "o", "color": "#444444"},
    "dominated": {"marker": "o", "color": "#444444", "mfc": "white"},
    "as published": {"marker": "s", "color": "#444444", "mfc": "white"},
}
# Candidate positions of a label: distances from its data point, in 1/72 inch; and directions.
_DISTANCES = (7, 12, 18, 26, 36, 48, 64, 80)
_DIRECTIONS = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def check() -> None:
    """Raise InputError if matplotlib is missing; call before a measurement, which takes minutes."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        message = "the report needs matplotlib: pip install 'facerender[measure]'"
        raise InputError(message) from None


def trade(panels: Mapping[str, tuple[Sequence[Row], str]], cost: str) -> bytes:
    """Plot error over cost, one panel per model, with a line through non-dominated variants.

    Parameters
    ----------
    panels : for each panel, keyed by title: the rows, and the label of the error axis
    cost : label of the cost axis
    """
    from matplotlib.lines import Line2D

    with _figure(3.9 * len(panels)) as figure:
        all_axes = figure.subplots(len(panels), squeeze=False)[:, 0]
        points = []
        for axes, (title, (rows, error)) in zip(all_axes, panels.items(), strict=True):
            axes.set(title=title, xlabel=cost, ylabel=error.replace(", ", ",\n", 1), yscale="log")
            points.append(_points(axes, rows))
        keys = [Line2D([], [], ls="", label=name, **style) for name, style in MARKERS.items()]
        figure.legend(handles=keys, loc="outside upper center", ncols=3, frameon=False)
        _lay_out(figure)  # labels can be measured only after the layout
        for axes, named in zip(all_axes, points, strict=True):
            _label(axes, named)
        return _png(figure)


def angles(degrees: Sequence[float], curves: Curves, title: str) -> bytes:
    """Plot the errors of lobes over the angle of the half vector, one panel per m.

    Parameters
    ----------
    degrees : angles γ of the half vector, in degrees
    curves : errors in percent of the lobe's peak, one per angle; keyed by lobe, then by m
    """
    slopes = sorted({m for errors in curves.values() for m in errors}, key=float)
    with _figure(1.9 * len(slopes) + 1.0) as figure:
        all_axes = figure.subplots(len(slopes), sharex=True, squeeze=False)[:, 0]
        for axes, m in zip(all_axes, slopes, strict=True):
            for lobe, errors in curves.items():
                if m in errors:
                    axes.plot(degrees, errors[m], color=COLOURS[lobe], lw=1.3)
            axes.set_yscale("asinh", linear_width=0.03)
            peaks = [np.abs(errors[m]).max() for errors in curves.values() if m in errors]
            largest = max(0.1, *peaks)
            decades = 10.0 ** np.arange(-1, max(1, int(np.ceil(np.log10(largest)))))
            ticks = [*-decades[::-1], 0.0, *decades]
            axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.set_yticks([], minor=True)
            axes.set_ylim(-2.0 * largest, 2.0 * largest)
            axes.set_title(f"m = {m}", loc="left")
        all_axes[-1].set(xlabel="angle γ of the half vector, degrees", xlim=(0.0, degrees[-1]))
        for lobe in curves:
            all_axes[0].plot([], color=COLOURS[lobe], label=lobe)
        figure.suptitle(f"{title}: approximated minus exact lobe")
        figure.supylabel("error of the lobe, % of its peak")
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
        _lay_out(figure)
        return _png(figure)


def strip(images: Sequence[NDArray[np.uint8]]) -> bytes:
    """Encode images of equal height, (H, W, 3), side by side as PNG."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.hstack(images)).save(file, "PNG", optimize=True)
    return file.getvalue()


@contextmanager
def _figure(height: float) -> Iterator[Any]:
    """Yield a figure with the Agg backend and matplotlib's default style, not the user's style."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    changes = {"axes.grid": True, "grid.color": "#e6e6e6", "axes.axisbelow": True}
    with style.context(["default", changes | {"font.size": 10, "axes.titlesize": "medium"}]):
        figure = Figure((WIDTH, height), DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def _lay_out(figure: Any) -> None:
    """Lay out the axes once: repeating the layout in every draw would double the time."""
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine("none")


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.canvas.print_png(file)  # savefig would draw twice
    return file.getvalue()


def _points(axes: Any, rows: Sequence[Row]) -> list[tuple[float, float, Row]]:
    """Draw each row's point and cost interval, and a line through the non-dominated rows.

    Return cost, plotted error and row of each point.
    """
    points = [
        (row.cost.value, max(row.error, EXACT), row)
        for row in rows
        if row.cost is not None and row.error is not None
    ]
    frontier = [(x, y) for x, y, row in points if not (row.dominated or row.variant.printed)]
    for (x, y), (dearer, less) in pairwise(frontier):
        axes.plot((x, dearer), (y, y), color="#999999", lw=1, zorder=1)
        axes.plot((dearer, dearer), (y, less), color="#999999", lw=1, zorder=1)
    ends = [(row.cost.low, row.cost.high) for _, _, row in points if row.cost]
    for (x, y, row), interval in zip(points, ends, strict=True):
        state = "dominated" if row.dominated else "not dominated"
        state = "as published" if row.variant.printed else state
        style = MARKERS[state] | {"color": COLOURS[row.variant.lobe]}
        axes.plot(interval, (y, y), color=style["color"], lw=1, zorder=2)
        axes.plot(x, y, ls="", zorder=3, **style)
    low, high = np.min(ends), np.max(ends)
    half = 0.6 * max(high - low, 0.1 * high)  # a difference of a few percent must look small
    axes.set_xlim(max(0.0, (low + high) / 2.0 - half), (low + high) / 2.0 + half)
    axes.set_ylim(EXACT / 3.0, 3.0 * max(1.0, *(y for _, y, _ in points)))
    ticks = 10.0 ** np.arange(-2, np.ceil(np.log10(axes.get_ylim()[1])))
    axes.set_yticks(ticks, ["exact", *(f"{tick:g}" for tick in ticks[1:])])
    return points


def _label(axes: Any, points: Sequence[tuple[float, float, Row]]) -> None:
    """Write each point's name at the nearest position that overlaps no name, point or line."""
    from matplotlib.text import Text

    frame, renderer = axes.get_window_extent(), axes.figure.canvas.get_renderer()
    taken = [line.get_window_extent() for line in axes.lines]
    places = list(product(_DISTANCES, _DIRECTIONS))
    for x, y, row in points:
        colour = COLOURS[row.variant.lobe]
        for distance, (right, up) in places:
            note = axes.annotate(
                row.variant.name,
                (x, y),
                (distance * right, distance * up),
                textcoords="offset points",
                ha=("center", "left", "right")[right],
                va=("center", "bottom", "top")[up],
                color=colour,
                arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6},
            )
            note.set_in_layout(False)
            note.update_positions(renderer)
            box = Text.get_window_extent(note)  # without the line from the name to its point
            inside = frame.contains(*box.min) and frame.contains(*box.max)
            if (inside and not box.count_overlaps(taken)) or (distance, (right, up)) == places[-1]:
                taken.append(box.padded(3))
                break
            note.remove()
