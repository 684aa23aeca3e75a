"""Turns a measurement into files: ``measure.json``, plots as PNG, ``index.html``. Tables are made
in ``tables.py``, plots drawn in ``plots.py``."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from facerender.errors import InputError, reason
from facerender.image import write_bytes
from facerender.measure import plots
from facerender.measure.measurement import MAGNIFIED, MODELS, Measurement, Triptych
from facerender.measure.pareto import EXACT, KINDS, measure_of, pareto
from facerender.measure.tables import ERRORS, NOT_MEASURED, Table, cost_tables, error_tables

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


@dataclass(frozen=True)
class Figure:
    """A PNG file, and what is said under it."""

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
        "measure.json": content.encode(),
        **{figure.file: figure.png for figure in (*trades, *curves, *strips)},
        "index.html": _page(measurement, trades, curves, strips).encode(),
    }
    return write_files(directory, files)


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
    """Return cost beside error for a terminal: a table for each kind of cost and each model."""
    return "\n\n".join(table.text() for table in cost_tables(measurement))


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
    caption = (
        f"{MODELS[triptych.model]}, m = {slope}: left exact, middle {triptych.lobe}, right"
        f" {MAGNIFIED} times their difference."
    )
    return Figure(f"images-{triptych.model}-{triptych.lobe}.png", png, caption)


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>What specular terms cost and lose</title>
<style>
:root {{ color-scheme: light dark; font: 1rem/1.5 system-ui, sans-serif; }}
body {{ max-width: 84rem; margin: 0 auto; padding: 0 1rem 3rem; }}
h1 {{ line-height: 1.2; }}
h2 {{ margin-top: 2.5rem; }}
p, dd, li, figcaption {{ max-width: 44rem; }}
dt {{ font-weight: bold; }}
dd {{ margin: 0 0 0.8rem; }}
.pair {{ display: grid; gap: 0 2rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 34rem), 1fr)); }}
.pair > * {{ min-width: 0; }}
.wide {{ overflow-x: auto; }}
table {{ border-collapse: collapse; margin: 0 0 1.5rem; }}
caption {{ text-align: left; font-weight: bold; }}
caption span, caption small {{ display: block; max-width: calc(100vw - 2rem); }}
caption small {{ font-weight: normal; }}
th, td {{ padding: 0.2rem 0.5rem; font-size: 0.85rem; text-align: right;
  border-bottom: 1px solid color-mix(in srgb, CanvasText 20%, Canvas); }}
thead th {{ vertical-align: bottom; }}
tbody th {{ font-weight: normal; }}
td {{ font-family: ui-monospace, monospace; }}
th:first-child, .facts td, .costs :nth-child(2) {{ text-align: left; }}
td + td {{ white-space: nowrap; }}
.facts td {{ overflow-wrap: anywhere; }}
.dominated {{ color: color-mix(in srgb, CanvasText 60%, Canvas); }}
figure {{ margin: 0 0 1.5rem; font-size: 0.9rem; }}
img {{ display: block; width: 100%; max-width: 60rem; height: auto; }}
@media (max-width: 40rem) {{ th, td {{ padding: 0.2rem 0.25rem; font-size: 0.75rem; }} }}
</style>
</head>
<body>
<h1>What specular terms cost and lose</h1>
<table class="facts">
<caption>Measured on, and with</caption>
<tbody>
{facts}
</tbody>
</table>
<h2>Cost beside error</h2>
<p>{dominated}</p>
{costs}
<div class="pair">
{trades}
</div>
<h2>Error over the angle</h2>
<div class="pair">
{curves}
</div>
<h2>Errors</h2>
{errors}
<h2>Images</h2>
{strips}
<h2>Not measured</h2>
<ul>
{missing}
</ul>
<h2>Where the figures come from</h2>
<dl>
{methods}
</dl>
</body>
</html>
"""


def _page(
    measurement: Measurement,
    trades: Iterable[Figure],
    curves: Iterable[Figure],
    strips: Iterable[Figure],
) -> str:
    """Everything in one file of HTML that fetches nothing."""
    content, settings = measurement.as_dict(), measurement.settings
    size = {"size": "{} x {}".format(*settings.size)}
    facts = content["environment"] | content["settings"] | size
    return _PAGE.format(
        facts="\n".join(
            f'<tr><th scope="row">{escape(key)}</th><td>{escape(_fact(value))}</td></tr>'
            for key, value in facts.items()
        ),
        dominated=escape(DOMINATED),
        costs="\n".join(_html(table, "costs") for table in cost_tables(measurement)),
        trades="\n".join(map(_figure, trades)),
        curves="\n".join(map(_figure, curves)) or f"<p>{NOT_MEASURED}.</p>",
        errors="\n".join(_html(table, "errors") for table in error_tables(measurement)),
        strips="\n".join(map(_figure, strips)) or f"<p>{NOT_MEASURED}.</p>",
        missing="\n".join(
            f"<li>{escape(what)}</li>" for what in measurement.not_measured or ["nothing"]
        ),
        methods="\n".join(
            f"<dt>{escape(what)}</dt><dd>{escape(how)}</dd>" for what, how in METHODS.items()
        ),
    )


def _fact(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def _figure(figure: Figure) -> str:
    source = "data:image/png;base64," + b64encode(figure.png).decode()
    caption = escape(figure.caption)
    return (
        f'<figure><img src="{source}" alt="{caption}"><figcaption>{caption}</figcaption></figure>'
    )


def _html(table: Table, kind: str) -> str:
    """Lay a table out, rows that are dominated in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.head)
    rows = []
    for name, *cells in table.rows:
        grey = ' class="dominated"' if name in table.dominated else ""
        values = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
        rows.append(f'<tr{grey}><th scope="row">{escape(name)}</th>{values}</tr>')
    return "\n".join(
        [
            f'<div class="wide"><table class="{kind}">',
            f"<caption><span>{escape(table.title)}</span><small>{escape(table.note)}</small></caption>",
            f"<thead><tr>{head}</tr></thead>",
            "<tbody>",
            *rows,
            "</tbody></table></div>",
        ]
    )
