"""Ranges of values.

Each range is defined once, on the dataclass field that it limits. Constructors, the command line,
the explorer and the checks of batches read the range from this field."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from numbers import Integral
from typing import Any

from facerender.errors import InputError, check_range, check_switch, is_number, shown


@dataclass(frozen=True)
class Range:
    """The numbers from low to high, both included; high may be infinite.

    unit : unit of the values, for example "degrees"; "" if there is none
    """

    low: float
    high: float
    unit: str = ""

    def __contains__(self, value: Any) -> bool:
        """Return whether a value is a number in the range."""
        return bool(is_number(value) and self.low <= value <= self.high)

    def __str__(self) -> str:
        several = f"{self.low:g} to {self.high:g}"
        bounds = several if self.high < math.inf else f"at least {self.low:g}"
        return f"{bounds} {self.unit}".strip()

    def check(self, name: str, value: Any) -> Any:
        """Return the value, converted to the type of the field. Raises InputError if it is outside
        the range or has another type."""
        check_range(name, value, self.low, self.high)
        return value


class IntegerRange(Range):
    """The whole numbers from low to high. The dataclass field is an int."""

    def __contains__(self, value: Any) -> bool:
        return isinstance(value, Integral) and super().__contains__(value)

    def check(self, name: str, value: Any) -> Any:
        if value not in self:
            preposition = "from" if self.high < math.inf else "of"
            is_whole = isinstance(value, Integral) and is_number(value)
            kind = "" if is_whole and self.high < math.inf else f"a whole number {preposition} "
            raise InputError(f"{name} = {shown(value)}: give {kind}{self}")
        return int(value)


class SizeRange(IntegerRange):
    """Width and height of an image in pixels; one number stands for both. The dataclass field is a
    pair (width, height)."""

    def check(self, name: str, value: Any) -> Any:
        sides = value.tolist() if hasattr(value, "tolist") else value
        sides = (sides, sides) if is_number(sides) else sides
        if not isinstance(sides, tuple | list) or len(sides) != 2:
            remedy = "give width and height in pixels, or one number for both"
            raise InputError(f"{name} = {shown(value)}: {remedy}")
        width, height = sides
        if width not in self or height not in self:
            are_whole = all(is_number(side) and isinstance(side, Integral) for side in sides)
            bounds = f"{'' if are_whole else 'whole numbers from '}{self.low:g} to {self.high:.0f}"
            size = f"{shown(width)} x {shown(height)}"
            raise InputError(f"{name} {size}: give {bounds} {self.unit} a side")
        return int(width), int(height)


@dataclass(frozen=True)
class VectorRange(Range):
    """Three numbers in the range.

    other : further valid values, for messages, such as ", or None"
    single : whether one number stands for three equal numbers
    """

    other: str = ""
    single: bool = True

    def check(self, name: str, value: Any) -> Any:
        several = value.tolist() if hasattr(value, "tolist") else value
        numbers = [*several] if isinstance(several, list | tuple) else [several] * 3 * self.single
        if len(numbers) != 3 or not all(number in self for number in numbers):
            bounds = f"[{self.low:g}, {self.high:g}] {self.unit}".strip()
            few = f"a number in {bounds}, or three" if self.single else f"three numbers in {bounds}"
            raise InputError(f"{name} = {shown(value)}: give {few}{self.other}")
        return tuple(map(float, numbers))


FRACTION = Range(0.0, 1.0)
EXPOSURES = Range(-100.0, 100.0, "stops")  # Exposure of images encoded for a display.
MEMORY = Range(1.0, 1e9, "MiB")  # Memory limit of the process.


def ranged(limits: Range, default: Any = MISSING) -> Any:
    """Return a dataclass field with a range. None is also allowed if the annotation of the field
    ends with ``| None``; the module needs ``from __future__ import annotations``."""
    return field(default=default, metadata={"range": limits})


@cache
def ranges_of(kind: type) -> Mapping[str, Range]:
    """Return the ranges of a dataclass, keyed by the field name."""
    return {item.name: item.metadata["range"] for item in fields(kind) if "range" in item.metadata}


def range_of(kind: type, name: str) -> Range:
    """Return the range of a field, for example ``range_of(Light, "radius")``."""
    return ranges_of(kind)[name]


def check_fields(value: object, prefix: str = "") -> None:
    """Check and convert the switches of a frozen dataclass and its fields with a range. Raises
    InputError if a value is outside its range, or a switch is neither true nor false.

    prefix : text before the field names in messages, for example "light "
    """
    kind: Any = type(value)
    for name, limits, optional in _checked(kind):
        field_value = getattr(value, name)
        if field_value is None and optional:
            continue
        if limits is None:
            check_switch(prefix + name, field_value)
        else:
            object.__setattr__(value, name, limits.check(prefix + name, field_value))


@cache
def _checked(kind: type) -> tuple[tuple[str, Range | None, bool], ...]:
    limits = ranges_of(kind)
    if not all(isinstance(member.type, str) for member in fields(kind)):
        raise TypeError(f"{kind.__module__} lacks: from __future__ import annotations")
    return tuple(
        (member.name, limits.get(member.name), str(member.type).endswith("| None"))
        for member in fields(kind)
        if member.name in limits or member.type in ("bool", "bool | None")
    )
