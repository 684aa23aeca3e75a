"""Tables: settings as plain data, which files and options are before a record is built from them.

Several sources of one job (defaults, scene file, row or options) are merged as tables, so that each
may set single fields; the record is built, and checked, once from the result."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from facerender.errors import InputError

Table = dict[str, Any]

_DIGITS = frozenset("0123456789")


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
    """Convert tables with the keys 0, 1, 2, ... into lists. Raise InputError if a number is missing
    among these keys.

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
    """Return TOML text for values, tables of values, and lists of such tables. Keys whose value is
    None are omitted."""
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
    return repr(value.item() if isinstance(value, np.generic) else value)
