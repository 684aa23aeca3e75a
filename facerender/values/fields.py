"""Fields of records: the values that a setting accepts, its default, and its description.

A setting is stated once, on the field of its record:

    @record("light ")
    class Light:
        azimuth: float = field(AZIMUTHS, 0.0, "direction to the light")

Everything else reads the field: the constructor checks and converts the value, :func:`build` makes
records from tables and texts of files and options, the record's docstring and the options of the
command line state text, range, unit and default. So a new setting is one line here, and its use.

Settings that files and options give as tables are merged first (:func:`merged`): each source of a
job (defaults, scene file, row or options) may set single fields.

Standard dataclasses do this in 5 ms; attrs, pydantic and click need 12 to 127 ms of a cold start.
Values are checked here, at the border. Code that receives a record does not check it again."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields
from functools import cache
from numbers import Integral
from textwrap import TextWrapper
from typing import Any, TypeVar, dataclass_transform

from facerender.errors import InputError, check_range, is_number, quoted

T = TypeVar("T")
_DIGITS = frozenset("0123456789")
Table = dict[str, Any]


class Limits:
    """The values that a field accepts. Subclasses define :meth:`check`; ``str()`` is for help."""

    unit = ""

    def __str__(self) -> str:
        return ""

    def check(self, name: str, value: Any) -> Any:
        """Return the value, converted to the type of the field. Raise InputError with the name, the
        value and the remedy if the value is not accepted."""
        raise NotImplementedError


@dataclass(frozen=True)
class Range(Limits):
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
        check_range(name, value, self.low, self.high)
        return float(value)


class IntegerRange(Range):
    """The whole numbers from low to high. The field is an int."""

    def __contains__(self, value: Any) -> bool:
        return isinstance(value, Integral) and super().__contains__(value)

    def check(self, name: str, value: Any) -> Any:
        if value not in self:
            preposition = "from" if self.high < math.inf else "of"
            is_whole = isinstance(value, Integral) and is_number(value)
            article = "" if is_whole and self.high < math.inf else f"a whole number {preposition} "
            raise InputError(f"{name} = {quoted(value)}: give {article}{self}")
        return int(value)


class SizeRange(IntegerRange):
    """Width and height of an image in pixels; one number stands for both, and a text such as
    "640x480" for a pair. The field is a pair (width, height)."""

    def check(self, name: str, value: Any) -> Any:
        sides = value.tolist() if hasattr(value, "tolist") else value
        if isinstance(value, str):
            if not re.fullmatch(r"-?\d{1,9}(x-?\d{1,9})?", value.lower()):
                raise InputError(f"{name} {quoted(value)}: give N or WxH, such as 1024 or 640x480")
            sides = [int(number) for number in value.lower().split("x")]
            sides = sides * 2 if len(sides) == 1 else sides
        sides = (sides, sides) if is_number(sides) else sides
        if not isinstance(sides, tuple | list) or len(sides) != 2:
            remedy = "give width and height in pixels, or one number for both"
            raise InputError(f"{name} = {quoted(value)}: {remedy}")
        width, height = sides
        if width not in self or height not in self:
            are_whole = all(is_number(side) and isinstance(side, Integral) for side in sides)
            bounds = f"{'' if are_whole else 'whole numbers from '}{self.low:g} to {self.high:.0f}"
            size = f"{quoted(width)} x {quoted(height)}"
            raise InputError(f"{name} {size}: give {bounds} {self.unit} a side")
        return int(width), int(height)


@dataclass(frozen=True)
class VectorRange(Range):
    """Three numbers in the range.

    other : further valid values, for messages, such as ", or None"
    single : whether one number stands for three equal numbers
    none : text that stands for None, such as "none"; "" if there is no such text
    """

    other: str = ""
    single: bool = True
    none: str = ""

    def check(self, name: str, value: Any) -> Any:
        several = value.tolist() if hasattr(value, "tolist") else value
        if isinstance(value, str):
            if self.none and value == self.none:
                return None
            with suppress(ValueError):  # the message below quotes the text
                several = [*map(float, value.split(","))]
                several = several[0] if len(several) == 1 else several
        numbers = [*several] if isinstance(several, list | tuple) else [several] * 3 * self.single
        if len(numbers) != 3 or not all(number in self for number in numbers):
            bounds = f"[{self.low:g}, {self.high:g}] {self.unit}".strip()
            few = f"a number in {bounds}, or three" if self.single else f"three numbers in {bounds}"
            raise InputError(f"{name} = {quoted(value)}: give {few}{self.other}")
        return tuple(map(float, numbers))


@dataclass(frozen=True)
class Choice(Limits):
    """One of several names, or of several numbers.

    names : the choices; a mapping stands for its keys, and may grow later
    noun : name of the choice in messages; "" for the name of the field
    """

    names: Iterable[Any]
    noun: str = ""

    def __str__(self) -> str:
        return ", ".join(map(str, self.names))

    def check(self, name: str, value: Any) -> Any:
        names = [*self.names]
        if isinstance(value, bool) or not (isinstance(value, str | float | int) and value in names):
            if isinstance(names[0], int):
                raise InputError(f"{name} = {quoted(value)}: give one of {self}")
            raise InputError(f"unknown {self.noun or name} {quoted(value)}; known: {self}")
        return names[names.index(value)]  # the whole number 8, not 8.0


@dataclass(frozen=True)
class Typed(Limits):
    """The values of a type.

    remedy : description of the values, or an expression that makes one, for messages
    """

    of: Any  # type, or union of types
    remedy: str

    def check(self, name: str, value: Any) -> Any:
        if not isinstance(value, self.of):
            raise InputError(f"{name} = {quoted(value)}: give {self.remedy}")
        return value


class Instance(Typed):
    """The objects of a class, which files and options do not have."""


class FilePath(Typed):
    """A path as text or as ``os.PathLike``. The field is a text."""

    def check(self, name: str, value: Any) -> Any:
        if not (path := os.fspath(super().check(name, value))):
            raise InputError(f"{name} is empty: give a path")
        return path


@dataclass(frozen=True)
class Entries(Limits):
    """A table of values that have the same limits.

    noun : name of a value in messages, before its key
    keys : description of the keys, for messages
    """

    limits: Limits
    noun: str
    keys: str

    def check(self, name: str, value: Any) -> Any:
        if not isinstance(value, Mapping):
            raise InputError(f"{name} = {quoted(value)}: give a table, keyed by {self.keys}")
        return {str(k): self.limits.check(f"{self.noun} {k}", v) for k, v in value.items()}


@dataclass(frozen=True)
class Built(Limits):
    """A record, or a value from which :func:`build` makes it."""

    record: type

    def check(self, name: str, value: Any) -> Any:
        return build(self.record, value, name)


@dataclass(frozen=True)
class Several(Limits):
    """Several records, each as in :class:`Built`; one record or one text stands for a list.

    groups : records that stand together under one name
    """

    record: type
    groups: Mapping[str, Sequence[Any]] = dataclasses.field(default_factory=dict)

    def check(self, name: str, value: Any) -> Any:
        several = [value] if isinstance(value, str | self.record) else value
        if isinstance(several, Mapping | bytes) or not isinstance(several, Iterable):
            raise InputError(f"{name} = {quoted(value)}: give a list, each {_forms(self.record)}")
        return tuple(build(self.record, item, name) for item in ungrouped(several, self.groups))


def ungrouped(items: Iterable[Any], groups: Mapping[str, Sequence[Any]]) -> Iterator[Any]:
    """Yield items, and in place of the name of a group its members."""
    for item in items:
        yield from groups.get(item, (item,)) if isinstance(item, str) else (item,)


FRACTION = Range(0.0, 1.0)
EXPOSURES = Range(-100.0, 100.0, "stops")  # Exposure of images encoded for a display.
MEMORY = Range(1.0, 1e9, "MiB")  # Memory limit of the process.
SWITCH, TEXT = Typed(bool, "true or false"), Typed(str, "text")
PATH = FilePath(str | os.PathLike, "a path as text")


def field(
    limits: Limits,
    default: Any = MISSING,
    text: str = "",
    note: str = "",
    unset: str = "",
    **keywords: Any,
) -> Any:
    """Return a field of a record. None is also allowed if it is the default, or if the annotation
    ends with ``| None``; the module needs ``from __future__ import annotations``.

    text : description without range, unit and default, which docstrings and help texts add
    note : further sentences, without the period at the end
    unset : default as docstrings and help texts state it; "" for the default itself
    keywords : further arguments of ``dataclasses.field``
    """
    metadata = {"limits": limits, "text": text, "note": note, "unset": unset}
    return dataclasses.field(default=default, metadata=metadata, **keywords)


def field_of(cls: Any, name: str) -> Any:
    """Return a field that is equal to a field of another record."""
    other = cls.__dataclass_fields__[name]
    return field(default=other.default, **other.metadata)


# Without field_specifiers, type checkers take every field as one with a default. With them, they
# would recognise only defaults that are keyword arguments.
@dataclass_transform(frozen_default=True)
def record(noun: str = "") -> Callable[[type[T]], type[T]]:
    """Return a decorator that makes a frozen dataclass whose constructor checks and converts its
    fields, then calls ``__post_init__``, which checks what several fields have in common.

    noun : text before the names of fields in messages, for example "light "
    """

    def decorate(cls: Any) -> Any:
        check_together = cls.__dict__.get("__post_init__", getattr(cls, "_check_together", None))

        def __post_init__(self: Any) -> None:
            for name, limits, optional in _checked(cls):
                value = getattr(self, name)
                if value is not None or not optional:
                    object.__setattr__(self, name, limits.check(noun + name, value))
            if check_together:
                check_together(self)

        cls.__post_init__, cls._check_together = __post_init__, check_together
        cls.__repr__ = short_repr
        cls.__getstate__ = parameters
        cls = dataclass(frozen=True, repr=False)(cls)
        cls.__doc__ = _documented(cls)
        return cls

    return decorate


@cache
def limits_of(cls: Any) -> Mapping[str, Any]:
    """Return the limits of the fields that tables of files have, keyed by field."""
    return {name: limits for name, limits, _ in _checked(cls) if not isinstance(limits, Instance)}


def range_of(cls: Any, name: str) -> Any:
    """Return the limits of a field, for example ``range_of(Light, "radius")``."""
    return limits_of(cls)[name]


def described(cls: Any, name: str) -> dict[str, Any]:
    """Return text, note, limits and default of a field, for help; ``unset`` is the default and
    ``bounds`` the limits, as text."""
    member = cls.__dataclass_fields__[name]
    default, unset = member.default, member.metadata["unset"]
    if not unset and isinstance(default, bool):
        unset = "on" if default else "off"
    elif not unset and isinstance(default, str | float | int | tuple):
        values = default if isinstance(default, tuple) else (default,)
        unset = ",".join(v if isinstance(v, str) else f"{v:g}" for v in values)
    bounds = str(member.metadata["limits"])
    return {**member.metadata, "default": default, "unset": unset, "bounds": bounds}


@cache
def _checked(cls: Any) -> tuple[tuple[str, Limits, bool], ...]:
    return tuple(
        (f.name, f.metadata["limits"], f.default is None or str(f.type).endswith("| None"))
        for f in fields(cls)
        if "limits" in f.metadata
    )


_WRAPPER = TextWrapper(100, "    ", "        ", break_long_words=False, break_on_hyphens=False)


def _documented(cls: Any) -> str:
    """Return the docstring of a record with its fields in the section "Parameters"."""
    text = (cls.__doc__ or "").rstrip()
    lines = [text] if "Parameters\n" in text else [text, "", "    Parameters", "    ----------"]
    for f in (cls.__dataclass_fields__[name] for name in limits_of(cls)):
        description = described(cls, f.name)
        bounds, default, note = (description[key] for key in ("bounds", "unset", "note"))
        text = f"{f.name} : {description['text']}" + f" ({bounds})" * bool(bounds)
        text += f"; default {default}" * bool(default) + f". {note}" * bool(note)
        lines.append(_WRAPPER.fill(" ".join(text.split())))
    return "\n".join(lines) + "\n    "


def build(cls: type[T], value: Any, where: str) -> T:
    """Return a record from itself, from a table of its fields, or from a text. A path object stands
    for the first field, if it is a path. Raise InputError if a key is unknown or missing, or a
    value is outside its range.

    cls : record. Its class method ``parse``, if any, returns the table that a text stands for, and
        ``TEXTS`` describes these texts for messages
    where : name of the value in messages, for example "lights"; "" for the outermost table
    """
    if isinstance(value, cls):
        return value
    limits, parse = limits_of(cls), getattr(cls, "parse", None)  # type: ignore[arg-type]
    if isinstance(value, str) and parse:
        value = parse(value)
    elif isinstance(value, os.PathLike) and isinstance(next(iter(limits.values())), FilePath):
        value = {next(iter(limits)): os.fspath(value)}  # not a text, in which commas have a meaning
    if not isinstance(value, Mapping):
        raise InputError(f"{where or 'job'} = {quoted(value)}: give {_forms(cls)}")
    for key in value:
        if key not in limits:
            part = f" in {where}" if where else ""
            raise InputError(f"unknown key {quoted(key)}{part}; known: {', '.join(limits)}")
    for f in fields(cls):  # type: ignore[arg-type]
        if f.default is f.default_factory is MISSING and f.name not in value:
            raise InputError(f"{where} {quoted(dict(value))} lacks {f.name}: add it")
    return cls(**value)


def _forms(cls: Any) -> str:
    """Return a description of the values from which a record is built, for messages."""
    texts = f"{cls.TEXTS}, " if hasattr(cls, "parse") else ""
    return f"a facerender.{cls.__name__}, {texts}or a table of {', '.join(limits_of(cls))}"


def plain(value: Any, changed: bool = False) -> dict[str, Any]:
    """Return the fields of a record as plain data for JSON and TOML; :func:`build` is the inverse.
    Fields that are None, or empty by default, are left out.

    changed : whether fields with their default value are left out, too
    """
    table = {}
    for f in fields(value):
        member = getattr(value, f.name)
        if dataclasses.is_dataclass(member):
            member = plain(member, changed)
        elif isinstance(member, tuple) and member and dataclasses.is_dataclass(member[0]):
            member = [plain(item, changed) for item in member]
        if member in (None, {}) or (member == f.default and (changed or member in ((), ""))):
            continue
        table[f.name] = [*member] if isinstance(member, tuple) else member
    return table


def parameters(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass. As ``__getstate__``, pickles omit its cached properties."""
    return {f.name: getattr(value, f.name) for f in fields(value)}


def short_repr(value: Any) -> str:
    """Return the repr of a dataclass with only the fields that differ from their defaults."""
    words = []
    for f in fields(value):
        member, factory = getattr(value, f.name), f.default_factory
        if f.repr and member != (f.default if factory is MISSING else factory()):
            words.append(f"{f.name}={member!r}")
    return f"{type(value).__name__}({', '.join(words)})"


def merged(base: Table, over: Table) -> Table:
    """Return table `base`, updated with table `over`.

    Nested tables are merged, numbered items replace items of a list, and other values are replaced.
    The arguments are not modified; the result may share parts with the arguments.
    Raise InputError if a numbered item is not in the list and does not extend it by one.
    """
    table = dict(base)
    for key, value in over.items():
        if type(value) is dict and key in table:
            base_value = table[key]
            if type(base_value) is list and has_numbers(value):
                items = {str(index): item for index, item in enumerate(base_value)}
                value = listed(merged(items, value), key)
            elif type(base_value) is dict:
                value = merged(base_value, value)
        table[key] = value
    return table


def listed(value: Any, name: str, named: tuple[str, ...] = ()) -> Any:
    """Convert tables with the keys 0, 1, 2... into lists. Raise InputError if a number is missing.

    named : names of tables whose keys are names, also if these are numbers
    """
    if type(value) is dict:
        items = {
            key: listed(item, f"{name}.{key}", named) if type(item) in (dict, list) else item
            for key, item in value.items()
        }
        if not items or not has_numbers(items) or name in named:
            return items
        for index in range(len(items)):
            if str(index) not in items:
                raise InputError(f"{name} lacks item {index}: count from 0 without gaps")
        return [items[str(index)] for index in range(len(items))]
    if type(value) is list and value and type(value[0]) is dict:
        return [listed(item, f"{name}.{index}", named) for index, item in enumerate(value)]
    return value


def has_numbers(table: Table) -> bool:
    """Return whether all keys of a table are numbers, so that it changes items of a list."""
    return all(map(_DIGITS.issuperset, table))


def toml_text(values: Mapping[str, Any]) -> str:
    """Return TOML text for values, tables of values, and lists of such tables; None is omitted."""
    tables: list[tuple[str, Mapping[str, Any]]] = []
    simple = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            tables.append((f"[{key}]", value))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            tables += [(f"[[{key}]]", table) for table in value]
        else:
            simple[key] = value
    blocks = []
    for head, table in [*([("", simple)] if simple else []), *tables]:
        entries = {key: value for key, value in table.items() if value is not None}
        lines = [f"{_key(key)} = {_toml(value)}" for key, value in entries.items()]
        blocks.append("\n".join(filter(None, [head, *lines])) + "\n")
    return "\n".join(blocks)


def _key(name: str) -> str:
    """Return a key of TOML, in quotes unless its characters need none."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _json(name)


def _json(value: bool | str) -> str:
    """Return a value whose text is equal in JSON and TOML, except that TOML escapes DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", r"\u007f")


def _toml(value: Any) -> str:
    if isinstance(value, bool | str):
        return _json(value)
    if isinstance(value, Mapping):
        pairs = (f"{_key(key)} = {_toml(entry)}" for key, entry in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value.item() if hasattr(value, "item") else value)
