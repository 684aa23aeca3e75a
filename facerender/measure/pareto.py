"""Which variants are worth their cost: those that no other dominates. Nothing is measured or drawn
here; the data is that of docs/measure.schema.md."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

# Percent that float32 may leave in an image of the exact lobe: an error below it counts as none.
EXACT = 0.01
MODELS = {"cook-torrance": "Cook-Torrance", "ward": "Ward"}


@dataclass(frozen=True)
class Cost:
    """A kind of cost: what is paid for, in which unit, and where a variant's figure stands."""

    title: str
    unit: str
    figure: str


COSTS = {
    "term_ns": Cost("specular term", "ns an evaluation", "value"),
    "frame_ms": Cost("whole frame", "ms a frame", "value"),
    "navi21": Cost("specular term on AMD Navi 21", "cycles a wave", "inverse_throughput"),
    "vega10": Cost("specular term on AMD Vega 10", "cycles a wave", "inverse_throughput"),
}


@dataclass(frozen=True)
class Row:
    """A variant at one kind of cost.

    Attributes
    ----------
    cost : in the unit of its kind; None where it was not measured
    interval : of 95 % around the cost; None where it is no measurement
    error : in percent, of what ``measure_of`` says; None outside the domain of the lobe
    printed : a form of the paper, which is there to compare: it dominates nothing
    dominated : another variant is not dearer and not less exact, and better in one of them;
        costs whose intervals overlap count as equal
    """

    variant: dict[str, Any]
    cost: float | None
    interval: tuple[float, float] | None
    error: float | None
    printed: bool
    dominated: bool = False


def measure_of(data: dict[str, Any], model: str) -> str:
    """Tell what errors of a model are compared: "image", or "lobe" where a lobe has no image."""
    variants, m = _of_model(data, model), slope(data)
    inside = {v["lobe"] for v in variants if v["error"]["lobe"][m] is not None}
    return "image" if inside <= _images(variants).keys() else "lobe"


def pareto(data: dict[str, Any], model: str, kind: str) -> list[Row]:
    """Return the variants of a model, cheapest first, those without a cost last."""
    variants = _of_model(data, model)
    images = _images(variants)
    by_image = measure_of(data, model) == "image"

    def error(variant: dict[str, Any]) -> float | None:
        if not by_image:
            return variant["error"]["lobe"][slope(data)]  # type: ignore[no-any-return]
        printed_power = variant["name"].startswith("printed") and variant["lobe"] != "exact"
        own = None if printed_power else images.get(variant["lobe"])  # it has no clamp
        image = variant["error"]["image"] or own
        return 100.0 * image["largest"] if image else None

    rows = []
    for variant in variants:
        cost = variant["cost"][kind] or {}
        interval = (cost["low"], cost["high"]) if "low" in cost else None
        printed = variant["name"].startswith("printed")
        rows.append(Row(variant, cost.get(COSTS[kind].figure), interval, error(variant), printed))
    marked = [replace(row, dominated=any(_dominates(other, row) for other in rows)) for row in rows]
    return sorted(marked, key=lambda row: (row.cost is None, row.cost or 0.0, row.error or 0.0))


def slope(data: dict[str, Any]) -> str:
    """Return the m of the measurement as a key of the lobe's errors."""
    return f"{data['settings']['m']:g}"


def _dominates(a: Row, b: Row) -> bool:
    if a.printed or a.cost is None or b.cost is None or a.error is None or b.error is None:
        return False
    error, other = max(a.error, EXACT), max(b.error, EXACT)
    (low, high), (other_low, other_high) = _span(a), _span(b)
    return error <= other and (high < other_low or (low <= other_high and error < other))


def _span(row: Row) -> tuple[float, float]:
    """The interval of the cost: where two overlap, their order is noise."""
    assert row.cost is not None
    return row.interval or (row.cost, row.cost)


def _of_model(data: dict[str, Any], model: str) -> list[dict[str, Any]]:
    return [variant for variant in data["variants"] if variant["model"] == model]


def _images(variants: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Errors of the image by lobe; variants that draw none have that of their lobe."""
    return {v["lobe"]: v["error"]["image"] for v in reversed(variants) if v["error"]["image"]}
