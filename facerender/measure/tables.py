"""Tables of a measurement as text: cost and error, and errors alone.

``pareto.py`` determines the dominated variants.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from facerender.measure.measurement import (
    MODELS,
    BySlope,
    DisplayError,
    ImageError,
    Measurement,
)
from facerender.measure.pareto import KINDS, CostKind, Row, measure_of, pareto
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

ERRORS = {
    "image": "largest error of the image, % of max(reference, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
_LEFT = ("variant", "lobe", "remark", "shading")  # columns of text, aligned to the left
_IMAGE_HEAD = (
    "lobe",
    "largest, %",
    "99.9th percentile, %",
    "16 x 16 blocks, %",
    "beyond 3 x 3 neighbours, radiance",
    "displayed, 8-bit levels",
    "99.9th percentile, levels",
    "mean FLIP",
)
SAMPLES_HEAD = (
    "samples",
    "frame time (1 sample = 1)",
    "silhouette: mean, 1/255",
    "99th percentile, 1/255",
    "inside: mean, 1/255",
    "99th percentile, 1/255",
    "pixels over 1/255, %",
)

SKIN_HEAD = (
    "part",
    "setting",
    "frame time (first setting = 1)",
    "mean, 1/255",
    "99th percentile, 1/255",
    "pixels over 1/255, %",
)


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


def cost_tables(measurement: Measurement) -> list[Table]:
    """Return a table for each combination of cost kind and model, with the cheapest variant first.

    A kind of cost that was not measured has one table without rows.
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
                Table(
                    f"{title}, m = {measurement.settings.slope}: {kind.title}",
                    f"Error: {ERRORS[measure_of(measurement, model)]}.",
                    ["variant", "remark", kind.unit, "cost / exact", "error, %", *kind.columns],
                    [_cost_cells(row, kind, exact) for row in rows],
                    [row.variant.name for row in rows if row.dominated],
                )
            )
    return tables or [Table(kind.title[0].upper() + kind.title[1:])]


def _cost_cells(row: Row, kind: CostKind, exact: Interval | None) -> list[str]:
    cost = row.cost.value if row.cost else None
    ratio = f"{cost / exact.value:.2f}" if cost is not None and exact else ""
    remarks = ["as published"] * row.variant.printed + ["dominated"] * row.dominated
    error = _number(row.error, NOT_MEASURED if row.variant.printed else "outside the domain")
    extra = [_cell(value(row.measured)) if row.cost else "" for value in kind.columns.values()]
    return [row.variant.name, ", ".join(remarks), _number(cost), ratio, error, *extra]


def error_tables(measurement: Measurement) -> list[Table]:
    """Return three tables per model: image errors at one m; lobe errors and BRDF errors by m."""
    tables = []
    for model, title in MODELS.items():
        errors = {
            row.variant.lobe: row.error
            for row in measurement.of_model(model)
            if row.variant.standard
        }
        if not errors:
            continue
        tables += [
            Table(
                f"{title}, m = {measurement.settings.slope}: error of the image",
                "Relative to max(reference, 0.01) unless stated otherwise.",
                _IMAGE_HEAD,
                [[lobe, *_image_cells(error.image)] for lobe, error in errors.items()],
            ),
            _slope_table(
                f"{title}: error of the lobe",
                "Largest error over 0 to 90 degrees, % of the lobe's peak.",
                {lobe: error.lobe for lobe, error in errors.items()},
            ),
            _slope_table(
                f"{title}: error of the BRDF",
                "Largest error of f N.L, % of the largest exact f N.L.",
                {lobe: error.brdf for lobe, error in errors.items()},
            ),
        ]
    return tables


def sample_table(measurement: Measurement) -> Table:
    """Return the table of cost and error by samples per pixel; without rows if not measured."""
    rows = []
    for each in measurement.samples:
        name = f"{each.samples}{', per-pixel shading' * (each.shading_rate == 'pixel')}"
        errors = [*_levels(each.silhouette), *_levels(each.inside)]
        values = (each.time.value, *errors, 100.0 * each.inside.over)
        rows.append([name, *map(_number, values)])
    return Table(
        "Samples per pixel: {} x {}".format(*measurement.settings.size),
        "Errors of the displayed image against an image with 64 samples, each shaded separately.",
        SAMPLES_HEAD,
        rows,
    )


def skin_table(measurement: Measurement) -> Table:
    """Return the table of cost and error of skin shading; without rows if not measured."""
    rows = []
    for each in measurement.skin:
        values = (each.time.value, *_levels(each.error), 100.0 * each.error.over)
        rows.append([each.part, each.setting, *map(_number, values)])
    return Table(
        "Parts of skin shading: {} x {}".format(*measurement.settings.size),
        "Errors of the displayed image against the image with the part's last setting.",
        SKIN_HEAD,
        rows,
    )


def _levels(error: DisplayError) -> tuple[float, float]:
    """Return the mean and the 99th percentile of an error, in 8-bit levels."""
    return 255.0 * error.mean, 255.0 * error.percentile


def _slope_table(title: str, note: str, errors: Mapping[str, BySlope]) -> Table:
    slopes = list(next(iter(errors.values())))
    rows = [
        [lobe, *(_number(by_slope[m], "outside") for m in slopes)]
        for lobe, by_slope in errors.items()
    ]
    return Table(title, note, ["lobe", *(f"m = {m}" for m in slopes)], rows)


def _image_cells(error: ImageError | None) -> list[str]:
    if error is None:
        return [NOT_MEASURED] * (len(_IMAGE_HEAD) - 1)
    percent = [100.0 * each for each in (error.largest, error.percentile, error.block)]
    others = (error.point, error.steps, error.steps_percentile, error.flip)
    return [_number(value) for value in (*percent, *others)]


def _cell(value: float | Interval | None) -> str:
    if isinstance(value, Interval):
        return f"{_number(value.low)} to {_number(value.high)}"
    return _number(value)


def _number(value: float | None, missing: str = NOT_MEASURED) -> str:
    """Format a value with three digits; counts, and values of 100 or more, as integers."""
    if value is None:
        return missing
    if isinstance(value, int) or value == 0.0 or abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:#.3g}"
