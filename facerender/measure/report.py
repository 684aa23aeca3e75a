"""Ranks the variants by cost and error, and writes a measurement to files: ``measure.json``, images
as PNG, and the page ``index.html`` with charts as inline SVG, whose colours for light and dark mode
are in chart.css."""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerender import page
from facerender.glsl.library import lobe_macros
from facerender.measure import measurement as measuring
from facerender.measure.measurement import MODELS, MeasuredVariant, Measurement, rows_of, slope_of
from facerender.pricing.cost import Interval, Variant, of_model
from facerender.system.files import make_folder, write_bytes

# Largest error that float32 causes in the image of the exact lobe, in percent. Errors up to this
# value count as 0.
EXACT = 0.01
LIMITS = (EXACT, 1.0, 3.0)  # errors of recommended variants are at most these, in percent


def interval(measured: MeasuredVariant, name: str) -> Interval | None:
    """Return a cost of a variant, for example "term_ns"; None if it was not measured."""
    cost = measured["cost"][name]
    return cost and Interval(**cost)


@dataclass(frozen=True)
class CostKind:
    """A kind of cost, with its title and unit in tables and plots."""

    title: str
    unit: str
    of: Callable[[MeasuredVariant], Interval | None]  # returns None for a cost not measured
    # Functions that return a variant's values in further columns of the table, keyed by column
    # title; the table shows both ends of an interval.
    columns: Mapping[str, Callable[[MeasuredVariant], float | Interval | None]]


_TERM_NS, _FRAME_MS = (partial(interval, name=name) for name in ("term_ns", "frame_ms"))
TERM = CostKind(
    "specular term",
    "ns per evaluation",
    _TERM_NS,
    {
        "95 % interval, ns": _TERM_NS,
        "lobe alone, ns": lambda row: cost.value if (cost := interval(row, "lobe_ns")) else None,
    },
)
FRAME = CostKind("whole frame", "ms per frame", _FRAME_MS, {"95 % interval, ms": _FRAME_MS})


@dataclass(frozen=True)
class Row:
    """A variant with one kind of cost."""

    variant: Variant
    measured: MeasuredVariant
    cost: Interval
    # Error of image or lobe, as :func:`measure_of` selects, in percent; None if m is outside the
    # lobe's domain, or if the variant has no image.
    error: float | None
    # Whether another variant is at least as cheap and as exact, and better in cost or error. Costs
    # with overlapping intervals count as equal. Published forms dominate no other variant: they are
    # only for comparison.
    dominated: bool = False

    @property
    def css_class(self) -> str:
        """The class of the row's elements in the chart."""
        return "other" if self.dominated else "best"


def measure_of(measurement: Measurement, model: str) -> Literal["image", "lobe"]:
    """Return the kind of error that ranks variants: "image", or "lobe" if an image is missing."""
    variants, m = rows_of(measurement, model), slope_of(measurement)
    inside = {row["lobe"] for row in variants if row["error"]["lobe"][m] is not None}
    return "image" if inside <= _images(variants).keys() else "lobe"


def pareto(measurement: Measurement, model: str, cost: CostKind) -> list[Row]:
    """Return the variants of a model whose cost was measured, cheapest first."""
    measured, by_name = rows_of(measurement, model), {v.name: v for v in of_model(model)}
    images, measure = _images(measured), measure_of(measurement, model)

    def error(row: MeasuredVariant) -> float | None:
        if measure == "lobe":
            value: float | None = row["error"]["lobe"][slope_of(measurement)]
            return value
        image = row["error"]["image"]
        if image is None and not by_name[row["name"]].unclamped:
            image = images.get(row["lobe"])
        return 100.0 * image["largest"] if image else None

    costs = ((row, cost.of(row)) for row in measured)
    rows = [Row(by_name[row["name"]], row, price, error(row)) for row, price in costs if price]
    rows.sort(key=lambda row: (row.cost.value, row.error or 0.0))
    return [replace(row, dominated=any(_dominates(rival, row) for rival in rows)) for row in rows]


def recommended(measurement: Measurement, model: str) -> list[tuple[tuple[float, ...], Row]]:
    """Return the recommended variants of a model, by the cost of the term, from the lowest limit:
    the limits in percent, and the row of the cheapest variant within each of these limits.
    Dominated variants and published forms are not recommended. A limit of ``LIMITS`` that no
    variant meets is absent."""
    rows = [row for row in pareto(measurement, model, TERM) if row.error is not None]
    best = [row for row in rows if not (row.dominated or row.variant.printed)]
    chosen = [next((row for row in best if (row.error or 0.0) <= limit), None) for limit in LIMITS]
    return [
        (tuple(limit for limit, _ in pairs), row)
        for row, pairs in groupby(zip(LIMITS, chosen, strict=True), key=lambda pair: pair[1])
        if row
    ]


def _dominates(a: Row, b: Row) -> bool:
    if a.variant.printed or a.error is None or b.error is None:
        return False
    error_a, error_b = max(a.error, EXACT), max(b.error, EXACT)
    cheaper = a.cost.high < b.cost.low  # overlapping intervals have no reliable order
    return error_a <= error_b and (cheaper or (a.cost.low <= b.cost.high and error_a < error_b))


def _images(variants: Iterable[MeasuredVariant]) -> dict[str, Any]:
    """Return image errors keyed by lobe; a variant without image uses its lobe's image error."""
    return {
        row["lobe"]: image
        for row in variants
        if (image := row["error"]["image"]) and not row["name"].startswith("printed")
    }


ERRORS = {
    "image": "largest error of a pixel, % of max(exact radiance, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
# Titles of the columns that are aligned to the left.
_LEFT_ALIGNED = ("variant", "lobe", "remark", "shading", "render option", "shader macros")


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
        signs = ["<" if name in _LEFT_ALIGNED else ">" for name in self.head]
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
    """Return the time of a frame with the exact lobe, and the faster lobes; "" if not measured. A
    lobe is faster if both the frame and the specular term are measurably cheaper: noise alone can
    make a frame cheaper."""
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
    error = ERRORS[measure_of(measurement, model)]
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
    return _table(title, f"The cheapest term with an error up to the limit. Error: {error}.", rows)


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
            note = f"Error: {ERRORS[measure_of(measurement, model)]}."
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
        images = []
        for row in rows:
            if error := row["error"]["image"]:
                values = {
                    "largest, %": 100.0 * error["largest"],
                    "99.9th percentile, %": 100.0 * error["percentile"],
                    "16 x 16 blocks, %": 100.0 * error["block"],
                    "beyond 3 x 3 neighbours, radiance": error["point"],
                    "displayed, 8-bit levels": error["steps"],
                    "99.9th percentile, levels": error["steps_percentile"],
                    "mean FLIP": error["flip"],
                }
                images.append({"lobe": row["lobe"]} | {k: _number(v) for k, v in values.items()})
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


def write(measurement: Measurement, triptychs: measuring.Triptychs, directory: Path) -> list[Path]:
    """Write measure.json, images and index.html atomically, and return their paths. All images are
    encoded before the first file is written. A missing directory is created."""
    from PIL import Image

    text = json.dumps(content(measurement), indent=1, allow_nan=False) + "\n"
    images, captions = {}, []
    for (model, lobe), pixels in triptychs.items():
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG", optimize=True)
        images[f"images-{model}-{lobe}.png"] = file.getvalue()
        difference = f"{measuring.MAGNIFIED} times their difference (right)"
        contents = f"exact (left), {lobe} (middle), and {difference}"
        captions.append(f"{MODELS[model]}, m = {slope_of(measurement)}: {contents}.")
    html = _page(measurement, map(page.figure, images.values(), captions))
    return write_files(directory, {JSON: text.encode(), **images, PAGE: html.encode()})


def content(measurement: Measurement) -> dict[str, Any]:
    """Return the content of measure.json: the measurement and the recommended variants."""
    names = ("model", "name", "lobe")
    best = [
        {name: row.measured[name] for name in names} | {"limits": [*limits], "error": row.error}
        for model in MODELS
        for limits, row in recommended(measurement, model)
    ]
    return {"recommended": best, **measurement}


def write_files(directory: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write files, keyed by name, atomically to a new or existing directory; return their paths."""
    make_folder(directory)
    for name, content in files.items():
        write_bytes(directory / name, content)
    return [directory / name for name in files]


def _models(measurement: Measurement) -> list[str]:
    return [model for model in MODELS if rows_of(measurement, model)]


def table(measurement: Measurement) -> str:
    """Return the advice, and the tables of recommended variants and of costs, for a terminal."""
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
        page.table("facts", (), _conditions(measurement)),
    ]
    return page.document(f"Cost and error at m = {slope}", "\n".join(body), STYLE)


def _trades(measurement: Measurement, cost: CostKind) -> str:
    """Return the charts of cost and error side by side, for each model with its recommendation."""
    axis = f"cost of the {cost.title}, {cost.unit}"
    figures = []
    for model in _models(measurement):
        svg = trade(pareto(measurement, model, cost), axis, ERRORS[measure_of(measurement, model)])
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
    return [page.row(name, [escape(str(value))]) for name, value in conditions.items()]


def _html(table: Table, css_class: str) -> str:
    """Return a table as HTML, with dominated rows in grey."""
    if not table.rows:
        return f"<p>{escape(table.title)}: {NOT_MEASURED}.</p>"
    rows = [
        page.row(escape(name), map(escape, cells), "dominated" if name in table.dominated else "")
        for name, *cells in table.rows
    ]
    caption = f"<span>{escape(table.title)}</span><small>{escape(table.note)}</small>"
    return page.table(css_class, map(escape, table.head), rows, caption)


STYLE = Path(__file__).with_name("chart.css")
_WIDTH, _HEIGHT = 340, 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 50.0, 324.0, 22.0, 230.0  # edges of the plot area
_FONT = 12.0  # font size of chart.css
_LETTER = 0.72  # mean width of a bold letter in font sizes; wide fonts have about 0.7
_RADIUS = 4.0
# Candidate positions of a name: distances from its point, and directions.
_DISTANCES = (8, 13, 19, 27, 38, 50)
_DIRECTIONS = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))

Point = tuple[float, float]
Box = tuple[float, float, float, float]  # left, top, right, bottom


def trade(rows: Sequence[Row], cost: str, error: str) -> str:
    """Return a chart of error over cost as SVG, or "" if no row has an error.

    Published forms are omitted. A line joins the variants that no other variant dominates. Their
    names are always written; other names are written where they overlap nothing.

    rows : variants of one model, cheapest first
    cost, error : labels of the axes, with units
    """
    rows = [row for row in rows if row.error is not None and not row.variant.printed]
    costs = [(row.cost.value, row.cost.low, row.cost.high) for row in rows]
    errors = [max(row.error or 0.0, EXACT) for row in rows]
    if not rows:
        return ""
    low, high = float(np.min(costs)), float(np.max(costs))
    half = 0.7 * max(high - low, 0.1 * high)  # a difference of a few percent must look small
    start, end = max(0.0, (low + high) / 2.0 - half), (low + high) / 2.0 + half
    floor, top = math.log10(EXACT / 2.0), math.log10(4.0 * max(1.0, *errors))

    def across(value: float) -> float:
        return _LEFT + (value - start) / (end - start) * (_RIGHT - _LEFT)

    def down(value: float) -> float:
        return _BOTTOM - (math.log10(value) - floor) / (top - floor) * (_BOTTOM - _TOP)

    columns = {f"{tick:g}": across(tick) for tick in _ticks(start, end)}
    decades = [10.0**power for power in range(round(math.log10(EXACT)), math.floor(top) + 1)]
    lines = {f"{'≤ ' * (tick == EXACT)}{tick:g}": down(tick) for tick in decades}
    grid = [f"M{x:.1f} {_TOP}V{_BOTTOM}" for x in columns.values()]
    grid += [f"M{_LEFT} {y:.1f}H{_RIGHT}" for y in lines.values()]
    bars = [  # x and y of a point, and both ends of its interval
        (across(value), down(y), across(least), across(most))
        for (value, least, most), y in zip(costs, errors, strict=True)
    ]
    front = [(x, y) for (x, y, *_), row in zip(bars, rows, strict=True) if not row.dominated]
    steps = [f"H{x:.1f}V{y:.1f}" for x, y in front[1:]]
    parts = [
        f'<path class="grid" d="{"".join(grid)}"/>',
        *(_text(x, _BOTTOM + 15.0, "middle", name, "tick") for name, x in columns.items()),
        *(_text(_LEFT - 6.0, y + 4.0, "end", name, "tick") for name, y in lines.items()),
        _text((_LEFT + _RIGHT) / 2.0, _BOTTOM + 33.0, "middle", cost),
        _text(2.0, 12.0, "start", error),
        *(f'<path class="front" d="M{x:.1f} {y:.1f}{"".join(steps)}"/>' for x, y in front[:1]),
        *(_point(row, *bar) for row, bar in zip(rows, bars, strict=True)),
        *_names(rows, bars, front),
    ]
    label = escape(f"{error} over {cost}")
    head = f'<svg class="chart" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{label}">'
    return f"{head}{''.join(parts)}</svg>"


def _ticks(start: float, end: float) -> list[float]:
    """Return at most six multiples of 1, 2 or 5 times a power of ten, from start to end."""
    power = 10.0 ** math.floor(math.log10(end - start))
    steps = (factor * power for factor in (0.2, 0.5, 1.0, 2.0))
    step = next(step for step in steps if (end - start) / step < 6.0)
    return [step * k for k in range(math.ceil(start / step), math.floor(end / step) + 1)]


def _text(x: float, y: float, anchor: str, text: str, css_class: str = "") -> str:
    position = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{css_class}" {position}>{escape(text)}</text>'


def _point(row: Row, x: float, y: float, low: float, high: float) -> str:
    """Return the point of a row with its interval of cost; a tooltip has the row's name."""
    bar = f"M{low:.1f} {y - 3.0:.1f}v6m0-3H{high:.1f}m0-3v6"
    title = f"<title>{escape(row.variant.name)}</title>"
    circle = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{_RADIUS}"/>'
    return f'<g class="{row.css_class}">{title}<path d="{bar}"/>{circle}</g>'


def _names(rows: Sequence[Row], bars: Sequence[Box], front: Sequence[Point]) -> list[str]:
    """Return names with lines to their points; no name overlaps a point, an interval, or the line
    through the points ``front``."""
    boxes = [(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y, *_ in bars]
    boxes += [(low - 2.0, y - 3.0, high + 2.0, y + 3.0) for _, y, low, high in bars]
    for (x, y), (next_x, next_y) in pairwise(front):
        boxes += [(x, y - 1.0, next_x, y + 1.0), (next_x - 1.0, y, next_x + 1.0, next_y)]
    lines: list[str] = []
    texts: list[str] = []
    names: list[Box] = []
    points = [(x, y) for x, y, *_ in bars]
    pairs = zip(rows, bars, strict=True)
    for row, (x, y, *_) in sorted(pairs, key=lambda pair: pair[0].dominated):
        # Without free space, the name of a variant on the line overlaps no other name.
        # A name without a line must lie nearest to its own point.
        free = (
            (distance, *direction, box)
            for obstacles in [[*boxes, *names]] + [names] * (not row.dominated)
            for distance, direction in product(_DISTANCES, _DIRECTIONS)
            if not _overlaps(box := _box(row.variant.name, x, y, distance, direction), obstacles)
            and (
                distance > _DISTANCES[1]
                or (x, y) == min(points, key=lambda p: math.dist(p, np.clip(p, box[:2], box[2:])))
            )
        )
        position = next(free, None)
        if position is None:
            continue
        distance, right, up, box = position
        names.append(box)
        anchor = ("middle", "start", "end")[right]
        left, bottom = x + distance * right, box[3] - 0.25 * _FONT
        if distance > _DISTANCES[1]:
            end = f"{x + 0.9 * distance * right:.1f} {y - 0.9 * distance * up:.1f}"
            lines.append(f'<path class="{row.css_class}" d="M{x:.1f} {y:.1f}L{end}"/>')
        texts.append(_text(left, bottom, anchor, row.variant.name, f"name {row.css_class}"))
    return lines + texts


def _box(name: str, x: float, y: float, distance: float, direction: tuple[int, int]) -> Box:
    """Return the box of a name at a distance from its point."""
    right, up = direction
    width, x, y = _FONT * _LETTER * len(name), x + distance * right, y - distance * up
    left, bottom = x + (-0.5, 0.0, -1.0)[right] * width, y + (0.5, 0.0, 1.0)[up] * 1.1 * _FONT
    return left, bottom - 1.1 * _FONT, left + width, bottom


def _overlaps(box: Box, obstacles: Sequence[Box]) -> bool:
    """Return whether a box overlaps an obstacle or leaves the plot area."""
    left, top, right, bottom = box
    outside = left < _LEFT or top < _TOP or right > _RIGHT or bottom > _BOTTOM
    return outside or any(
        left < x1 and right > x0 and top < y1 and bottom > y0 for x0, y0, x1, y1 in obstacles
    )
