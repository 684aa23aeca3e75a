"""Jobs of a batch: reads the rows of a table one at a time and checks them.

``formats.py`` parses the files. This module does not use OpenGL.
"""

from __future__ import annotations

import os
import re
import string
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from facerender.batch.formats import found_rows, read_toml
from facerender.batch.tables import Table, listed, merged, nested, with_default_lights
from facerender.errors import InputError, check_known, check_path, clipped, shown
from facerender.job import MESH_PATHS, MeshFile, parse_size
from facerender.scenes.camera import Camera
from facerender.scenes.file import (
    KEYS,
    STUDIO,
    EnvironmentFile,
    ImageSettings,
    Pose,
    from_table,
    scene_value,
)
from facerender.scenes.light import Light
from facerender.scenes.lod import Planned
from facerender.scenes.material import Material
from facerender.scenes.scene import ONLY, Scene
from facerender.shading import Shading
from facerender.terms.ranges import EXPOSURES, ranges_of

OUTPUTS: tuple[str, ...] = ("image", *ONLY, "layers")
TABLES = ("mesh", *(key for key in KEYS if key != "cameras"), "landmarks")
OWN = ("id", "outputs", "exposure", "scene", "meta")  # Keys of a row that are not in TABLES.
TABLE_KINDS: dict[str, Any] = {
    "mesh": MeshFile,
    "camera": Camera,
    "lights": Light,
    "environment": EnvironmentFile,
    "material": Material,
    "pose": Pose,
    "before": Pose,
    "planned": Planned,
    "image": ImageSettings,
}
_TOGETHER = ("m", "second_slope", "lobe_weight")  # Values that limit each other's range.
ID = "[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}"

_ID = re.compile(ID)
_SPEC = re.compile(r"[+-]?0?[0-9]{0,2}(\.[0-9]{1,2})?[defgs]?")
_LONGEST_FAULT = 400  # Maximum number of characters in a message.
_MOST_GOOD = 4096  # Maximum number of cached hashes of valid tables.
_MOST_TWICE = 10_000  # Maximum number of duplicate ids that are described.


@dataclass(frozen=True, slots=True)
class Row:
    """A job of a batch.

    Parameters
    ----------
    number : index of the row in the table, from 0
    id : name of the job's files: 1 to 128 letters, digits, ".", "_" and "-"; no "." at the start
    tables : nested plain data for :meth:`facerender.Job.from_dict`, with absolute paths. With an
        environment map, lights and ambient light default to none. Rows share parts of their
        tables: do not modify these tables
    outputs : names from OUTPUTS
    exposure : exposure of the 8-bit images, in stops
    meta : values that the job's record repeats, such as the age of a person
    """

    number: int
    id: str
    tables: Table
    outputs: tuple[str, ...] = ("image",)
    exposure: float = 0.0
    meta: Table = field(default_factory=dict)


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
        meshes, good = set[int](), set[int]()
        errors: dict[str, _Fault] = {}
        ids = array("q")  # Hashes of the ids: 8 bytes per row.
        for position, row in _rows(self._path, self._common):
            self.rows += 1
            try:
                if isinstance(row, InputError):
                    raise row
                if len(good) > _MOST_GOOD:
                    good.clear()
                _check(row, good)
            except InputError as error:
                self._bad += 1
                if (text := clipped(str(error), _LONGEST_FAULT)) in errors:
                    errors[text].add(self.rows)
                elif len(errors) < self._most:
                    errors[text] = _Fault(position, self.rows, self.rows)
                continue
            ids.append(hash(row.id))
            meshes.add(hash(row.tables.get("mesh", {}).get("path")))
            yield position, row
        self.meshes = len(meshes)
        name = PurePath(self._path).name
        self.faults = [f"{fault.position(name)}: {text}" for text, fault in errors.items()]
        described = sum(fault.count for fault in errors.values())
        ordered = np.sort(np.asarray(ids))
        twice = ordered[1:][ordered[1:] == ordered[:-1]]
        if len(twice) and len(self.faults) < self._most:
            faults = self._duplicates({*twice[:_MOST_TWICE].tolist()})
            self.faults, described = self.faults + faults, described + len(faults)
        self.more = self._bad + len(twice) - described

    def check(self) -> JobTable:
        """Read and check all rows, and return the table."""
        for _ in self:
            pass
        return self

    def _duplicates(self, hashes: set[int]) -> list[str]:
        """Describe the rows that repeat the id of an earlier row.

        This reads the table a second time, because only hashes of the ids are in memory.
        """
        row_numbers: dict[str, int] = {}
        faults: list[str] = []
        for position, row in _rows(self._path, self._common):
            if isinstance(row, Row) and hash(row.id) in hashes:
                if row.id in row_numbers:
                    first_number = row_numbers[row.id] + 1
                    faults.append(
                        f"{position}: id = {row.id!r} is used by row {first_number}: give another"
                    )
                    if len(self.faults) + len(faults) == self._most:
                        break
                row_numbers.setdefault(row.id, row.number)
        return faults


@dataclass
class _Fault:
    """The rows with one error: the position of the first row, its and the last row's number from 1,
    and the count of rows."""

    first_position: str
    first: int
    last: int
    count: int = 1

    def add(self, number: int) -> None:
        self.last, self.count = number, self.count + 1

    def position(self, name: str) -> str:
        """Return the position of the rows as a text; ``name``: of the table's file."""
        if self.count == 1:
            return self.first_position
        contiguous = self.count == self.last - self.first + 1
        rows = "rows" if contiguous else f"{self.count} rows from"
        return f"{name}, {rows} {self.first} to {self.last}"


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
            if (scene := row_values.pop("scene", None)) is not None:
                row = _row(number, merged(_over_scene(defaults, scene), row_values), folder)
            else:
                row = _row(number, merged(base, row_values), folder)
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
    template, outputs, exposure = (tables.pop(key, None) for key in ("id", "outputs", "exposure"))
    for key in tables:
        check_known("key", key, (*OWN, *TABLES))
    if type(image := tables.get("image")) is dict and type(image.get("size")) in (str, int):
        tables["image"] = {**image, "size": [*parse_size(str(image["size"]), "image size")]}
    if type(mesh := tables.get("mesh")) is dict:
        paths = {
            name: _absolute(mesh[name], f"mesh {name}", folder)
            for name in MESH_PATHS
            if name in mesh
        }
        tables["mesh"] = {**mesh, **paths}
    for key in ("pose", "before"):
        if type(pose := tables.get(key)) is dict and "vertices" in pose:
            file = _absolute(pose["vertices"], f"{key} vertices", folder)
            tables[key] = {**pose, "vertices": file}
    if "landmarks" in tables:
        tables["landmarks"] = _absolute(tables["landmarks"], "landmarks", folder)
    if "environment" in tables:  # An environment replaces default lights, as in facerender render.
        tables = {"lights": [], "ambient": 0.0, **tables}
    environment = tables.get("environment")
    if type(environment) is dict and environment.get("file", STUDIO) != STUDIO:
        file = _absolute(environment["file"], "environment file", folder)
        tables["environment"] = {**environment, "file": file}
    if exposure is not None:
        EXPOSURES.check("exposure", exposure)
    return Row(
        number,
        f"{number:08d}" if template is None else _id(template, number, tables),
        tables,
        ("image",) if outputs is None else _outputs(outputs),
        0.0 if exposure is None else float(exposure),
        meta,
    )


@lru_cache(64)
def _scene_tables(path: str) -> Table:
    """Return the tables of a scene file; `facerender plan` writes such files."""
    return nested(read_toml(Path(path)))


def _absolute(path: Any, name: str, folder: str) -> Any:
    """Return a path as an absolute path: workers may have another working directory.

    A value that is not text is returned unchanged: `Job.from_dict` rejects it.
    """
    return _absolute_text(path, name, folder) if isinstance(path, str) else path


@lru_cache(4096)
def _absolute_text(path: str, name: str, folder: str) -> str:
    try:
        if not path or "\0" in os.fsencode(path).decode(errors="replace"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name} = {shown(path)} is not a path: give another") from None
    return path if "://" in path else os.path.normpath(os.path.join(folder, path))


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
        try:
            parts = _parts(template)
        except ValueError as error:
            raise InputError(f"id = {shown(template)} is not a template: {error}") from None
        text = "".join([_part(template, *part, number, tables) for part in parts])
    elif type(template) is int:
        text = str(template)
    if not isinstance(text, str) or not _ID.fullmatch(text):
        raise InputError(
            f"id = {shown(text)}: give 1 to 128 letters, digits, '.', '_' and '-', and no '.' first"
        )
    return text


@lru_cache(256)
def _parts(template: str) -> list[tuple[str, str, str]]:
    """Split an id template into triples: literal text, then name and format of the next field.

    Raises
    ------
    ValueError : a field is neither {NAME} nor {NAME:FORMAT}
    """
    parts = []
    for literal, name, spec, conversion in string.Formatter().parse(template):
        if conversion is not None or name == "" or not _SPEC.fullmatch(spec or ""):
            raise ValueError("give {NAME} or {NAME:FORMAT}, such as {number:06d}")
        parts.append((literal, name or "", spec or ""))
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


def _check(row: Row, good: set[int]) -> None:
    """Check the tables of a row as :meth:`facerender.Job.from_dict` does.

    Tables whose hashes are in `good` are skipped; the hashes of valid tables are added to `good`.

    Raises
    ------
    InputError : a value is outside its range, or the shading names a light that the row lacks
    """
    try:
        for key, value in row.tables.items():
            for entry in value if key == "lights" and type(value) is list else [value]:
                if (name := hash(f"{key} {_without_valid(key, entry)!r}")) not in good:
                    if key == "mesh":
                        from_table(MeshFile, key, entry)
                    elif key == "landmarks":
                        check_path(key, entry)
                    else:
                        scene_value(key, entry if entry is value else [entry])
                    good.add(name)
        if "shading" in row.tables:
            count = len(row.tables.get("lights", Scene.lights))
            if (name := hash(f"{count} {row.tables['shading']!r}")) not in good:
                Shading.from_dict(row.tables["shading"]).check_lights(count)
                good.add(name)
    except InputError:
        raise
    except (TypeError, ValueError, ArithmeticError) as error:  # A value of an unexpected type.
        raise InputError(f"{shown(row.tables)} cannot be used: {error}") from None


def _without_valid(key: str, table: Any) -> Any:
    """Return a table without its valid numbers. A number is valid within its field's range.

    Tables that differ only in valid numbers then have equal hashes and are checked once. For a row
    with a camera, a material and two lights, a check takes 31 us instead of 92 us.
    """
    if type(table) is not dict or key not in TABLE_KINDS or "extrinsics" in table:
        return table
    ranges = ranges_of(TABLE_KINDS[key])
    together = _TOGETHER if "second_slope" in table else ()
    return {
        name: value
        for name, value in table.items()
        if name not in ranges or name in together or value not in ranges[name]
    }
