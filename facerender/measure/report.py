"""Writes a measurement to files: ``measure.json``, plots as PNG, and the page ``index.html``.

``tables.py`` makes the tables, ``plots.py`` draws the plots.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from facerender.measure import plots
from facerender.measure.measurement import MAGNIFIED, MODELS, Measurement, Triptych
from facerender.measure.pareto import EXACT, KINDS, measure_of, pareto
from facerender.measure.tables import (
    ERRORS,
    NOT_MEASURED,
    Table,
    cost_tables,
    error_tables,
    sample_table,
    skin_table,
)
from facerender.page.document import document, figure, row
from facerender.page.document import table as page_table
from facerender.system.atomic import make_folder, write_bytes

METHODS = {
    "specular term": "The time of one evaluation of the whole term from N, L and V, on all cores or"
    " GPU units together: the slope of the time over the number of evaluations, minus the slope of"
    " an empty loop. If the CPU draws, processor time divided by the number of cores is measured."
    " The terms are timed in turns. The value is the lower quartile of the repeats, with a 95 %"
    " bootstrap interval. The lobe alone is measured in the same way.",
    "whole frame": "The time to draw the mesh with one sample per pixel and to read the image back."
    " The variants are timed in turns. The value is the lower quartile of the repeats, with a 95 %"
    " interval.",
    "samples": "The frame time is the median ratio to the time of a frame with one sample per"
    " pixel; frames are drawn in turns. The displayed image is compared with an image of 64"
    " samples, at pixels that the mesh covers partly (silhouette) and fully (inside). Per-pixel"
    " shading shades one triangle per pixel and part for all samples.",
    "parts of skin shading": "Frames have one sample per pixel. The frame time is the median ratio"
    " to the time of the part's first setting; frames are drawn in turns. The displayed image is"
    " compared with the image of the part's last setting.",
    "error of the lobe": "The largest difference from the exact lobe in percent of the lobe's peak,"
    " for angles γ of the half vector from 0 to 90 degrees. Both lobes are computed in float64.",
    "error of the BRDF": "The largest difference from the exact f N.L over directions of light and"
    " camera, in percent of the largest exact f N.L. Both are computed in float64.",
    "error of the image": "The OpenGL image is compared with float64 shading of the same G-buffer"
    " with the exact lobe, at covered pixels. Errors of linear radiance are in percent of"
    " max(reference, 0.01). Levels are 1/255 of the range of the displayed 8-bit image.",
}
DOMINATED = (
    "Dominated: another variant of the model is at least as cheap and as exact, and better in cost"
    " or error. Costs with overlapping intervals count as equal. Errors up to"
    f" {EXACT:g} % count as zero, because float32 causes errors of this size. Forms as published"
    " return NaN in some directions, and dominate no other variant; D16 as published has no clamp."
)


JSON, PAGE = "measure.json", "index.html"


@dataclass(frozen=True)
class Figure:
    """A PNG file with its caption."""

    file: str
    png: bytes
    caption: str


def write(measurement: Measurement, triptychs: Sequence[Triptych], directory: Path) -> list[Path]:
    """Write measure.json, plots and index.html atomically, and return their paths.

    All plots are drawn before the first file is written. A missing directory is created.

    Raises
    ------
    InputError : matplotlib is missing, or the directory is not writable
    ValueError : the measurement contains NaN or infinity, which JSON cannot represent
    """
    plots.check()
    content = json.dumps(measurement.as_dict(), indent=1, allow_nan=False) + "\n"
    trades, curves = _trades(measurement), _curves(measurement)
    strips = [_strip(triptych, measurement.settings.slope) for triptych in triptychs]
    files = {
        JSON: content.encode(),
        **{plot.file: plot.png for plot in (*trades, *curves, *strips)},
        PAGE: _page(measurement, trades, curves, strips).encode(),
    }
    return write_files(directory, files)


def write_files(directory: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write files, keyed by file name, atomically to a directory, and return their paths.

    A missing directory is created.

    Raises
    ------
    InputError : the directory cannot be created, or is not writable
    """
    make_folder(directory)
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def table(measurement: Measurement) -> str:
    """Return tables of cost and error as text for a terminal.

    There is one table for each combination of model and kind of cost, one table for samples per
    pixel, and one table for the parts of skin shading.
    """
    tables = [*cost_tables(measurement), sample_table(measurement), skin_table(measurement)]
    return "\n\n".join(table.text() for table in tables)


def _trades(measurement: Measurement) -> list[Figure]:
    """Return plots of error over cost, one for each measured kind of cost."""
    figures = []
    for kind in KINDS:
        panels = {}
        for model, name in MODELS.items():
            rows = pareto(measurement, model, kind)
            if any(row.cost is not None and row.error is not None for row in rows):
                title = f"{name}, m = {measurement.settings.slope}: {kind.title}"
                panels[title] = (rows, ERRORS[measure_of(measurement, model)])
        if panels:
            png = plots.trade(panels, f"cost, {kind.unit}")
            caption = f"Error over cost, {kind.title}. The line joins the variants not dominated."
            figures.append(Figure(f"trade-{kind.title.split()[-1]}.png", png, caption))
    return figures


def _curves(measurement: Measurement) -> list[Figure]:
    figures = []
    for model, curves in measurement.curves.items():
        png = plots.angles(measurement.degrees, curves, MODELS[model])
        caption = (
            f"{MODELS[model]}: each lobe minus the exact lobe, over the angle of the half vector."
            " The error axis is linear around 0, and logarithmic from about 0.1 %."
        )
        figures.append(Figure(f"angles-{model}.png", png, caption))
    return figures


def _strip(triptych: Triptych, slope: str) -> Figure:
    """Return a figure of the exact image, the approximated image, and their difference."""
    png = plots.strip([triptych.exact, triptych.image, triptych.difference])
    caption = (
        f"{MODELS[triptych.model]}, m = {slope}: exact (left), {triptych.lobe} (middle), and"
        f" {MAGNIFIED} times their difference (right)."
    )
    return Figure(f"images-{triptych.model}-{triptych.lobe}.png", png, caption)


def _page(
    measurement: Measurement,
    trades: Iterable[Figure],
    curves: Iterable[Figure],
    strips: Iterable[Figure],
) -> str:
    """Return the page: one self-contained HTML file."""
    content, settings = measurement.as_dict(), measurement.settings
    size = {"size": "{} x {}".format(*settings.size)}
    facts = (content["environment"] | content["settings"] | size).items()
    fact_rows = [row(escape(name), [escape(_fact(value))]) for name, value in facts]
    missing = measurement.not_measured or ["nothing"]
    body = [
        page_table("facts", (), fact_rows, "Machine and settings"),
        "<h2>Cost and error</h2>",
        f"<p>{escape(DOMINATED)}</p>",
        *(_html(table, "numbers costs") for table in cost_tables(measurement)),
        f'<div class="pair">{_figures(trades)}</div>',
        "<h2>Error over the angle</h2>",
        f'<div class="pair">{_figures(curves)}</div>',
        "<h2>Errors</h2>",
        *(_html(table, "numbers") for table in error_tables(measurement)),
        _html(sample_table(measurement), "numbers"),
        _html(skin_table(measurement), "numbers"),
        "<h2>Images</h2>",
        _figures(strips),
        "<h2>Not measured</h2>",
        f"<ul>{''.join(f'<li>{escape(each)}</li>' for each in missing)}</ul>",
        "<h2>How the values are measured</h2>",
        "<dl>",
        *(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in METHODS.items()),
        "</dl>",
    ]
    return document("Cost and error of specular terms", "\n".join(body))


def _fact(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def _figures(figures: Iterable[Figure]) -> str:
    return "\n".join(figure(each.png, each.caption) for each in figures)


def _html(table: Table, kind: str) -> str:
    """Return a table as HTML, with dominated rows in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    rows = [
        row(escape(name), map(escape, cells), "dominated" if name in table.dominated else "")
        for name, *cells in table.rows
    ]
    caption = f"<span>{escape(table.title)}</span><small>{escape(table.note)}</small>"
    return page_table(kind, map(escape, table.head), rows, caption)
