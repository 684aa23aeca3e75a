"""Jobs of a batch: reads the rows of a table one at a time and checks them.

``formats.py`` parses the files. This module does not use OpenGL.
"""

from __future__ import annotations

import os
import re
import string
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from facerender.batch.formats import found_rows, read_toml
from facerender.batch.tables import Table, listed, merged, nested, with_default_lights
from facerender.errors import InputError, check_known, check_path, clipped, shown
from facerender.scene.environment import STUDIO
from facerender.scene.file import KEYS
from facerender.scene.job import MESH_PATHS, job_value, parse_size
from facerender.scene.scene import ONLY, Scene
from facerender.scene.shading import Shading
from facerender.values.ranges import EXPOSURES

OUTPUTS: tuple[str, ...] = ("image", *ONLY, "layers")
TABLES = ("mesh", *(key for key in KEYS if key != "cameras"), "landmarks")
OWN = ("id", "outputs", "exposure", "scene", "meta")  # Keys of a row that are not in TABLES.
# Keys of a table whose values are paths of files, keyed by the table.
FILES = {
    "mesh": MESH_PATHS,
    "environment": ("file",),
    "pose": ("vertices",),
    "before": ("vertices",),
}

_ID = re.compile("[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
_SPEC = re.compile(r"[+-]?0?[0-9]{0,2}(\.[0-9]{1,2})?[defgs]?")


@dataclass(frozen=True, slots=True)
class Row:
    """A job of a batch."""

    number: int  # Index of the row in the table, from 0.
    id: str  # Name of the job's files: at most 128 letters, digits, ".", "_", "-"; no "." first.
    # Nested plain data for :meth:`facerender.Job.from_dict`, with absolute paths. With an
    # environment map, lights and ambient light default to none. Rows share parts of their tables:
    # do not modify these tables.
    tables: Table
    outputs: tuple[str, ...] = ("image",)  # Names from OUTPUTS.
    exposure: float = 0.0  # Exposure of the 8-bit images, in stops.
    meta: Table = field(default_factory=dict)  # Values that the job's record repeats.


class JobTable:
    """A table of jobs; each row is checked when it is read.

    An iteration reads and checks all rows, but yields only the rows before the first invalid row.

    Parameters
    ----------
    path : path of the table, a .jsonl, .csv, .parquet, .toml or .py file
    common : default values of all rows, with the same keys as a row
    most : maximum number of different errors to describe

    Attributes
    ----------
    rows : number of rows, including invalid ones
    meshes : number of different mesh files in the valid rows; the built-in head counts as one
    faults : one message for each of the first `most` different errors, with its rows
    more : number of invalid rows that `faults` does not describe
    """

    def __init__(
        self, path: str | os.PathLike[str], common: Mapping[str, Any] = {}, most: int = 10
    ) -> None:
        self._path, self._common, self._most = path, common, most
        self.rows = self.meshes = self.more = self._bad = 0
        self.faults: list[str] = []

    def __iter__(self) -> Iterator[Row]:
        """Yield the rows before the first invalid row; errors as in :meth:`valid`."""
        for _, row in self.valid():
            if not self._bad:
                yield row

    def valid(self) -> Iterator[tuple[str, Row]]:
        """Yield all valid rows, each with its position in the table as a text for messages.

        Raises
        ------
        InputError : the file cannot be read or has no rows
        """
        meshes, ids = set[int](), array("q")  # Hashes of the ids: 8 bytes per row.
        errors: dict[str, tuple[str, array[int]]] = {}  # First position, and numbers of the rows.
        for position, row in _rows(self._path, self._common):
            self.rows += 1
            try:
                if isinstance(row, InputError):
                    raise row
                _check(row)
            except InputError as error:
                self._bad += 1
                text = clipped(str(error), 400)
                if text in errors or len(errors) < self._most:
                    errors.setdefault(text, (position, array("L")))[1].append(self.rows)
                continue
            ids.append(hash(row.id))
            meshes.add(hash(row.tables.get("mesh", {}).get("path")))
            yield position, row
        self.meshes = len(meshes)
        self.faults = [f"{self._place(*rows)}: {text}" for text, rows in errors.items()]
        described = sum(len(numbers) for _, numbers in errors.values())
        ordered = np.sort(np.asarray(ids))
        twice = ordered[1:][ordered[1:] == ordered[:-1]]
        if len(twice) and len(self.faults) < self._most:
            faults = self._duplicates({*twice[:10_000].tolist()})
            self.faults, described = self.faults + faults, described + len(faults)
        self.more = self._bad + len(twice) - described

    def _place(self, first: str, numbers: array[int]) -> str:
        """Describe the position of the rows with one error, of which the first is at `first`."""
        count, last = len(numbers), numbers[-1]
        if count == 1:
            return first
        rows = "rows" if count == last - numbers[0] + 1 else f"{count} rows from"
        return f"{PurePath(self._path).name}, {rows} {numbers[0]} to {last}"

    def _duplicates(self, hashes: set[int]) -> list[str]:
        """Describe the rows that repeat the id of an earlier row.

        This reads the table a second time, because only hashes of the ids are in memory.
        """
        row_numbers: dict[str, int] = {}
        faults: list[str] = []
        for position, row in _rows(self._path, self._common):
            if isinstance(row, Row) and hash(row.id) in hashes:
                first = row_numbers.setdefault(row.id, row.number)
                if first != row.number:
                    faults.append(
                        f"{position}: id = {row.id!r} is used by row {first + 1}: give another"
                    )
                if len(self.faults) + len(faults) == self._most:
                    break
        return faults


def _rows(
    path: str | os.PathLike[str], common: Mapping[str, Any]
) -> Iterator[tuple[str, Row | InputError]]:
    """Yield pairs: a row's position, as a text for messages, and the row or its error."""
    _scene_tables.cache_clear()  # the files may have changed
    name = PurePath(path).name
    defaults, folder = nested(common), os.getcwd()
    base = _over_scene(defaults, defaults.pop("scene", None))
    number = -1
    for number, (line, row_values) in enumerate(found_rows(path)):
        position = f"{name}, row {number + 1}" + (f" (line {line})" if line else "")
        row: Row | InputError
        try:
            if isinstance(row_values, InputError):
                raise row_values
            scene = row_values.pop("scene", None)
            tables = base if scene is None else _over_scene(defaults, scene)
            row = _row(number, merged(tables, row_values), folder)
        except InputError as error:
            row = error
        yield position, row
    if number < 0:
        raise InputError(f"{name} has no rows: give at least one")


def _over_scene(tables: Table, scene: Any) -> Table:
    """Return the tables of the scene file `scene`, if given, updated with `tables`."""
    if scene is None:
        return tables
    check_path("scene", scene)
    return merged(_scene_tables(os.fspath(scene)), tables)


def _row(number: int, values: Table, folder: str) -> Row:
    values = with_default_lights(values)
    meta = values.pop("meta", {})
    if type(meta) is not dict:
        raise InputError(f"meta = {shown(meta)}: give a table, or values such as meta.age")
    tables: Table = {key: listed(value, key) for key, value in values.items()}
    template = tables.pop("id", "{number:08d}")
    outputs, exposure = tables.pop("outputs", "image"), tables.pop("exposure", 0.0)
    for key in tables:
        check_known("key", key, (*OWN, *TABLES))
    if type(image := tables.get("image")) is dict and type(image.get("size")) in (str, int):
        tables["image"] = {**image, "size": [*parse_size(str(image["size"]), "image size")]}
    for key, names in FILES.items():
        if type(table := tables.get(key)) is dict:
            paths = {
                name: _absolute(table[name], f"{key} {name}", folder)
                for name in names
                if name in table and (key, table[name]) != ("environment", STUDIO)
            }
            tables[key] = table | paths
    if "landmarks" in tables:
        tables["landmarks"] = _absolute(tables["landmarks"], "landmarks", folder)
    if "environment" in tables:  # An environment replaces default lights, as in facerender render.
        tables = {"lights": [], "ambient": 0.0, **tables}
    EXPOSURES.check("exposure", exposure)
    name = _id(template, number, tables)
    return Row(number, name, tables, _outputs(outputs), float(exposure), meta)


@lru_cache(64)
def _scene_tables(path: str) -> Table:
    """Return the tables of a scene file; `facerender plan` writes such files."""
    return nested(read_toml(Path(path)))


def _absolute(path: Any, name: str, folder: str) -> Any:
    """Return a path as an absolute path: workers may have another working directory."""
    if not isinstance(path, str):
        return path  # `Job.from_dict` rejects it.
    with suppress(ValueError):
        if path and b"\0" not in os.fsencode(path):
            return path if "://" in path else os.path.normpath(os.path.join(folder, path))
    raise InputError(f"{name} = {shown(path)} is not a path: give another")


def _outputs(value: Any) -> tuple[str, ...]:
    names = [name.strip() for name in value.split(",")] if isinstance(value, str) else value
    if not isinstance(names, list) or not names:
        raise InputError(f"outputs = {shown(value)}: give a list of {', '.join(OUTPUTS)}")
    check_outputs(names)
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"output {name} is given twice: leave one out")
    return tuple(names)


def file_name(output: str) -> str:
    """Return the file name of an output."""
    return "layers.exr" if output == "layers" else f"{output}.png"


def check_outputs(names: Sequence[str]) -> None:
    """Raise InputError for an unknown output."""
    for name in names:
        check_known("output", name, OUTPUTS)


# --- ids -----------------------------------------------------------------------------------------


def _id(template: Any, number: int, tables: Table) -> str:
    text = template
    if isinstance(template, str) and not template.isalnum():
        text = "".join([_part(template, *part, number, tables) for part in _parts(template)])
    elif type(template) is int:
        text = str(template)
    if not isinstance(text, str) or not _ID.fullmatch(text):
        raise InputError(
            f"id = {shown(text)}: give 1 to 128 letters, digits, '.', '_' and '-', and no '.' first"
        )
    return text


@lru_cache(256)
def _parts(template: str) -> list[tuple[str, str, str]]:
    """Split an id template into triples: literal text, then name and format of the next field."""
    parts = []
    try:
        for literal, name, spec, conversion in string.Formatter().parse(template):
            if conversion is not None or name == "" or not _SPEC.fullmatch(spec or ""):
                raise ValueError("give {NAME} or {NAME:FORMAT}, such as {number:06d}")
            parts.append((literal, name or "", spec or ""))
    except ValueError as error:
        raise InputError(f"id = {shown(template)} is not a template: {error}") from None
    return parts


def _part(template: str, literal: str, name: str, spec: str, number: int, tables: Table) -> str:
    if not name:
        return literal
    value: Any = number
    if name == "mesh.stem":
        mesh = tables.get("mesh")
        path = mesh.get("path") if type(mesh) is dict else None
        value = PurePath(path).stem if isinstance(path, str) else "head"
    elif name != "number":
        value = tables
        for key in name.split("."):
            try:
                value = value[int(key) if isinstance(value, list) else key]
            except (LookupError, TypeError, ValueError):
                raise InputError(
                    f"id = {shown(template)} uses {name}, which the row does not define"
                ) from None
    if isinstance(value, bool):
        value = str(value).lower()
    try:
        if isinstance(value, dict | list):
            raise TypeError
        text = format(value, spec)
    except (TypeError, ValueError):
        raise InputError(
            f"id = {shown(template)}: {name} = {shown(value)} cannot be formatted as {spec!r}"
        ) from None
    return literal + re.sub("[^A-Za-z0-9._-]", "_", text.replace("+", ""))


# --- checks --------------------------------------------------------------------------------------


def _check(row: Row) -> None:
    """Check the tables of a row as :meth:`facerender.Job.from_dict` does."""
    try:
        for key, value in row.tables.items():
            job_value(key, value)
        if "landmarks" in row.tables:
            check_path("landmarks", row.tables["landmarks"])
        if "shading" in row.tables:
            lights = row.tables.get("lights", Scene.lights)
            Shading.from_dict(row.tables["shading"]).check_lights(len(lights))
    except InputError:
        raise
    except (TypeError, ValueError, ArithmeticError) as error:  # A value of an unexpected type.
        raise InputError(f"{shown(row.tables)} cannot be used: {error}") from None
