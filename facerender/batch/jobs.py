"""Jobs of a batch: the rows of a table, read one after the other and checked. ``formats.py`` reads
the files. No OpenGL here."""

from __future__ import annotations

import os
import re
import string
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from facerender.batch.formats import found_rows, read_toml
from facerender.batch.tables import Table, listed, merged, nested
from facerender.errors import InputError, check_path, clipped, shown
from facerender.job import MESH_PATHS, ImageSettings, MeshFile, parse_size
from facerender.scenes.camera import Camera
from facerender.scenes.file import KEYS, STUDIO, EnvironmentFile, from_table, scene_value
from facerender.scenes.light import Light
from facerender.scenes.lod import Planned
from facerender.scenes.material import Material
from facerender.scenes.scene import ONLY, Scene
from facerender.shading import Shading
from facerender.terms.ranges import EXPOSURES, ranges_of

OUTPUTS: tuple[str, ...] = ("image", *ONLY, "layers")
TABLES = ("mesh", *(key for key in KEYS if key != "cameras"), "image")
OWN = ("id", "outputs", "exposure", "scene")  # keys of a row beside the tables of a job
TABLE_KINDS: dict[str, Any] = {
    "mesh": MeshFile,
    "camera": Camera,
    "lights": Light,
    "environment": EnvironmentFile,
    "material": Material,
    "planned": Planned,
    "image": ImageSettings,
}
_TOGETHER = ("m", "second_slope", "lobe_weight")  # numbers of a material that limit each other
ID = "[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}"

_ID = re.compile(ID)
_SPEC = re.compile(r"[+-]?0?[0-9]{0,2}(\.[0-9]{1,2})?[defgs]?")
_LONGEST_FAULT = 400  # characters
_MOST_GOOD = 4096  # digests of tables that passed the checks
_MOST_TWICE = 10_000  # duplicate ids whose rows are described


@dataclass(frozen=True, slots=True)
class Row:
    """A job of a batch.

    Parameters
    ----------
    number : its place in the table, from 0
    id : names the job's files: letters, digits, . _ -, not . first, at most 128
    tables : as :meth:`facerender.Job.from_dict` reads them: plain nested data, absolute paths;
        beside an environment no lights and no ambient light where none are given. Rows share parts
        of it: do not change it
    outputs : names of OUTPUTS
    exposure : of 8-bit images, in stops
    """

    number: int
    id: str
    tables: Table
    outputs: tuple[str, ...] = ("image",)
    exposure: float = 0.0


class JobTable:
    """The rows of a table of jobs, checked as they are read. An iteration yields the good rows
    before the first bad one, and reads all of them.

    Parameters
    ----------
    path : .jsonl, .csv, .parquet, .toml or .py
    common : values of rows that do not have their own; keys as of a row
    most : number of bad rows that are described

    Attributes
    ----------
    rows : number of rows, with the bad ones
    meshes : number of different mesh files of the good rows, the built-in head being one
    faults : a line for each of the first bad rows
    more : number of bad rows beyond these
    """

    def __init__(
        self, path: str | os.PathLike[str], common: Mapping[str, Any] = {}, most: int = 10
    ) -> None:
        self._path, self._common, self._most = path, common, most
        self.rows = self.meshes = self.more = 0
        self.faults: list[str] = []

    def __iter__(self) -> Iterator[Row]:
        """Yield the good rows; InputError for a file that cannot be read, or that has no rows."""
        meshes, good = set[int](), set[int]()
        ids = array("q")  # hashes: eight bytes a row
        bad = 0
        for position, row in _rows(self._path, self._common):
            self.rows += 1
            try:
                if isinstance(row, InputError):
                    raise row
                if len(good) > _MOST_GOOD:
                    good.clear()
                _check(row, position, good)
            except InputError as error:
                bad += 1
                if bad <= self._most:
                    self.faults.append(clipped(str(error), _LONGEST_FAULT))
                continue
            ids.append(hash(row.id))
            meshes.add(hash(row.tables.get("mesh", {}).get("path")))
            if not bad:
                yield row
        self.meshes = len(meshes)
        ordered = np.sort(np.asarray(ids))
        twice = ordered[1:][ordered[1:] == ordered[:-1]]
        if len(twice) and len(self.faults) < self._most:
            self.faults += self._duplicates({*twice[:_MOST_TWICE].tolist()})
        self.more = bad + len(twice) - len(self.faults)

    def check(self) -> JobTable:
        """Read all rows, and return the table."""
        for _ in self:
            pass
        return self

    def _duplicates(self, hashes: set[int]) -> list[str]:
        """Describe rows whose id another row has. The table is read a second time for this, so that
        the ids of good tables need not be kept."""
        first: dict[str, int] = {}
        faults: list[str] = []
        for position, row in _rows(self._path, self._common):
            if isinstance(row, Row) and hash(row.id) in hashes:
                if row.id in first:
                    other = first[row.id] + 1
                    faults.append(
                        f"{position}: id = {row.id!r} is that of row {other}: give another"
                    )
                    if len(self.faults) + len(faults) == self._most:
                        break
                first.setdefault(row.id, row.number)
        return faults


def _rows(
    path: str | os.PathLike[str], common: Mapping[str, Any]
) -> Iterator[tuple[str, Row | InputError]]:
    """Yield rows, or the errors of bad ones, each with its position for messages."""
    name = PurePath(path).name
    own, folder = nested(common), os.getcwd()
    base = _over_scene(own, own.pop("scene", None), folder)
    number = -1
    for number, (line, found) in enumerate(found_rows(path)):
        position = f"{name}, row {number + 1}" + (f" (line {line})" if line else "")
        row: Row | InputError
        try:
            if isinstance(found, InputError):
                raise found
            if (scene := found.pop("scene", None)) is not None:
                row = _row(number, merged(_over_scene(own, scene, folder), found), folder)
            else:
                row = _row(number, merged(base, found), folder)
        except InputError as error:
            row = InputError(clipped(f"{position}: {error}", _LONGEST_FAULT))
        yield position, row
    if number < 0:
        raise InputError(f"{name} has no rows: give at least one")


def _over_scene(tables: Table, scene: Any, folder: str) -> Table:
    """Return tables over those of a scene file, if one is named."""
    if scene is None:
        return tables
    check_path("scene", scene)
    return merged(_scene_tables(os.fspath(scene), folder), tables)


def _row(number: int, values: Table, folder: str) -> Row:
    tables: Table = {key: listed(value, key) for key, value in values.items()}
    template, outputs, exposure = (tables.pop(key, None) for key in ("id", "outputs", "exposure"))
    for key in tables:
        if key not in TABLES:
            raise InputError(f"unknown key {shown(key)}; known: {', '.join((*OWN, *TABLES))}")
    if type(image := tables.get("image")) is dict and type(image.get("size")) in (str, int):
        tables["image"] = {**image, "size": [*parse_size(str(image["size"]), "image size")]}
    if type(mesh := tables.get("mesh")) is dict:
        paths = {
            name: _absolute(mesh[name], f"mesh {name}", folder)
            for name in MESH_PATHS
            if name in mesh
        }
        tables["mesh"] = {**mesh, **paths}
    if "environment" in tables:  # instead of other light, as in facerender render
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
    )


@lru_cache(64)
def _scene_tables(path: str, folder: str) -> Table:
    """Return the tables of a scene file, such as `facerender plan` writes; `folder` is the current
    one."""
    return nested(read_toml(Path(path)))


def _absolute(path: Any, name: str, folder: str) -> Any:
    """Return a path that a worker elsewhere understands; from_dict refuses what is not text."""
    return _absolute_text(path, name, folder) if isinstance(path, str) else path


@lru_cache(4096)
def _absolute_text(path: str, name: str, folder: str) -> str:
    try:
        if not path or "\0" in os.fsencode(path).decode(errors="replace"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name} = {shown(path)} is no path: give another") from None
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
    """Return the name of the file of an output."""
    return "layers.exr" if output == "layers" else f"{output}.png"


def check_outputs(names: Sequence[str]) -> None:
    """Raise InputError for an unknown output."""
    for name in names:
        if name not in OUTPUTS:
            raise InputError(f"unknown output {shown(name)}; known: {', '.join(OUTPUTS)}")


# --- ids -----------------------------------------------------------------------------------------


def _id(template: Any, number: int, tables: Table) -> str:
    text = template
    if isinstance(template, str) and not template.isalnum():
        try:
            parts = _parts(template)
        except ValueError as error:
            raise InputError(f"id = {shown(template)} is no template: {error}") from None
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
    """Return literal text, the name behind it, and its format.

    Raises
    ------
    ValueError : something else than {NAME} or {NAME:FORMAT}
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
                    f"id = {shown(template)} names {name}, which the row does not give"
                ) from None
    if isinstance(value, bool):
        value = str(value).lower()
    try:
        if isinstance(value, dict | list):
            raise TypeError
        text = format(value, spec)
    except (TypeError, ValueError):
        raise InputError(
            f"id = {shown(template)}: {name} = {shown(value)} cannot be written as {spec!r}"
        ) from None
    return literal + re.sub("[^A-Za-z0-9._-]", "_", text.replace("+", ""))


# --- checks --------------------------------------------------------------------------------------


def _check(row: Row, position: str, good: set[int]) -> None:
    """Check the tables of a row as :meth:`facerender.Job.from_dict` does, except those whose hashes
    are in `good`, and add theirs.

    Raises
    ------
    InputError : a value outside its range, a shading that names a light that the row does not have
    """
    try:
        for key, value in row.tables.items():
            for each in value if key == "lights" and type(value) is list else [value]:
                if (name := hash(f"{key} {_without_valid(key, each)!r}")) not in good:
                    if key in ("mesh", "image"):
                        from_table(TABLE_KINDS[key], key, each)
                    else:
                        scene_value(key, each if each is value else [each])
                    good.add(name)
        if "shading" in row.tables:
            count = len(row.tables.get("lights", Scene.lights))
            if (name := hash(f"{count} {row.tables['shading']!r}")) not in good:
                Shading.from_dict(row.tables["shading"]).check_lights(count)
                good.add(name)
    except InputError as error:
        raise InputError(f"{position}: {error}") from None
    except (TypeError, ValueError, ArithmeticError) as error:  # of a type that no check expects
        raise InputError(f"{position}: {shown(row.tables)} cannot be used: {error}") from None


def _without_valid(key: str, table: Any) -> Any:
    """Return a table without the numbers that are in their range, most of which differ from row to
    row: 31 us instead of 92 for a row with a camera, a material and two lights."""
    if type(table) is not dict or key not in TABLE_KINDS or "extrinsics" in table:
        return table
    ranges = ranges_of(TABLE_KINDS[key])
    together = _TOGETHER if "second_slope" in table else ()
    return {
        name: value
        for name, value in table.items()
        if name not in ranges or name in together or value not in ranges[name]
    }
