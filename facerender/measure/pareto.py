"""Which variants are worth their cost: those that no other dominates. Nothing is measured or drawn
here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from facerender.measure.measurement import ImageError, MeasuredVariant, Measurement
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

# Percent that float32 may leave in an image of the exact lobe: an error below it counts as none.
EXACT = 0.01


@dataclass(frozen=True)
class CostKind:
    """A kind of cost.

    Attributes
    ----------
    title, unit : in words
    of : the cost of a variant, None where it was not measured
    columns : titles of further columns of its table, and the value of a variant there; of an
        interval its ends
    """

    title: str
    unit: str
    of: Callable[[MeasuredVariant], Interval | None]
    columns: Mapping[str, Callable[[MeasuredVariant], float | Interval | None]]


TERM = CostKind(
    "specular term",
    "ns an evaluation",
    lambda measured: measured.cost.term_ns,
    {
        "95 % interval": lambda measured: measured.cost.term_ns,
        "lobe alone, ns": lambda measured: lobe.value if (lobe := measured.cost.lobe_ns) else None,
    },
)
FRAME = CostKind(
    "whole frame",
    "ms a frame",
    lambda measured: measured.cost.frame_ms,
    {"95 % interval": lambda measured: measured.cost.frame_ms},
)
KINDS = (TERM, FRAME)


@dataclass(frozen=True)
class Row:
    """A variant at one kind of cost.

    Attributes
    ----------
    cost : in the unit of its kind; None where it was not measured
    error : in percent, of what ``measure_of`` says; None outside the domain of the lobe
    dominated : another variant is not dearer and not less exact, and better in one of them;
        costs whose intervals overlap count as equal. A form of the paper is there to compare:
        it dominates nothing
    """

    measured: MeasuredVariant
    cost: Interval | None
    error: float | None
    dominated: bool = False

    @property
    def variant(self) -> Variant:
        """What is measured."""
        return self.measured.variant


def measure_of(measurement: Measurement, model: str) -> Literal["image", "lobe"]:
    """Tell what errors of a model are compared: "image", or "lobe" where a lobe has no image."""
    variants, m = measurement.of_model(model), measurement.settings.slope
    inside = {row.variant.lobe for row in variants if row.error.lobe[m] is not None}
    return "image" if inside <= _images(variants).keys() else "lobe"


def pareto(measurement: Measurement, model: str, kind: CostKind) -> list[Row]:
    """Return the variants of a model, cheapest first, those without a cost last."""
    variants = measurement.of_model(model)
    images = _images(variants)
    by_image = measure_of(measurement, model) == "image"

    def error(measured: MeasuredVariant) -> float | None:
        if not by_image:
            return measured.error.lobe[measurement.settings.slope]
        image = None if measured.variant.unclamped else images.get(measured.variant.lobe)
        return 100.0 * image.largest if image else None

    rows = [Row(measured, kind.of(measured), error(measured)) for measured in variants]
    marked = [replace(row, dominated=any(_dominates(other, row) for other in rows)) for row in rows]

    def order(row: Row) -> tuple[bool, float, float]:
        return row.cost is None, row.cost.value if row.cost else 0.0, row.error or 0.0

    return sorted(marked, key=order)


def _dominates(a: Row, b: Row) -> bool:
    if a.variant.printed or not a.cost or not b.cost or a.error is None or b.error is None:
        return False
    error, other = max(a.error, EXACT), max(b.error, EXACT)
    cheaper = a.cost.high < b.cost.low  # where the intervals overlap, the order is noise
    return error <= other and (cheaper or (a.cost.low <= b.cost.high and error < other))


def _images(variants: Iterable[MeasuredVariant]) -> Mapping[str, ImageError]:
    """Errors of the image by lobe; variants that draw none have that of their lobe."""
    return {
        measured.variant.lobe: measured.error.image
        for measured in variants
        if measured.error.image is not None
    }
