"""Plots of a measurement as PNG in memory; needs matplotlib (extra ``measure``).

``report.py`` selects the data.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.measure.measurement import Curves
from facerender.terms import LOBES

WIDTH = 6.4  # inches: the text stays legible on a phone
DPI = 110
COLOURS = {name: lobe.colour for name, lobe in LOBES.items()}


def available() -> bool:
    """Return whether matplotlib is installed; without it, only :func:`strip` works."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def check() -> None:
    """Raise InputError if matplotlib is missing; call before a measurement, which takes minutes."""
    if not available():
        raise InputError("the report needs matplotlib: pip install 'facerender[measure]'")


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
