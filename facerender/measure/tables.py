"""Texts and tables of a measurement: recommendations, cost and error, and errors alone.

``pareto.py`` determines the recommended and the dominated variants.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from facerender.glsl.code import lobe_macros
from facerender.measure.measurement import MODELS, ImageError, MeasuredVariant, Measurement
from facerender.measure.pareto import (
    EXACT,
    FRAME,
    KINDS,
    LIMITS,
    CostKind,
    Row,
    measure_of,
    pareto,
    recommended,
)
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

ERRORS = {
    "image": "largest error of a pixel, % of max(exact radiance, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
# Titles of the columns that are aligned to the left.
_LEFT = ("variant", "lobe", "remark", "shading", "render option", "shader macros")


@dataclass(frozen=True)
class Table:
    """A table of text cells. The first cell of a row is the row's name.

    A table without rows stands for values that were not measured. ``dominated`` contains the names
    of the dominated rows.
    """

    title: str
    note: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    dominated: Collection[str] = ()

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
    start = f"{MODELS[model]} at m = {measurement.settings.slope}: "
    if not best:
        return f"{start}no variant has an error of at most {LIMITS[-1]:g} %."
    parts = []
    for (limit, *_), row in best:
        allowed = f" if an error of {limit:g} % is acceptable" if limit > EXACT else ""
        error = row.error or 0.0
        size = f"below {EXACT:g} %" if error <= EXACT else f"{_number(error)} %"
        cost = _number(row.cost.value if row.cost else None)
        parts.append(f'"{row.variant.name}"{allowed} ({cost} ns per evaluation, error {size})')
    ending = f"; no variant with an error of at most {LIMITS[-1]:g} % is measurably cheaper"
    return f"{start}use {', or '.join(parts)}{ending * (len(parts) == 1)}."


def frame_advice(measurement: Measurement, model: str) -> str:
    """Return the time of a frame with the exact lobe, and the faster lobes; "" if not measured.

    A lobe is faster if both the frame and the specular term are measurably cheaper: noise alone can
    make a frame cheaper.
    """
    rows = [row for row in pareto(measurement, model, FRAME) if row.cost]
    best = next((row for row in rows if row.variant.lobe == "exact"), None)
    if best is None or best.cost is None:
        return ""
    exact, term = best.cost, best.measured.term_ns
    allowed = f"with an error of at most {LIMITS[-1]:g} %"
    faster = [
        f"{row.variant.name} ({_number(row.cost.value)} ms)"
        for row in rows
        if row.cost
        and row.cost.high < exact.low
        and row.measured.term_ns.high < term.low
        and (row.error or 0.0) <= LIMITS[-1]
    ]
    sentence = f"No lobe {allowed} is measurably faster."
    if faster:
        sentence = f"Faster lobes {allowed}: {', '.join(faster)}."
    time = f"{_number(exact.value)} ms (95 % interval {_cell(exact)})"
    size = "{} x {} pixels".format(*measurement.settings.size)
    return f"{MODELS[model]}: the exact lobe draws a frame of {size} in {time}. {sentence}"


def recommendation_table(measurement: Measurement, model: str) -> Table:
    """Return the table of a model's recommended variants, and how to select them."""
    error = ERRORS[measure_of(measurement, model)]
    frames = {row.variant.lobe: row.cost for row in pareto(measurement, model, FRAME) if row.cost}
    rows = []
    for limits, row in recommended(measurement, model):
        variant, cost = row.variant, row.cost
        macros = lobe_macros(variant.lobe) | ({"FR_SMALL_SLOPE": "0"} if variant.plain else {})
        rows.append(
            {
                "limit of the error, %": ", ".join(f"{limit:g}" for limit in limits),
                "variant": variant.name,
                "error, %": _number(row.error),
                "ns per evaluation": _number(cost.value if cost else None),
                "95 % interval, ns": _cell(cost),
                "95 % interval of a frame, ms": _cell(frames.get(variant.lobe)),
                "render option": f"--lobe {variant.lobe}",
                "shader macros": ", ".join(f"{name} {value}" for name, value in macros.items()),
            }
        )
    title = f"{MODELS[model]}, m = {measurement.settings.slope}: recommended variants"
    note = f"The cheapest term with an error up to the limit. Error: {error}."
    return _table(title, note, rows)


def cost_tables(measurement: Measurement) -> list[Table]:
    """Return a table for each combination of cost kind and model, with the cheapest variant first.

    Variants without a cost are absent; a kind of cost that was not measured has one table without
    rows.
    """
    return [table for kind in KINDS for table in tables_of(measurement, kind)]


def tables_of(measurement: Measurement, kind: CostKind) -> list[Table]:
    """Return one table of a kind of cost per model, or one empty table without measured costs."""
    tables = []
    for model, title in MODELS.items():
        rows = pareto(measurement, model, kind)
        if any(row.cost is not None for row in rows):
            exact = next((row.cost for row in rows if row.variant == Variant(model, "exact")), None)
            tables.append(
                _table(
                    f"{title}, m = {measurement.settings.slope}: {kind.title}",
                    f"Error: {ERRORS[measure_of(measurement, model)]}.",
                    [_cost_cells(row, kind, exact) for row in rows if row.cost],
                    [row.variant.name for row in rows if row.dominated],
                )
            )
    return tables or [Table(kind.title[0].upper() + kind.title[1:])]


def _cost_cells(row: Row, kind: CostKind, exact: Interval | None) -> dict[str, str]:
    cost = row.cost.value if row.cost else None
    remarks = ["as published"] * row.variant.printed + ["dominated"] * row.dominated
    return {
        "variant": row.variant.name,
        "remark": ", ".join(remarks),
        kind.unit: _number(cost),
        "cost / exact": f"{cost / exact.value:.2f}" if cost is not None and exact else "",
        "error, %": _number(
            row.error, NOT_MEASURED if row.variant.printed else "outside the domain"
        ),
        **{title: _cell(column(row.measured)) for title, column in kind.columns.items()},
    }


def error_tables(measurement: Measurement) -> list[Table]:
    """Return three tables per model: image errors at one m; lobe errors and BRDF errors by m.

    Lobes whose domain excludes m have no row of image errors.
    """
    tables = []
    for model, title in MODELS.items():
        rows = [row for row in measurement.of_model(model) if row.variant.standard]
        if not rows:
            continue
        note = "Errors of linear radiance in % of max(exact radiance, 0.01); displayed errors in"
        note += " 8-bit levels (1/255)."
        images = [_image_cells(row, row.image_error) for row in rows if row.image_error]
        name = f"{title}, m = {measurement.settings.slope}: error of the image"
        tables.append(_table(name, note, images))
        slopes = [*rows[0].lobe_error]
        for name, note in (
            ("lobe", "Largest error over 0 to 90 degrees, % of the lobe's peak."),
            ("BRDF", "Largest error of the BRDF times N.L, % of its largest exact value."),
        ):
            cells = []
            for row in rows:
                errors = getattr(row, f"{name.lower()}_error")
                cells.append([row.variant.lobe, *(_number(errors[m], "outside") for m in slopes)])
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


def _image_cells(row: MeasuredVariant, error: ImageError) -> dict[str, str]:
    values = {
        "largest, %": 100.0 * error.largest,
        "99.9th percentile, %": 100.0 * error.percentile,
        "16 x 16 blocks, %": 100.0 * error.block,
        "beyond 3 x 3 neighbours, radiance": error.point,
        "displayed, 8-bit levels": error.steps,
        "99.9th percentile, levels": error.steps_percentile,
        "mean FLIP": error.flip,
    }
    return {"lobe": row.variant.lobe, **{title: _number(value) for title, value in values.items()}}


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
