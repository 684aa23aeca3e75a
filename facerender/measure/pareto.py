"""Which variants are worth their cost: those that no other dominates. Nothing is measured or drawn
here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from facerender.measure.measurement import ImageError, MeasuredVariant, Measurement
from facerender.pricing.amd import Statistics
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

# Percent that float32 may leave in an image of the exact lobe: an error below it counts as none.
EXACT = 0.01


@dataclass(frozen=True)
class CostKind:
    """A kind of cost: its field of ``Costs``, what is paid for, and in which unit."""

    field: Literal["term_ns", "frame_ms", "navi21", "vega10"]
    title: str
    unit: str

    def of(self, measured: MeasuredVariant) -> Interval | Statistics | None:
        """Return what a variant costs, None where it was not measured."""
        cost: Interval | Statistics | None = getattr(measured.cost, self.field)
        return cost


TERM = CostKind("term_ns", "specular term", "ns an evaluation")
FRAME = CostKind("frame_ms", "whole frame", "ms a frame")
KINDS = (
    TERM,
    FRAME,
    CostKind("navi21", "specular term on AMD Navi 21", "cycles a wave"),
    CostKind("vega10", "specular term on AMD Vega 10", "cycles a wave"),
)


@dataclass(frozen=True)
class Row:
    """A variant at one kind of cost.

    Attributes
    ----------
    figure : of the cost; None where it was not measured
    error : in percent, of what ``measure_of`` says; None outside the domain of the lobe
    dominated : another variant is not dearer and not less exact, and better in one of them;
        costs whose intervals overlap count as equal. A form of the paper is there to compare:
        it dominates nothing
    """

    measured: MeasuredVariant
    figure: Interval | Statistics | None
    error: float | None
    dominated: bool = False

    @property
    def variant(self) -> Variant:
        """What is measured."""
        return self.measured.variant

    @property
    def cost(self) -> float | None:
        """The cost in the unit of its kind."""
        match self.figure:
            case Interval(value):
                return value
            case Statistics(inverse_throughput=cycles):
                return cycles
        return None

    @property
    def span(self) -> tuple[float, float] | None:
        """The 95 % interval of the cost; (cost, cost) where it is an estimate without one."""
        match self.figure:
            case Interval(_, low, high):
                return low, high
            case Statistics(inverse_throughput=cycles):
                return cycles, cycles
        return None


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
    return sorted(marked, key=lambda row: (row.cost is None, row.cost or 0.0, row.error or 0.0))


def _dominates(a: Row, b: Row) -> bool:
    if a.variant.printed or not a.span or not b.span or a.error is None or b.error is None:
        return False
    error, other = max(a.error, EXACT), max(b.error, EXACT)
    (low, high), (other_low, other_high) = a.span, b.span  # where they overlap, order is noise
    return error <= other and (high < other_low or (low <= other_high and error < other))


def _images(variants: Iterable[MeasuredVariant]) -> Mapping[str, ImageError]:
    """Errors of the image by lobe; variants that draw none have that of their lobe."""
    return {
        measured.variant.lobe: measured.error.image
        for measured in variants
        if measured.error.image is not None
    }
