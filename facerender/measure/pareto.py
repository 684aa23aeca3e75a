"""Finds the variants that no other variant dominates in cost and error, and recommends some."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

from facerender.measure.measurement import ImageError, MeasuredVariant, Measurement
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant

# Largest error that float32 causes in the image of the exact lobe, in percent. Errors up to this
# value count as 0.
EXACT = 0.01
LIMITS = (EXACT, 1.0, 3.0)  # errors of recommended variants are at most these, in percent


@dataclass(frozen=True)
class CostKind:
    """A kind of cost, with its title and unit in tables and plots.

    Attributes
    ----------
    of : function that returns a variant's cost, or None if the cost was not measured
    columns : functions that return a variant's values in further columns of the table, keyed by
        column title; the table shows both ends of an interval
    """

    title: str
    unit: str
    of: Callable[[MeasuredVariant], Interval | None]
    columns: Mapping[str, Callable[[MeasuredVariant], float | Interval | None]]


TERM = CostKind(
    "specular term",
    "ns per evaluation",
    lambda measured: measured.term_ns,
    {
        "95 % interval, ns": lambda measured: measured.term_ns,
        "lobe alone, ns": lambda measured: lobe.value if (lobe := measured.lobe_ns) else None,
    },
)
FRAME = CostKind(
    "whole frame",
    "ms per frame",
    lambda measured: measured.frame_ms,
    {"95 % interval, ms": lambda measured: measured.frame_ms},
)
KINDS = (TERM, FRAME)


@dataclass(frozen=True)
class Row:
    """A variant with one kind of cost.

    Attributes
    ----------
    cost : cost in the unit of its kind; None if the cost was not measured
    error : error of image or lobe, as :func:`measure_of` selects, in percent; None if m is outside
        the lobe's domain, or if the variant has no image
    dominated : whether another variant is at least as cheap and as exact, and better in cost or
        error. Costs with overlapping intervals count as equal. Published forms are only for
        comparison: they dominate no other variant
    """

    measured: MeasuredVariant
    cost: Interval | None
    error: float | None
    dominated: bool = False

    @property
    def variant(self) -> Variant:
        """The measured variant."""
        return self.measured.variant


def measure_of(measurement: Measurement, model: str) -> Literal["image", "lobe"]:
    """Return the kind of error that ranks variants: "image", or "lobe" if an image is missing."""
    variants, m = measurement.of_model(model), measurement.settings.slope
    inside = {row.variant.lobe for row in variants if row.lobe_error[m] is not None}
    return "image" if inside <= _images(variants).keys() else "lobe"


def pareto(measurement: Measurement, model: str, kind: CostKind) -> list[Row]:
    """Return the variants of a model, cheapest first; variants without a cost come last."""
    variants = measurement.of_model(model)
    images = _images(variants)
    measure = measure_of(measurement, model)

    def error(measured: MeasuredVariant) -> float | None:
        if measure == "lobe":
            return measured.lobe_error[measurement.settings.slope]
        image = measured.image_error
        if image is None and not measured.variant.unclamped:
            image = images.get(measured.variant.lobe)
        return 100.0 * image.largest if image else None

    rows = [Row(measured, kind.of(measured), error(measured)) for measured in variants]
    rows.sort(key=lambda row: (row.cost.value if row.cost else math.inf, row.error or 0.0))
    return [replace(row, dominated=any(_dominates(rival, row) for rival in rows)) for row in rows]


def recommended(measurement: Measurement, model: str) -> list[tuple[tuple[float, ...], Row]]:
    """Return the recommended variants of a model, by the cost of the term, from the lowest limit:
    the limits in percent, and the row of the cheapest variant within each of these limits.

    Dominated variants and published forms are not recommended. A limit of ``LIMITS`` that no
    variant meets is absent.
    """
    rows = [row for row in pareto(measurement, model, TERM) if row.cost and row.error is not None]
    best = [row for row in rows if not (row.dominated or row.variant.printed)]
    chosen = [next((row for row in best if (row.error or 0.0) <= limit), None) for limit in LIMITS]
    return [
        (tuple(limit for limit, _ in pairs), row)
        for row, pairs in groupby(zip(LIMITS, chosen, strict=True), key=lambda pair: pair[1])
        if row
    ]


def _dominates(a: Row, b: Row) -> bool:
    if a.variant.printed or not a.cost or not b.cost or a.error is None or b.error is None:
        return False
    error_a, error_b = max(a.error, EXACT), max(b.error, EXACT)
    cheaper = a.cost.high < b.cost.low  # overlapping intervals have no reliable order
    return error_a <= error_b and (cheaper or (a.cost.low <= b.cost.high and error_a < error_b))


def _images(variants: Iterable[MeasuredVariant]) -> Mapping[str, ImageError]:
    """Return image errors keyed by lobe; a variant without image uses its lobe's image error."""
    return {
        measured.variant.lobe: measured.image_error
        for measured in variants
        if measured.image_error is not None and not measured.variant.unclamped
    }
