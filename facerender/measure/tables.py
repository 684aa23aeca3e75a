"""A measurement as tables of text: cost beside error, and errors alone. Which variants dominate is
decided in ``pareto.py``."""

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
_LEFT = ("variant", "lobe", "remark", "shading")  # columns of words, not of numbers
_IMAGE_HEAD = (
    "lobe",
    "largest, %",
    "99.9 % of pixels within, %",
    "blocks of 16 x 16, %",
    "beyond 3 x 3 neighbours, radiance",
    "displayed, steps of 1/255",
    "99.9 % of pixels within, steps",
    "FLIP, mean",
)
SAMPLES_HEAD = (
    "samples",
    "frame, of one sample",
    "silhouette: mean, 1/255",
    "99 %, 1/255",
    "inside: mean, 1/255",
    "99 %, 1/255",
    "over 1/255, %",
)

SKIN_HEAD = ("part", "setting", "frame", "mean, 1/255", "99 %, 1/255", "over 1/255, %")


@dataclass(frozen=True)
class Table:
    """Cells as text. The first of a row is its name; without rows, nothing was measured.
    ``dominated`` are the names of rows that another dominates."""

    title: str
    note: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    dominated: Collection[str] = ()

    def text(self) -> str:
        """Lay it out for a terminal."""
        if not self.rows:
            return f"{self.title}: {NOT_MEASURED}"
        lines = [self.head, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        signs = ["<" if name in _LEFT else ">" for name in self.head]
        row = "  " + "  ".join(map("{{:{}{}}}".format, signs, widths))
        return "\n".join([self.title, self.note, *(row.format(*line).rstrip() for line in lines)])


def cost_tables(measurement: Measurement) -> list[Table]:
    """Return one for each kind of cost and each model, cheapest first; one without rows for a kind
    that was not measured at all."""
    return [table for kind in KINDS for table in tables_of(measurement, kind)]


def tables_of(measurement: Measurement, kind: CostKind) -> list[Table]:
    """Return the table of each model at one kind of cost; one without rows if nothing has it."""
    tables = []
    for model, title in MODELS.items():
        rows = pareto(measurement, model, kind)
        if any(row.cost is not None for row in rows):
            exact = next((row.cost for row in rows if row.variant == Variant(model, "exact")), None)
            tables.append(
                Table(
                    f"{title}, m = {measurement.settings.slope}: {kind.title}",
                    f"Error: {ERRORS[measure_of(measurement, model)]}.",
                    ["variant", "remark", kind.unit, "of exact", "error, %", *kind.columns],
                    [_cost_cells(row, kind, exact) for row in rows],
                    [row.variant.name for row in rows if row.dominated],
                )
            )
    return tables or [Table(kind.title[0].upper() + kind.title[1:])]


def _cost_cells(row: Row, kind: CostKind, exact: Interval | None) -> list[str]:
    cost = row.cost.value if row.cost else None
    ratio = f"{cost / exact.value:.2f}" if cost is not None and exact else ""
    remarks = ["as printed"] * row.variant.printed + ["dominated"] * row.dominated
    error = _number(row.error, NOT_MEASURED if row.variant.printed else "outside the domain")
    extra = [_cell(value(row.measured)) if row.cost else "" for value in kind.columns.values()]
    return [row.variant.name, ", ".join(remarks), _number(cost), ratio, error, *extra]


def error_tables(measurement: Measurement) -> list[Table]:
    """Return, for each model, the errors of an image at one m, and of lobe and BRDF over m."""
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
                "Relative to max(reference, 0.01) where nothing else is said.",
                _IMAGE_HEAD,
                [[lobe, *_image_cells(error.image)] for lobe, error in errors.items()],
            ),
            _slope_table(
                f"{title}: error of the lobe",
                "Largest over 0 to 90 degrees, % of the lobe's peak.",
                {lobe: error.lobe for lobe, error in errors.items()},
            ),
            _slope_table(
                f"{title}: error of the BRDF",
                "Largest of f N.L, % of the largest exact one.",
                {lobe: error.brdf for lobe, error in errors.items()},
            ),
        ]
    return tables


def sample_table(measurement: Measurement) -> Table:
    """Return cost and error of numbers of samples a pixel; without rows if not measured."""
    rows = []
    for each in measurement.samples:
        name = f"{each.samples}{', per-pixel shading' * (each.shading_rate == 'pixel')}"
        errors = [*_levels(each.silhouette), *_levels(each.inside)]
        values = (each.time.value, *errors, 100.0 * each.inside.over)
        rows.append([name, *map(_number, values)])
    return Table(
        "Samples a pixel: {} x {}".format(*measurement.settings.size),
        "Errors of the displayed image against 64 samples, each shaded by itself.",
        SAMPLES_HEAD,
        rows,
    )


def skin_table(measurement: Measurement) -> Table:
    """Return cost and error of the settings of skin's parts; without rows if not measured."""
    rows = []
    for each in measurement.skin:
        values = (each.time.value, *_levels(each.error), 100.0 * each.error.over)
        rows.append([each.part, each.setting, *map(_number, values)])
    return Table(
        "Parts of skin: {} x {}".format(*measurement.settings.size),
        "Frames over the part's first setting; errors of the displayed image against its last.",
        SKIN_HEAD,
        rows,
    )


def _levels(error: DisplayError) -> tuple[float, float]:
    """Return mean and percentile in 8-bit levels."""
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
    """Write three digits, or all of a count."""
    if value is None:
        return missing
    if isinstance(value, int) or value == 0.0 or abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:#.3g}"
