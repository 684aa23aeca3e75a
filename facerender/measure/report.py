"""Writes a measurement to files: ``measure.json``, images as PNG, and the page ``index.html``."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from facerender.glsl.library import lobe_macros
from facerender.measure import chart
from facerender.measure.chart import EXACT, FRAME, LIMITS, TERM, CostKind, Row, pareto, recommended
from facerender.measure.measurement import (
    MAGNIFIED,
    MODELS,
    Measurement,
    Triptychs,
    rows_of,
    slope_of,
)
from facerender.page import document, figure
from facerender.page import row as table_row
from facerender.page import table as page_table
from facerender.pricing.cost import Interval, Variant
from facerender.system.files import make_folder, write_bytes

ERRORS = {
    "image": "largest error of a pixel, % of max(exact radiance, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
# Titles of the columns that are aligned to the left.
_LEFT = ("variant", "lobe", "remark", "shading", "render option", "shader macros")


@dataclass(frozen=True)
class Table:
    """A table of text cells; without rows, it stands for values that were not measured."""

    title: str
    note: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()  # the first cell of a row is its name
    dominated: Collection[str] = ()  # names of the dominated rows

    def text(self) -> str:
        """Return the table as text for a terminal."""
        if not self.rows:
            return f"{self.title}: {NOT_MEASURED}"
        lines = [self.head, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        signs = ["<" if name in _LEFT else ">" for name in self.head]
        row = "  " + "  ".join(map("{{:{}{}}}".format, signs, widths))
        return "\n".join([self.title, self.note, *(row.format(*line).rstrip() for line in lines)])


def advice(measurement: Measurement, model: str) -> str:
    """Return a sentence with the recommended variants of a model."""
    best = recommended(measurement, model)
    start = f"{MODELS[model]} at m = {slope_of(measurement)}: "
    if not best:
        return f"{start}no variant has an error of at most {LIMITS[-1]:g} %."
    parts = []
    for (limit, *_), row in best:
        allowed = f" if an error of {limit:g} % is acceptable" if limit > EXACT else ""
        error = row.error or 0.0
        size = f"below {EXACT:g} %" if error <= EXACT else f"{_number(error)} %"
        cost = _number(row.cost.value)
        parts.append(f'"{row.variant.name}"{allowed} ({cost} ns per evaluation, error {size})')
    ending = f"; no variant with an error of at most {LIMITS[-1]:g} % is measurably cheaper"
    return f"{start}use {', or '.join(parts)}{ending * (len(parts) == 1)}."


def frame_advice(measurement: Measurement, model: str) -> str:
    """Return the time of a frame with the exact lobe, and the faster lobes; "" if not measured.

    A lobe is faster if both the frame and the specular term are measurably cheaper: noise alone can
    make a frame cheaper.
    """
    rows = pareto(measurement, model, FRAME)
    best = next((row for row in rows if row.variant.lobe == "exact"), None)
    if best is None:
        return ""
    exact, term = best.cost, best.measured["cost"]["term_ns"]
    allowed = f"with an error of at most {LIMITS[-1]:g} %"
    faster = [
        f"{row.variant.name} ({_number(row.cost.value)} ms)"
        for row in rows
        if row.cost.high < exact.low
        and row.measured["cost"]["term_ns"]["high"] < term["low"]
        and (row.error or 0.0) <= LIMITS[-1]
    ]
    names = f"Faster lobes {allowed}: {', '.join(faster)}."
    sentence = names if faster else f"No lobe {allowed} is measurably faster."
    time = f"{_number(exact.value)} ms (95 % interval {_cell(exact)})"
    size = "{} x {} pixels".format(*measurement["settings"]["size"])
    return f"{MODELS[model]}: the exact lobe draws a frame of {size} in {time}. {sentence}"


def recommendation_table(measurement: Measurement, model: str) -> Table:
    """Return the table of a model's recommended variants, and how to select them."""
    error = ERRORS[chart.measure_of(measurement, model)]
    frames = {row.variant.lobe: row.cost for row in pareto(measurement, model, FRAME)}
    rows = []
    for limits, row in recommended(measurement, model):
        variant, cost = row.variant, row.cost
        macros = lobe_macros(variant.lobe) | ({"FR_SMALL_SLOPE": "0"} if variant.plain else {})
        rows.append(
            {
                "limit of the error, %": ", ".join(f"{limit:g}" for limit in limits),
                "variant": variant.name,
                "error, %": _number(row.error),
                "ns per evaluation": _number(cost.value),
                "95 % interval, ns": _cell(cost),
                "95 % interval of a frame, ms": _cell(frames.get(variant.lobe)),
                "render option": f"--lobe {variant.lobe}",
                "shader macros": ", ".join(f"{name} {value}" for name, value in macros.items()),
            }
        )
    title = f"{MODELS[model]}, m = {slope_of(measurement)}: recommended variants"
    note = f"The cheapest term with an error up to the limit. Error: {error}."
    return _table(title, note, rows)


def cost_tables(measurement: Measurement, costs: Iterable[CostKind] = (TERM, FRAME)) -> list[Table]:
    """Return a table for each kind of cost and model, with the cheapest variant first and without
    variants of unknown cost; a kind that was not measured has one table without rows."""
    tables = []
    for cost in costs:
        measured = []
        for model in MODELS:
            rows = pareto(measurement, model, cost)
            exact = next((row.cost for row in rows if row.variant == Variant(model, "exact")), None)
            title = f"{MODELS[model]}, m = {slope_of(measurement)}: {cost.title}"
            note = f"Error: {ERRORS[chart.measure_of(measurement, model)]}."
            cells = [_cost_cells(row, cost, exact) for row in rows]
            dominated = [row.variant.name for row in rows if row.dominated]
            measured += [_table(title, note, cells, dominated)] * bool(rows)
        tables += measured or [Table(cost.title[0].upper() + cost.title[1:])]
    return tables


def _cost_cells(row: Row, cost: CostKind, exact: Interval | None) -> dict[str, str]:
    value = row.cost.value
    remarks = ["as published"] * row.variant.printed + ["dominated"] * row.dominated
    missing = NOT_MEASURED if row.variant.printed else "outside the domain"
    return {
        "variant": row.variant.name,
        "remark": ", ".join(remarks),
        cost.unit: _number(value),
        "cost / exact": f"{value / exact.value:.2f}" if exact else "",
        "error, %": _number(row.error, missing),
        **{title: _cell(column(row.measured)) for title, column in cost.columns.items()},
    }


def error_tables(measurement: Measurement) -> list[Table]:
    """Return three tables per model: image errors at one m, without the lobes whose domain excludes
    m; lobe errors and BRDF errors by m."""
    tables = []
    for model, title in MODELS.items():
        rows = [row for row in rows_of(measurement, model) if row["name"] == row["lobe"]]
        if not rows:
            continue
        note = "Errors of linear radiance in % of max(exact radiance, 0.01); displayed errors in"
        note += " 8-bit levels (1/255)."
        images = [
            {"lobe": row["lobe"], **_image_cells(error)}
            for row in rows
            if (error := row["error"]["image"])
        ]
        name = f"{title}, m = {slope_of(measurement)}: error of the image"
        tables.append(_table(name, note, images))
        slopes = [*rows[0]["error"]["lobe"]]
        for name, note in (
            ("lobe", "Largest error over 0 to 90 degrees, % of the lobe's peak."),
            ("BRDF", "Largest error of the BRDF times N.L, % of its largest exact value."),
        ):
            cells = []
            for row in rows:
                errors = row["error"][name.lower()]
                cells.append([row["lobe"], *(_number(errors[m], "outside") for m in slopes)])
            head = ["lobe", *(f"m = {m}" for m in slopes)]
            tables.append(Table(f"{title}: error of the {name}", note, head, cells))
    return tables


def _table(
    title: str, note: str, rows: Sequence[Mapping[str, str]], dominated: Collection[str] = ()
) -> Table:
    """Return a table without the columns that are empty or were not measured in any row."""
    columns = [(name, *(row[name] for row in rows)) for name in (rows[0] if rows else ())]
    filled = [column for column in columns if {*column[1:]} - {"", NOT_MEASURED}]
    lines = list(zip(*filled, strict=True)) or [()]
    return Table(title, note, lines[0], lines[1:], dominated)


def _image_cells(error: Mapping[str, Any]) -> dict[str, str]:
    values = {
        "largest, %": 100.0 * error["largest"],
        "99.9th percentile, %": 100.0 * error["percentile"],
        "16 x 16 blocks, %": 100.0 * error["block"],
        "beyond 3 x 3 neighbours, radiance": error["point"],
        "displayed, 8-bit levels": error["steps"],
        "99.9th percentile, levels": error["steps_percentile"],
        "mean FLIP": error["flip"],
    }
    return {title: _number(value) for title, value in values.items()}


def _cell(value: float | Interval | None) -> str:
    if isinstance(value, Interval):
        return f"{_number(value.low)} to {_number(value.high)}"
    return _number(value)


def _number(value: float | None, missing: str = NOT_MEASURED) -> str:
    """Format a value with three digits; counts, and values of 100 or more, as integers."""
    if value is None:
        return missing
    if isinstance(value, int) or value == 0.0 or 100.0 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:#.3g}"


METHODS = {
    "specular term": "The time of one evaluation of the whole term from the normal N, the"
    " direction L to the light and the direction V to the camera, on all cores or GPU units"
    " together: the slope of the time over the number of evaluations, minus the slope of an empty"
    " loop. If the CPU draws, processor time divided by the number of cores is measured. The"
    " terms are timed in turns. The value is the lower quartile of the repeats, with a 95 %"
    " bootstrap interval. The lobe alone is measured in the same way.",
    "whole frame": "The time to draw the mesh with one sample per pixel and to read the image"
    " back. The variants are timed in turns. The value is the lower quartile of the repeats, with"
    " a 95 % interval.",
    "error of the lobe": "The largest difference from the exact lobe in percent of the lobe's"
    " peak, for angles γ of 0 to 90 degrees between N and the half vector, which is halfway"
    " between L and V. Both lobes are computed in float64.",
    "error of the BRDF": "The BRDF f is the fraction of light that is reflected from L to V, per"
    " solid angle. The error is the largest difference from the exact f N.L over all L and V, in"
    " percent of the largest exact f N.L. Both are computed in float64.",
    "error of the image": "The OpenGL image is compared with float64 shading of the same G-buffer"
    " with the exact lobe, at covered pixels. Errors of linear radiance are in percent of"
    " max(exact radiance, 0.01). Levels are 1/255 of the range of the displayed 8-bit image."
    " Blocks are means over 16 x 16 pixels. The error beyond 3 x 3 neighbours is the distance of"
    " a pixel from the range of these pixels in the other image, in radiance (white is 1). FLIP"
    " is a perceptual difference between 0 and 1 (Andersson et al. 2020).",
}
INTRODUCTION = (
    "The specular term computes the highlight of a light at a point of the surface. The model is"
    " the whole formula, Cook-Torrance or Ward. Its lobe gives the highlight its shape: the exact"
    " lobe is an exponential function, the other lobes approximate it. A variant is a form of a"
    " model's term; its cost is the time of one evaluation, for one light at one point. The"
    " roughness m is the root mean square (RMS) slope of the skin's microfacets. Other parts,"
    " such as eyes, keep their own m; the error of the image includes them."
)
DOMINATED = (
    "In the charts, lower left is better: filled points are the best variants, hollow points are"
    " dominated, horizontal bars are 95 % intervals of the cost. "
    "Dominated: another variant of the model is at least as cheap and as exact, and better in cost"
    " or error. Costs with overlapping intervals count as equal. Errors up to"
    f" {EXACT:g} % count as zero, because float32 causes errors of this size. Forms as published"
    " return NaN in some directions, and dominate no other variant; D16 as published has no clamp."
)

JSON, PAGE = "measure.json", "index.html"


def write(measurement: Measurement, triptychs: Triptychs, directory: Path) -> list[Path]:
    """Write measure.json, images and index.html atomically, and return their paths.

    All images are encoded before the first file is written. A missing directory is created.
    """
    from PIL import Image

    text = json.dumps(content(measurement), indent=1, allow_nan=False) + "\n"
    images, captions = {}, []
    for (model, lobe), pixels in triptychs.items():
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG", optimize=True)
        images[f"images-{model}-{lobe}.png"] = file.getvalue()
        captions.append(
            f"{MODELS[model]}, m = {slope_of(measurement)}: exact (left), {lobe} (middle), and"
            f" {MAGNIFIED} times their difference (right)."
        )
    page = _page(measurement, map(figure, images.values(), captions))
    return write_files(directory, {JSON: text.encode(), **images, PAGE: page.encode()})


def content(measurement: Measurement) -> dict[str, Any]:
    """Return the content of measure.json: the measurement and the recommended variants."""
    best = [
        {
            **{name: row.measured[name] for name in ("model", "name", "lobe")},
            "limits": list(limits),
            "error": row.error,
        }
        for model in MODELS
        for limits, row in recommended(measurement, model)
    ]
    return {"recommended": best, **measurement}


def write_files(directory: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write files, keyed by file name, atomically to a directory, which is created if missing,
    and return their paths."""
    make_folder(directory)
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def _models(measurement: Measurement) -> list[str]:
    return [model for model in MODELS if rows_of(measurement, model)]


def table(measurement: Measurement) -> str:
    """Return sentences, tables of the recommended variants and tables of cost as text for a
    terminal."""
    models = _models(measurement)
    sentences = [text(measurement, model) for text in (advice, frame_advice) for model in models]
    tables = [*(recommendation_table(measurement, model) for model in models)]
    tables += cost_tables(measurement)
    return "\n\n".join(["\n".join(filter(None, sentences)), *(table.text() for table in tables)])


def _page(measurement: Measurement, figures: Iterable[str]) -> str:
    """Return the page: one self-contained HTML file."""
    models, slope = _models(measurement), slope_of(measurement)
    frames = " ".join(frame_advice(measurement, model) for model in models)
    missing = "".join(f"<li>{escape(text)}</li>" for text in measurement["not_measured"])
    machine = f"{measurement['settings']['mesh']} on {measurement['environment']['GL_RENDERER']}"
    body = [
        f'<p class="note">{escape(machine)}</p>',
        _trades(measurement, TERM),
        f"<p>{escape(frames)}</p>" * bool(frames),
        f"<p>{escape(INTRODUCTION)}</p>",
        f'<p class="note">{escape(DOMINATED)}</p>',
        *(_html(recommendation_table(measurement, model), "numbers costs") for model in models),
        *(_html(table, "numbers costs") for table in cost_tables(measurement, [TERM])),
        _folded(
            "Cost of a whole frame",
            _trades(measurement, FRAME),
            *(_html(table, "numbers costs") for table in cost_tables(measurement, [FRAME])),
        ),
        _folded(
            f"Errors of the image at m = {slope}, and of lobe and BRDF at other m",
            *(_html(table, "numbers") for table in error_tables(measurement)),
        ),
        _folded(f"Images at m = {slope}", *figures),
        _folded(
            "How the values are measured",
            "<dl>",
            *(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in METHODS.items()),
            "</dl>",
        ),
        f"<h2>Not measured</h2><ul>{missing}</ul>" * bool(missing),
        "<h2>Machine and settings</h2>",
        page_table("facts", (), _conditions(measurement)),
    ]
    return document(f"Cost and error at m = {slope}", "\n".join(body), chart.STYLE)


def _trades(measurement: Measurement, cost: CostKind) -> str:
    """Return the charts of cost and error side by side, for each model with its recommendation."""
    axis = f"cost of the {cost.title}, {cost.unit}"
    figures = []
    for model in _models(measurement):
        error = ERRORS[chart.measure_of(measurement, model)]
        svg = chart.trade(pareto(measurement, model, cost), axis, error)
        recommend = advice if cost is TERM else frame_advice
        if svg:
            sentence = escape(recommend(measurement, model), quote=False)
            text = re.sub('"(.*?)"', r"<b>\1</b>", sentence)  # the names of variants
            figures.append(f'<figure><figcaption class="lead">{text}</figcaption>{svg}</figure>')
    return f'<div class="pair trades">{"".join(figures)}</div>'


def _folded(summary: str, *content: str) -> str:
    return "\n".join([f"<details><summary>{escape(summary)}</summary>", *content, "</details>"])


def _conditions(measurement: Measurement) -> list[str]:
    """Return rows of a table with the machine and the settings."""
    environment, settings = measurement["environment"], measurement["settings"]
    conditions = {
        "mesh": settings["mesh"],
        "m of the skin (RMS slope of the microfacets)": slope_of(measurement),
        "size of the images, pixels": "{} x {}".format(*settings["size"]),
        "repeats of each timing": settings["repeats"],
        "reduced measurement (--quick)": "yes" if settings["quick"] else "no",
        "OpenGL driver (GL_RENDERER)": environment["GL_RENDERER"],
        "version of OpenGL (GL_VERSION)": environment["GL_VERSION"],
        "drawn by": "CPU" if environment["software"] else "GPU",
        "processor": environment["processor"],
        "processor cores that the process may use": environment["cores"],
        "version of facerender": environment["facerender"],
        "version of Python": environment["python"],
        "version of NumPy": environment["numpy"],
        "date of the measurement": environment["date"],
    }
    return [table_row(name, [escape(str(value))]) for name, value in conditions.items()]


def _html(table: Table, css_class: str) -> str:
    """Return a table as HTML, with dominated rows in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    rows = [
        table_row(escape(name), map(escape, cells), "dominated" if name in table.dominated else "")
        for name, *cells in table.rows
    ]
    caption = f"<span>{escape(table.title)}</span><small>{escape(table.note)}</small>"
    return page_table(css_class, map(escape, table.head), rows, caption)
