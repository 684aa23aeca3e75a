"""Limits kept in an ini file, the one that pytest reads: from there the pytest plugin takes them,
and ``facerender compare --limits``. How they are found is in ``calibration.py``.

Those for linear images stand among pytest's own settings, as ``facerender_point`` and so on; those
for 8-bit images, which no golden is, in a section of their own.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from configparser import Error as IniError
from configparser import RawConfigParser
from dataclasses import fields
from pathlib import Path
from typing import Any

from facerender.comparison.compare import HIGHEST, Limits
from facerender.errors import InputError, check_range, reason, shown
from facerender.images.image import Encoding
from facerender.system.atomic import write_bytes
from facerender.system.files import read_file, tables_of

NAMES = tuple(field.name for field in fields(Limits))
PREFIX = "facerender_"
_KEYS = f"{PREFIX}(?:{'|'.join(NAMES)})"
_OURS = re.compile(rf"\s*(?:{_KEYS}\s*[=:]|# {_KEYS}: )")
_MOST = 1 << 20  # bytes of a file

Noted = Mapping[str, tuple[float, str]]  # limits by name, and what stands above them
Data = dict[str, Any]  # of sections by their names, in TOML within each other


def read_limits(path: str | os.PathLike[str]) -> dict[Encoding, dict[str, float]]:
    """Return the limits that a file gives, by the encoding of the images that they are for.

    path : .ini or .cfg, or pyproject.toml

    Raises
    ------
    InputError : it cannot be read, or gives a limit that is none, or no limit at all
    """
    path = Path(path)
    found = _limits(path, _parsed(path, _text(path)))
    if not any(found.values()):
        raise InputError(f"{path} gives no limit, such as {PREFIX}{NAMES[0]}: add one")
    return found


def text_of(path: str | os.PathLike[str], limits: Mapping[Encoding, Noted]) -> str:
    """Return limits as they stand in a file; parameters as of :func:`write_limits`."""
    path = Path(path)
    sections = _sections(path, {})
    texts = (
        "\n".join([f"[{'.'.join(sections[encoding])}]", *_rows(path, noted)])
        for encoding, noted in limits.items()
    )
    return "\n\n".join(texts)


def write_limits(path: str | os.PathLike[str], limits: Mapping[Encoding, Noted]) -> None:
    """Write limits into a file, whole or not at all, in place of those that it gives for the same
    images. Whatever else it holds stays as it is, comments too.

    Parameters
    ----------
    path : as of :func:`read_limits`; where there is no file, it is made

    Raises
    ------
    InputError : the file cannot be read or written, or not without a change of something else
    """
    path = Path(path)
    text = _text(path) if os.path.exists(path) else ""
    before = _parsed(path, text)
    rows = text.splitlines()
    sections = _sections(path, before)
    for encoding, noted in limits.items():
        _put(rows, ".".join(sections[encoding]), _rows(path, noted))
    changed = "\n".join([*rows, ""])
    try:
        after = _parsed(path, changed)
        found = _limits(path, after)
        safe = _others(after, sections) == _others(before, sections) and all(
            found[encoding] == {name: float(f"{limit:g}") for name, (limit, _) in noted.items()}
            for encoding, noted in limits.items()
        )
    except InputError:
        safe = False
    if not safe:
        raise InputError(
            f"{path} is laid out so that limits cannot be put into it: give another file, and copy "
            "them from there"
        )
    if "\r\n" in text:
        changed = changed.replace("\n", "\r\n")
    write_bytes(path, changed.encode())


def _limits(path: Path, data: Data) -> dict[Encoding, dict[str, float]]:
    found: dict[Encoding, dict[str, float]] = {}
    for encoding, section in _sections(path, data).items():
        kept = _within(data, section)
        given = {name: kept[PREFIX + name] for name in NAMES if PREFIX + name in kept}
        found[encoding] = {name: _number(path, name, text) for name, text in given.items()}
    return found


def _number(path: Path, name: str, text: Any) -> float:
    try:
        limit = float(text)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: {PREFIX}{name} = {shown(text)}: give a number") from None
    check_range(f"{path}: {PREFIX}{name}", limit, 0.0, HIGHEST)
    return limit


def _rows(path: Path, noted: Noted) -> list[str]:
    quote = '"' if path.suffix == ".toml" else ""
    rows = []
    for name, (limit, note) in noted.items():
        rows.append(f"# {PREFIX}{name}: {note}")
        rows.append(f"{PREFIX}{name} = {quote}{limit:g}{quote}")
    return rows


def _put(rows: list[str], section: str, ours: list[str]) -> None:
    """Replace the rows of limits in a section, or add them at its beginning."""
    header = re.compile(rf"\[\s*{re.escape(section)}\s*\]\s*(?:[#;].*)?$")
    start = next((i for i, row in enumerate(rows) if header.match(row)), None)
    if start is None:
        rows += [*([""] if rows else []), f"[{section}]", *ours]
        return
    end = next((i for i in range(start + 1, len(rows)) if rows[i].startswith("[")), len(rows))
    old = [i for i in range(start + 1, end) if _OURS.match(rows[i])]
    for i in reversed(old):
        del rows[i]
    place = old[0] if old else start + 1
    rows[place:place] = ours


def _text(path: Path) -> str:
    try:
        return read_file(path, "an ini file", _MOST).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8: save it as such") from None


def _parsed(path: Path, text: str) -> Data:
    if path.suffix == ".toml":
        return tables_of(text.encode(), str(path))
    parser = RawConfigParser(inline_comment_prefixes=("#", ";"), default_section="")
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    try:
        parser.read_string(text)
    except IniError as error:
        raise InputError(f"{path} cannot be read: {reason(error)}; mend it") from None
    return {name: dict(parser[name]) for name in parser.sections()}


def _sections(path: Path, data: Data) -> dict[Encoding, tuple[str, ...]]:
    """Return where the limits stand in a file that holds this."""
    if path.suffix == ".toml":
        own = set(_within(data, ("tool", "pytest"))) - {"ini_options"}  # from pytest 9 on
        inner = () if own else ("ini_options",)
        return {"linear": ("tool", "pytest", *inner), "srgb8": ("tool", "facerender", "8-bit")}
    pytest = "tool:pytest" if path.suffix == ".cfg" else "pytest"
    return {"linear": (pytest,), "srgb8": ("facerender:8-bit",)}


def _within(data: Data, section: tuple[str, ...]) -> Data:
    for name in section:
        inner = data.get(name, {})
        data = inner if isinstance(inner, dict) else {}
    return data


def _others(data: Data, sections: Mapping[Encoding, tuple[str, ...]]) -> list[tuple[Any, ...]]:
    """Return all that is no limit, as paths through the sections."""
    ours = {(*section, PREFIX + name) for section in sections.values() for name in NAMES}

    def walk(value: Any, path: tuple[str, ...]) -> list[tuple[Any, ...]]:
        if isinstance(value, dict):
            return [each for name in value for each in walk(value[name], (*path, name))]
        return [] if path in ours else [(*path, value)]

    return walk(data, ())
