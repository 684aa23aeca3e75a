"""Limits in pytest's ini file or pyproject.toml, for the pytest plugin and ``facerender compare
--limits``. ``calibration.py`` finds them.

Limits for linear images stand among pytest's own settings, as ``facerender_point`` and so on; those
for 8-bit images, which no golden is, in a section of their own.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from configparser import Error as IniError
from configparser import RawConfigParser
from dataclasses import fields
from pathlib import Path
from typing import Any

from facerender.comparison.result import HIGHEST, Limits
from facerender.errors import InputError, check_range, reason, shown
from facerender.images.image import Encoding
from facerender.system.files import read_file, tables_of

NAMES = tuple(field.name for field in fields(Limits))
PREFIX = "facerender_"
_MOST = 1 << 20  # bytes of a file

Noted = Mapping[str, tuple[float, str]]  # limits by name, each with a comment


def read_limits(path: str | os.PathLike[str]) -> dict[Encoding, dict[str, float]]:
    """Return the limits of a file by the encoding of the images that they are for.

    path : .ini, .cfg or .toml

    Raises
    ------
    InputError : the file cannot be read, or holds an invalid limit or none
    """
    path = Path(path)
    data = _parsed(path)
    found: dict[Encoding, dict[str, float]] = {}
    for encoding, section in _sections(path, data).items():
        table = _within(data, section)
        found[encoding] = {
            name: _number(f"{path}: {PREFIX}{name}", table[PREFIX + name])
            for name in NAMES
            if PREFIX + name in table
        }
    if not any(found.values()):
        raise InputError(f"{path} gives no limit, such as {PREFIX}{NAMES[0]}: add one")
    return found


def text_of(path: str | os.PathLike[str], limits: Mapping[Encoding, Noted]) -> str:
    """Return limits as sections of a file with the suffix of this path."""
    path = Path(path)
    quote = '"' if path.suffix == ".toml" else ""
    rows = []
    for encoding, noted in limits.items():
        rows += ["", f"[{'.'.join(_sections(path, {})[encoding])}]"]
        for name, (limit, note) in noted.items():
            rows.append(f"# {PREFIX}{name}: {note}")
            rows.append(f"{PREFIX}{name} = {quote}{limit:g}{quote}")
    return "\n".join(rows[1:])


def _number(name: str, value: Any) -> float:
    try:
        limit = float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name} = {shown(value)}: give a number") from None
    check_range(name, limit, 0.0, HIGHEST)
    return limit


def _parsed(path: Path) -> dict[str, Any]:
    """Return the sections of a file by name; TOML's within each other."""
    content = read_file(path, "an ini file", _MOST)
    if path.suffix == ".toml":
        return tables_of(content, str(path))
    parser = RawConfigParser(inline_comment_prefixes=("#", ";"), default_section="")
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    try:
        parser.read_string(content.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8: save it as such") from None
    except IniError as error:
        raise InputError(f"{path} cannot be read: {reason(error)}; repair it") from None
    return {name: dict(parser[name]) for name in parser.sections()}


def _sections(path: Path, data: Mapping[str, Any]) -> dict[Encoding, tuple[str, ...]]:
    """Return the names of the sections with limits, from the outermost, in a file of this data."""
    if path.suffix == ".toml":
        own = set(_within(data, ("tool", "pytest"))) - {"ini_options"}  # from pytest 9 on
        inner = () if own else ("ini_options",)
        return {"linear": ("tool", "pytest", *inner), "srgb8": ("tool", "facerender", "8-bit")}
    pytest = "tool:pytest" if path.suffix == ".cfg" else "pytest"
    return {"linear": (pytest,), "srgb8": ("facerender:8-bit",)}


def _within(data: Mapping[str, Any], section: tuple[str, ...]) -> Mapping[str, Any]:
    for name in section:
        inner = data.get(name, {})
        data = inner if isinstance(inner, dict) else {}
    return data
