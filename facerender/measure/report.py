"""Turns a measurement into files: ``measure.json``, plots as PNG, ``index.html``. Tables are made
in ``tables.py``, plots drawn in ``plots.py``."""

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
    "specular term": "Nanoseconds an evaluation of the whole term from N, L and V, all cores or"
    " units together: the slope of time over the number of evaluations, less that of an empty"
    " loop; processor time over the number of cores where the CPU draws. The terms take turns;"
    " given are the lower quartile of the repeats and its 95 %"
    " interval by bootstrap, and the lobe alone likewise.",
    "whole frame": "Milliseconds to draw the mesh and read the image back, one sample a pixel. The"
    " variants take turns; given are the lower quartile of the repeats and its 95 % interval.",
    "samples": "The time of a frame over that of one with one sample, in turns, the median; the"
    " error of the displayed image against 64 samples, at pixels that the mesh covers in part, and"
    " inside. Per-pixel shading: one triangle of a pixel for all that its samples see.",
    "parts of skin": "The time of a frame with one sample over that of the part's first setting, in"
    " turns, the median; the error of the displayed image against the part's last setting.",
    "error of the lobe": "Percent of the lobe's peak: the largest difference from the exact lobe,"
    " both in float64, over 0 to 90 degrees of the half vector's angle γ.",
    "error of the BRDF": "Percent of the largest exact f N.L: the largest difference, in float64,"
    " over directions of light and camera.",
    "error of the image": "The image that OpenGL draws against float64 shading of the same G-buffer"
    " with the exact lobe. Percent of max(reference, 0.01), linear radiance, over covered pixels;"
    " steps are those of the displayed 8-bit image.",
}
DOMINATED = (
    "Dominated: another variant of the model is not dearer and not less exact, and better in one of"
    f" the two. Costs whose intervals overlap count as equal, errors up to {EXACT:g} % as none, for"
    " float32 leaves as much. Forms as printed give NaN in some directions, and dominate nothing;"
    " D16 as printed has no clamp."
)


JSON, PAGE = "measure.json", "index.html"


@dataclass(frozen=True)
class Figure:
    """A PNG file with its caption."""

    file: str
    png: bytes
    caption: str


def write(measurement: Measurement, triptychs: Sequence[Triptych], directory: Path) -> list[Path]:
    """Write measure.json, plots and index.html, each whole or not at all, and return their paths.

    Everything is drawn before the first file is written. The directory is made where it is missing.

    Raises
    ------
    InputError : matplotlib is missing, or the directory cannot be written
    ValueError : NaN or infinity in the measurement, which JSON does not know
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
    """Write files by name, each whole or not at all, and return their paths; the directory is made.

    Raises
    ------
    InputError : the directory cannot be made or written
    """
    make_folder(directory)
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def table(measurement: Measurement) -> str:
    """Return cost beside error for a terminal: a table for each kind of cost and each model, and
    one each for samples and for parts of skin."""
    tables = [*cost_tables(measurement), sample_table(measurement), skin_table(measurement)]
    return "\n\n".join(table.text() for table in tables)


def _trades(measurement: Measurement) -> list[Figure]:
    """Error over cost, for each kind of cost that was measured."""
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
            caption = f"Error over cost, {kind.title}. The line joins what nothing dominates."
            figures.append(Figure(f"trade-{kind.title.split()[-1]}.png", png, caption))
    return figures


def _curves(measurement: Measurement) -> list[Figure]:
    figures = []
    for model, curves in measurement.curves.items():
        png = plots.angles(measurement.degrees, curves, MODELS[model])
        caption = (
            f"{MODELS[model]}: each lobe less the exact one, over the angle of the half vector. The"
            " scale is linear around 0 and becomes logarithmic at 0.1 %."
        )
        figures.append(Figure(f"angles-{model}.png", png, caption))
    return figures


def _strip(triptych: Triptych, slope: str) -> Figure:
    """Exact, approximated, and their difference."""
    png = plots.strip([triptych.exact, triptych.image, triptych.difference])
    caption = (
        f"{MODELS[triptych.model]}, m = {slope}: left exact, middle {triptych.lobe}, right"
        f" {MAGNIFIED} times their difference."
    )
    return Figure(f"images-{triptych.model}-{triptych.lobe}.png", png, caption)


def _page(
    measurement: Measurement,
    trades: Iterable[Figure],
    curves: Iterable[Figure],
    strips: Iterable[Figure],
) -> str:
    """Everything in one file of HTML that fetches nothing."""
    content, settings = measurement.as_dict(), measurement.settings
    size = {"size": "{} x {}".format(*settings.size)}
    facts = (content["environment"] | content["settings"] | size).items()
    fact_rows = [row(escape(name), [escape(_fact(value))]) for name, value in facts]
    missing = measurement.not_measured or ["nothing"]
    body = [
        page_table("facts", (), fact_rows, "Measured on, and with"),
        "<h2>Cost beside error</h2>",
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
        f"<ul>{''.join(f'<li>{escape(what)}</li>' for what in missing)}</ul>",
        "<h2>Where the figures come from</h2>",
        "<dl>",
        *(f"<dt>{escape(what)}</dt><dd>{escape(how)}</dd>" for what, how in METHODS.items()),
        "</dl>",
    ]
    return document("What specular terms cost and lose", "\n".join(body))


def _fact(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def _figures(figures: Iterable[Figure]) -> str:
    return "\n".join(figure(each.png, each.caption) for each in figures)


def _html(table: Table, kind: str) -> str:
    """Lay a table out, rows that are dominated in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    rows = [
        row(escape(name), map(escape, cells), "dominated" if name in table.dominated else "")
        for name, *cells in table.rows
    ]
    caption = f"<span>{escape(table.title)}</span><small>{escape(table.note)}</small>"
    return page_table(kind, map(escape, table.head), rows, caption)
