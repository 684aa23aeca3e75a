"""A measurement as tables of text: cost beside error, and errors alone. Which variants dominate is
decided in ``pareto.py``; the data is that of docs/measure.schema.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from facerender.measure.pareto import COSTS, MODELS, Row, measure_of, pareto, slope

ERRORS = {
    "image": "largest error of the image, % of max(reference, 0.01)",
    "lobe": "largest error of the lobe, % of its peak",
}
NOT_MEASURED = "not measured"
_LEFT = ("variant", "lobe", "remark")  # columns of words, not of numbers
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


@dataclass(frozen=True)
class Table:
    """Cells as text. The first of a row is its name; without rows, nothing was measured."""

    title: str
    note: str = ""
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()

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


def cost_tables(data: dict[str, Any], kind: str) -> list[Table]:
    """Return one for each model, cheapest first; one without rows where the kind was not
    measured at all."""
    cost = COSTS[kind]
    head = ["variant", "remark", cost.unit, "of exact", "error, %", *_EXTRA[kind]]
    tables = []
    for model, name in MODELS.items():
        rows = pareto(data, model, kind)
        if any(row.cost is not None for row in rows):
            exact = next((row.cost for row in rows if row.variant["name"] == "exact"), None)
            tables.append(
                Table(
                    f"{name}, m = {slope(data)}: {cost.title}",
                    f"Error: {ERRORS[measure_of(data, model)]}.",
                    head,
                    [_cost_cells(row, kind, exact) for row in rows],
                )
            )
    return tables or [Table(cost.title[0].upper() + cost.title[1:])]


def _cost_cells(row: Row, kind: str, exact: float | None) -> list[str]:
    cost = row.variant["cost"][kind]
    if cost is None:
        extra = [""] * len(_EXTRA[kind])
    elif row.interval:
        extra = [" to ".join(map(_number, row.interval))]
    else:
        extra = [_number(cost["instructions"]), _number(cost["latency"])]
    if kind == "term_ns":
        lobe = row.variant["cost"]["lobe_ns"]
        extra = [extra[0], _number(lobe and lobe["value"])]
    ratio = f"{row.cost / exact:.2f}" if row.cost is not None and exact else ""
    remarks = ["as printed"] * row.printed + ["dominated"] * row.dominated
    error = _number(row.error, NOT_MEASURED if row.printed else "outside the domain")
    return [row.variant["name"], ", ".join(remarks), _number(row.cost), ratio, error, *extra]


def error_tables(data: dict[str, Any]) -> list[Table]:
    """Return, for each model, the errors of an image at one m, and of lobe and BRDF over m."""
    tables = []
    for model, name in MODELS.items():
        lobes = {
            variant["lobe"]: variant["error"]
            for variant in data["variants"]
            if variant["model"] == model and variant["name"] == variant["lobe"]
        }
        if not lobes:
            continue
        tables.append(
            Table(
                f"{name}, m = {slope(data)}: error of the image",
                "Relative to max(reference, 0.01) where nothing else is said.",
                _IMAGE_HEAD,
                [[lobe, *_image_cells(error["image"])] for lobe, error in lobes.items()],
            )
        )
        for part, title, note in (
            ("lobe", "error of the lobe", "Largest over 0 to 90 degrees, % of the lobe's peak."),
            ("brdf", "error of the BRDF", "Largest of f N.L, % of the largest exact one."),
        ):
            slopes = list(next(iter(lobes.values()))[part])
            rows = [
                [lobe, *(_number(error[part][m], "outside") for m in slopes)]
                for lobe, error in lobes.items()
            ]
            head = ["lobe", *(f"m = {m}" for m in slopes)]
            tables.append(Table(f"{name}: {title}", note, head, rows))
    return tables


def _image_cells(error: dict[str, Any] | None) -> list[str]:
    if error is None:
        return [NOT_MEASURED] * (len(_IMAGE_HEAD) - 1)
    percent = [100.0 * error[key] for key in ("largest", "percentile", "block")]
    others = [error[key] for key in ("point", "steps", "steps_percentile", "flip")]
    return [_number(value) for value in (*percent, *others)]


def _number(value: float | None, missing: str = NOT_MEASURED) -> str:
    """Write three digits, or all of a count."""
    if value is None:
        return missing
    if isinstance(value, int) or value == 0.0 or abs(value) >= 100.0:
        return f"{value:.0f}"
    return f"{value:#.3g}"
