"""Turns a measurement into files: ``measure.json``, plots as PNG, ``index.html``. Tables are made
in ``tables.py``, plots drawn in ``plots.py``."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

from facerender.errors import InputError, reason
from facerender.measure import plots
from facerender.measure.imported import Imported
from facerender.measure.measurement import MAGNIFIED, MODELS, Measurement, Triptych
from facerender.measure.pareto import EXACT, KINDS, measure_of, pareto
from facerender.measure.tables import (
    ERRORS,
    NOT_MEASURED,
    Table,
    cost_tables,
    error_tables,
    import_tables,
    sample_table,
    skin_table,
)
from facerender.page.document import document, figure, row
from facerender.page.document import table as page_table
from facerender.system.atomic import write_bytes

_ACO = (
    "Cycles for which a wave of 64 keeps the vector ALU busy, less those of a kernel without the"
    " term, as ACO estimates them, the compiler of Mesa's driver for AMD. Nothing ran on such a"
    " GPU."
)
METHODS = {
    "specular term": "Nanoseconds an evaluation of the whole term from N, L and V, all cores or"
    " units together: the slope of time over the number of evaluations, less that of an empty"
    " loop; processor time over the number of cores where the CPU draws. The terms take turns;"
    " given are the lower quartile of the repeats and its 95 %"
    " interval by bootstrap, and the lobe alone likewise.",
    "whole frame": "Milliseconds to draw the mesh and read the image back, one sample a pixel. The"
    " variants take turns; given are the lower quartile of the repeats and its 95 % interval.",
    "AMD Navi 21, Vega 10": _ACO,
    "samples": "The time of a frame over that of one with one sample, in turns, the median; the"
    " error of the displayed image against 64 samples, at pixels that the mesh covers in part, and"
    " inside. Per-pixel shading: one triangle of a pixel for all that its samples see.",
    "parts of skin": "The time of a frame with one sample over that of the part's first setting, in"
    " turns, the median; the error of the displayed image against the part's last setting.",
    "GPUs, in the explorer": "Milliseconds by which one more shading of what is seen makes"
    " drawing longer, in the browser that is named in measure.json, by the GPU's own clock or until"
    " a pixel can be read; A, B and the picture without highlights take turns. Imported.",
    "error of the lobe": "Percent of the lobe's peak: the largest difference from the exact lobe,"
    " both in float64, over 0 to 90 degrees of the half vector's angle γ.",
    "error of the BRDF": "Percent of the largest exact f N.L: the largest difference, in float64,"
    " over directions of light and eye.",
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
_ELSEWHERE = "move it away, or give another folder"


@dataclass(frozen=True)
class Figure:
    """A PNG file, and what is said under it."""

    file: str
    png: bytes
    caption: str


def write(
    measurement: Measurement, triptychs: Sequence[Triptych] | None, directory: Path
) -> list[Path]:
    """Write measure.json, plots and index.html, each whole or not at all, and return their paths.

    Everything is drawn before the first file is written. The directory is made where it is missing.

    Parameters
    ----------
    triptychs : None for those whose files are in the directory

    Raises
    ------
    InputError : matplotlib is missing, or the directory cannot be read or written
    ValueError : NaN or infinity in the measurement, which JSON does not know
    """
    plots.check()
    content = json.dumps(measurement.as_dict(), indent=1, allow_nan=False) + "\n"
    trades, curves = _trades(measurement), _curves(measurement)
    if triptychs is None:
        strips = _strips_in(directory, measurement)
    else:
        strips = [_strip(triptych, measurement.settings.slope) for triptych in triptychs]
    files = {
        JSON: content.encode(),
        **{drawn.file: drawn.png for drawn in (*trades, *curves, *strips)},
        PAGE: _page(measurement, trades, curves, strips).encode(),
    }
    return write_files(directory, files)


def read(directory: Path) -> Measurement | None:
    """Return the measurement that :func:`write` left in a directory, None where there is none.

    Raises
    ------
    InputError : a measure.json that is damaged, or of another version
    """
    content = _content(directory)
    if content is None:
        return None
    try:
        return Measurement.from_dict(content)
    except InputError as error:
        raise InputError(f"{directory / JSON}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(f"{directory / JSON} is no measurement; {_ELSEWHERE}") from None


def read_imports(directory: Path) -> list[Imported]:
    """Return the imports of the measurement in a directory, of whatever version it is, so that
    another one keeps them.

    Raises
    ------
    InputError : a measure.json that is no JSON, or whose imports are damaged
    """
    content = _content(directory)
    rows = content.get("imports", []) if isinstance(content, dict) else []
    try:
        if not isinstance(rows, list):
            raise InputError("imports is no list")
        return [Imported.from_dict(row) for row in rows]
    except InputError as error:
        raise InputError(f"{directory / JSON}: {error}; {_ELSEWHERE}") from None


def _content(directory: Path) -> Any:
    """What measure.json holds, None where there is none."""
    path = directory / JSON
    data = _bytes_of(path) if os.path.exists(path) else b"null"
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        raise InputError(f"{path} is no JSON; {_ELSEWHERE}") from None


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}; {_ELSEWHERE}") from None


def write_files(directory: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write files by name, each whole or not at all, and return their paths; without files, only
    make the directory.

    Raises
    ------
    InputError : the directory cannot be made or written
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = reason(error)
        raise InputError(f"cannot make {directory}: {why}; give a writable place") from None
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def table(measurement: Measurement) -> str:
    """Return cost beside error for a terminal: a table for each kind of cost and each model, and
    one each for samples, for parts of skin and for each import."""
    tables = [*cost_tables(measurement), sample_table(measurement), skin_table(measurement)]
    tables += import_tables(measurement)
    return "\n\n".join(table.text() for table in tables)


def markdown(measurement: Measurement) -> str:
    """Return the tables of ``table``, and the errors alone, as Markdown."""
    tables = cost_tables(measurement) + error_tables(measurement)
    return "\n\n".join(table.markdown() for table in tables)


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
            figures.append(Figure(f"trade-{kind.field.replace('_', '-')}.png", png, caption))
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
    return _strip_of(triptych.model, triptych.lobe, slope, png)


def _strip_of(model: str, lobe: str, slope: str, png: bytes) -> Figure:
    caption = (
        f"{MODELS[model]}, m = {slope}: left exact, middle {lobe}, right"
        f" {MAGNIFIED} times their difference."
    )
    return Figure(f"images-{model}-{lobe}.png", png, caption)


def _strips_in(directory: Path, measurement: Measurement) -> list[Figure]:
    """Those of the measurement whose files are there."""
    pairs = dict.fromkeys((row.variant.model, row.variant.lobe) for row in measurement.variants)
    strips = [_strip_of(*pair, measurement.settings.slope, b"") for pair in pairs]
    there = [strip for strip in strips if (directory / strip.file).exists()]
    return [replace(strip, png=_bytes_of(directory / strip.file)) for strip in there]


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
        *(_html(table, "numbers") for table in import_tables(measurement)),
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
    return "\n".join(figure(drawn.png, drawn.caption) for drawn in figures)


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
