"""Converts rows of a job table to nested plain data: expands keys and shorthands, merges tables.

``formats.py`` reads the files; ``jobs.py`` makes jobs from the rows.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np

from facerender.errors import InputError, clipped, shown
from facerender.scenes.camera import orbit_of
from facerender.scenes.file import parse_environment
from facerender.scenes.light import Light, parse_light
from facerender.scenes.scene import Scene

Table = dict[str, Any]

_DEEPEST = 10  # levels of nested tables and lists
_DIGITS = frozenset("0123456789")
_MOST_BITS = 64  # largest size of a whole number, in bits


def nested(row: Any) -> Table:
    """Return a row as nested tables of plain data.

    Dotted keys become nested tables, and None values are removed. A mesh, an environment, a camera
    or a light that is given as text becomes a table. Numbered items (``lights.0.azimuth``) stay
    tables with numbers as keys until :func:`listed` converts them.

    Raises
    ------
    InputError : the row is not a table, a key is given twice, a value is not plain data, or the
        text of a light, a camera or an environment is invalid
    """
    if type(row) is not dict and not isinstance(row, Mapping):
        raise InputError(f"row = {shown(row)}: give a table")
    values: Table = {}
    for key, value in row.items():
        if key == "mesh" and isinstance(value, str | os.PathLike):
            key = "mesh.path"
        elif key == "environment" and isinstance(value, str):
            parts = islice(asdict(parse_environment(value)).items(), value.count(",") + 1)
            values |= {f"environment.{name}": part for name, part in parts}
            continue
        elif key == "camera" and isinstance(value, str):
            values |= {f"camera.{name}": number for name, number in orbit_of(value).items()}
            continue
        if key in values:
            raise InputError(f"{key} is given twice: leave one out")
        values[key] = value
    tables: Table = _plain(values, "", 0)
    if "lights" in tables:
        tables["lights"] = _lights(tables["lights"])
    return tables


def placed(keys: Sequence[str], value: Any) -> Any:
    """Return a value inside nested tables with the given keys, the outermost key first."""
    for key in reversed(keys):
        value = {key: value}
    return value


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
            if type(base_value) is list and _places(value):
                items = {str(place): item for place, item in enumerate(base_value)}
                value = listed(merged(items, value), key)
            elif type(base_value) is dict:
                value = merged(base_value, value)
        table[key] = value
    return table


def with_default_lights(tables: Table) -> Table:
    """Return the tables of a row, with the default lights if the row changes single lights by
    numbered keys, such as ``lights.0.azimuth``. A light with a position replaces the default."""
    changes = tables.get("lights")
    if not changes or type(changes) is not dict or not _places(changes):
        return tables
    default = () if "environment" in tables else Scene.lights
    lights = {
        str(place): _table_of(light)
        for place, light in enumerate(default)
        if not isinstance(change := changes.get(str(place)), dict) or "position" not in change
    }
    return {**tables, "lights": merged(lights, changes)}


def listed(value: Any, name: str) -> Any:
    """Convert tables with the keys 0, 1, 2, ... into lists, except ``parts``; raise InputError if a
    number is missing among these keys."""
    if type(value) is dict:
        items = {
            key: listed(item, f"{name}.{key}") if type(item) in (dict, list) else item
            for key, item in value.items()
        }
        if not items or not _places(items) or name == "parts":
            return items
        for place in range(len(items)):
            if str(place) not in items:
                raise InputError(f"{name} lacks item {place}: count from 0 without gaps")
        return [items[str(place)] for place in range(len(items))]
    if type(value) is list and value and type(value[0]) is dict:
        return [listed(item, f"{name}.{place}") for place, item in enumerate(value)]
    return value


def _places(table: Table) -> bool:
    return all(map(_DIGITS.issuperset, table))


def _plain(value: Any, name: str, depth: int) -> Any:
    kind = type(value)
    if kind is float and not math.isfinite(value):
        raise InputError(f"{name} = {value!r}: give a finite number")
    if kind is int and value.bit_length() > _MOST_BITS:
        raise InputError(f"{name} = {shown(value)}: a whole number has at most {_MOST_BITS} bits")
    if kind in (str, bool, float, int):
        return value
    if depth > _DEEPEST:
        raise InputError(
            f"{name.split('.')[0]} has tables or lists {depth} deep: use at most {_DEEPEST} levels"
        )
    if kind is dict or isinstance(value, Mapping):
        return _plain_table(value, name, depth)
    if kind is list or isinstance(value, list | tuple):
        return [_plain(item, f"{name}.{place}", depth + 1) for place, item in enumerate(value)]
    if isinstance(value, np.generic | np.ndarray):
        return _plain(value.tolist(), name, depth + 1)
    if isinstance(value, os.PathLike):
        return _plain(os.fspath(value), name, depth + 1)
    raise InputError(
        f"{name} = {shown(value)}: give a number, true or false, text, a list or a table"
    )


def _plain_table(value: Mapping[Any, Any], name: str, depth: int) -> Table:
    table: Table = {}
    for key, entry in value.items():
        if not isinstance(key, str):
            raise InputError(f"key {shown(key)}{f' of {name}' if name else ''}: give text")
        if entry is None:
            continue
        full = f"{name}.{key}" if name else key
        entry = _plain(entry, full, depth + 1)
        if entry == {} and value[key]:  # the value contained only None
            continue
        if "." in key and name != "parts":  # the names of parts may contain dots
            key, *parts = key.split(".")
            if depth + len(parts) > _DEEPEST:
                raise InputError(f"key {shown(full)} has too many dots: use at most {_DEEPEST}")
            entry = placed(parts, entry)
        table[key] = _joined(table[key], entry, full) if key in table else entry
    return table


def _joined(base: Any, addition: Any, name: str) -> Any:
    """Add the values of table `addition` to table `base`, and return `base`."""
    if type(base) is not dict or type(addition) is not dict:
        raise InputError(f"{clipped(name)} is given twice, or as a whole and in parts: remove one")
    for key, value in addition.items():
        base[key] = _joined(base[key], value, name) if key in base else value
    return base


def _lights(lights: Any) -> Any:
    def table_of(light: Any) -> Any:
        return _light(light) if isinstance(light, str) else light

    if type(lights) is dict:
        return {key: table_of(light) for key, light in lights.items()}
    lights = [lights] if isinstance(lights, str) else lights
    return [table_of(light) for light in lights] if type(lights) is list else lights


@lru_cache(1024)
def _light(text: str) -> Table:
    return _table_of(parse_light(text))


def _table_of(light: Light) -> Table:
    table: Table = _plain_table(asdict(light), "", 0)
    return table
