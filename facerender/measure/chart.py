"""The variants that no other variant dominates in cost and error, and their chart as inline SVG;
chart.css has its colours for light and dark mode."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerender.measure.measurement import MeasuredVariant, Measurement, rows_of, slope_of
from facerender.pricing.cost import Interval, Variant, of_model

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
    variant meets is absent.
    """
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


STYLE = Path(__file__).with_name("chart.css")
_WIDTH, _HEIGHT = 340, 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 50.0, 324.0, 22.0, 230.0  # edges of the plot area
_FONT = 12.0  # font size of chart.css
_LETTER = 0.72  # mean width of a bold letter in font sizes; wide fonts have about 0.7
_RADIUS = 4.0
# Candidate positions of a name: distances from its point, and directions.
_DISTANCES = (8, 13, 19, 27, 38, 50)
_DIRECTIONS = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))

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
        *_names(rows, bars, _boxes(bars, front)),
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
    return (
        f'<g class="{row.css_class}"><title>{escape(row.variant.name)}</title>'
        f'<path d="{bar}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="{_RADIUS}"/></g>'
    )


def _boxes(bars: Sequence[Box], front: Sequence[tuple[float, float]]) -> list[Box]:
    """Return the boxes of points, of intervals and of the line, which names do not overlap."""
    boxes = [(x - _RADIUS, y - _RADIUS, x + _RADIUS, y + _RADIUS) for x, y, *_ in bars]
    boxes += [(low - 2.0, y - 3.0, high + 2.0, y + 3.0) for _, y, low, high in bars]
    for (x, y), (next_x, next_y) in pairwise(front):
        boxes += [(x, y - 1.0, next_x, y + 1.0), (next_x - 1.0, y, next_x + 1.0, next_y)]
    return boxes


def _names(rows: Sequence[Row], bars: Sequence[Box], boxes: list[Box]) -> list[str]:
    """Return names with lines to their points; no name overlaps one of ``boxes``."""
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
