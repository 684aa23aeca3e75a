"""A measurement as tables of text: cost beside error, and errors alone. Which variants dominate is
decided in ``pareto.py``."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from facerender.measure.imported import Imported
from facerender.measure.measurement import MODELS, BySlope, ImageError, Lost, Measurement, Sampled
from facerender.measure.pareto import KINDS, TERM, CostKind, Row, measure_of, pareto
from facerender.pricing.amd import Statistics
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

ERRORS = {
    "image": "largest error of the image, % of max(reference, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
_LEFT = ("variant", "lobe", "remark", "shading")  # columns of words, not of numbers
_EXTRA = {
    "term_ns": ("95 % interval", "lobe alone, ns"),
    "frame_ms": ("95 % interval",),
    "navi21": ("instructions", "latency, cycles"),
    "vega10": ("instructions", "latency, cycles"),
}
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

    def markdown(self) -> str:
        """Lay it out under a heading of the third level."""
        if not self.rows:
            return f"### {self.title}\n\nNot measured."
        marks = ["---" if name in _LEFT else "---:" for name in self.head]
        return f"### {self.title}\n\n{self.note}\n\n{markdown_table(self.head, self.rows, marks)}"


def markdown_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], marks: Sequence[str] = ()
) -> str:
    """Return a table in Markdown; marks align its columns, to the left where none are given."""
    lines = (head, marks or ["---"] * len(head), *rows)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def cost_tables(measurement: Measurement) -> list[Table]:
    """Return one for each kind of cost and each model, cheapest first; one without rows for a kind
    that was not measured at all."""
    return [table for kind in KINDS for table in _cost_tables(measurement, kind)]


def _cost_tables(measurement: Measurement, kind: CostKind) -> list[Table]:
    tables = []
    for model, title in MODELS.items():
        rows = pareto(measurement, model, kind)
        if any(row.cost is not None for row in rows):
            exact = next((row.cost for row in rows if row.variant == Variant(model, "exact")), None)
            tables.append(
                Table(
                    f"{title}, m = {measurement.settings.slope}: {kind.title}",
                    f"Error: {ERRORS[measure_of(measurement, model)]}.",
                    ["variant", "remark", kind.unit, "of exact", "error, %", *_EXTRA[kind.field]],
                    [_cost_cells(row, kind, exact) for row in rows],
                    [row.variant.name for row in rows if row.dominated],
                )
            )
    return tables or [Table(kind.title[0].upper() + kind.title[1:])]


def _cost_cells(row: Row, kind: CostKind, exact: float | None) -> list[str]:
    match row.figure:
        case Interval(_, low, high):
            extra = [f"{_number(low)} to {_number(high)}"]
            if kind is TERM:
                lobe = row.measured.cost.lobe_ns
                extra.append(_number(lobe.value if lobe else None))
        case Statistics(instructions, latency):
            extra = [_number(instructions), _number(latency)]
        case None:
            extra = [""] * len(_EXTRA[kind.field])
    ratio = f"{row.cost / exact:.2f}" if row.cost is not None and exact else ""
    remarks = ["as printed"] * row.variant.printed + ["dominated"] * row.dominated
    error = _number(row.error, NOT_MEASURED if row.variant.printed else "outside the domain")
    return [row.variant.name, ", ".join(remarks), _number(row.cost), ratio, error, *extra]


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
    """Return what numbers of samples a pixel cost and lose; without rows where they were not
    measured."""
    return Table(
        "Samples a pixel: {} x {}".format(*measurement.settings.size),
        "Errors of the displayed image against 64 samples, each shaded by itself.",
        SAMPLES_HEAD,
        [sample_cells(each) for each in measurement.samples],
    )


def sample_cells(sampled: Sampled) -> list[str]:
    """Return the row of a number of samples, under ``SAMPLES_HEAD``."""
    lost: list[Lost] = [sampled.silhouette, sampled.inside]
    steps = [255.0 * share for each in lost for share in (each.mean, each.percentile)]
    figures = (sampled.time.value, *steps, 100.0 * sampled.inside.over)
    name = f"{sampled.samples}, per-pixel shading"
    name = name if sampled.shading_rate == "pixel" else str(sampled.samples)
    return [name, *(_number(figure) for figure in figures)]


def skin_table(measurement: Measurement) -> Table:
    """Return what parts of skin cost and lose; without rows where they were not measured."""
    rows = []
    for each in measurement.skin:
        lost = each.lost
        figures = (each.time.value, 255.0 * lost.mean, 255.0 * lost.percentile, 100.0 * lost.over)
        rows.append([each.part, each.setting, *(_number(figure) for figure in figures)])
    return Table(
        "Parts of skin: {} x {}".format(*measurement.settings.size),
        "Frames over the part's first setting; errors of the displayed image against its last.",
        SKIN_HEAD,
        rows,
    )


def import_tables(measurement: Measurement) -> list[Table]:
    """Return one for each import, under its GPU's name: what pictures cost there."""
    return [_import_table(imported) for imported in measurement.imports]


def _import_table(imported: Imported) -> Table:
    apart = imported.difference
    unsure = apart.low <= 0.0 <= apart.high
    costs = {
        "without highlights": imported.base,
        f"A: {imported.shadings['a']}": imported.a,
        f"B: {imported.shadings['b']}": imported.b,
        "B less A": apart,
    }
    rows = []
    for name, spread in costs.items():
        median = "not told apart" if spread is apart and unsure else _number(spread.median)
        rows.append([name, median, f"{_number(spread.low)} to {_number(spread.high)}"])
    width, height = imported.size
    return Table(
        f"{imported.gpu}, in the explorer",
        f"Milliseconds of a picture of {imported.mesh}, {width} x {height}, samples:"
        f" {imported.samples}, by {imported.method}: median and middle half of the rounds."
        f" Its link: #{imported.link}",
        ("shading", "ms", "middle half, ms"),
        rows,
    )


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
    percent = [100.0 * share for share in (error.largest, error.percentile, error.block)]
    others = (error.point, error.steps, error.steps_percentile, error.flip)
    return [_number(value) for value in (*percent, *others)]


def _number(value: float | None, missing: str = NOT_MEASURED) -> str:
    """Write three digits, or all of a count."""
    if value is None:
        return missing
    if isinstance(value, int) or value == 0.0 or abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:#.3g}"
