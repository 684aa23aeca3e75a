"""Jobs of a batch: rows of a table, read one after the other and checked. How files hold them is
told in ``forms.py``. No OpenGL here."""

from __future__ import annotations

import os
import re
import string
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePath
from typing import Any

import numpy as np

from facerender.batch.forms import found_rows
from facerender.batch.tables import Table, listed, merged, nested, short, told
from facerender.errors import InputError, check_range
from facerender.job import MESH_PATHS, ImageSettings, MeshFile
from facerender.scenes.file import KEYS, STUDIO, from_table, scene_value
from facerender.scenes.material import MAX_NORMAL_STRENGTH, MAX_SECOND_SLOPE
from facerender.scenes.scene import ONLY, Scene
from facerender.scenes.vectors import HIGHEST
from facerender.shading import MAX_WEIGHT, Shading
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE
from facerender.terms.slope_variance import MAX_RADIUS

PASSES: tuple[str, ...] = ("image", *ONLY, "layers")
TABLES = ("mesh", *(key for key in KEYS if key not in ("cameras", "planned")), "image")
OWN = ("id", "passes", "exposure")  # what a row has beside the tables of a job
# Of numbers, by table: the ends of their domains, which belong to them.
LIMITS: dict[str, dict[str, tuple[float, float]]] = {
    "mesh": {"triangles": (1, 2**63), "millimetres": (1e-6, 1e6)},
    "camera": {
        "azimuth": (-3600, 3600),
        "elevation": (-90, 90),
        "fov": (1, 150),
        "zoom": (0.01, 1000),
    },
    "lights": {
        "azimuth": (-3600, 3600),
        "elevation": (-90, 90),
        "irradiance": (0, HIGHEST),
        "radius": (0, MAX_RADIUS),
    },
    "environment": {"rotation": (-3600, 3600), "scale": (0, 1e9)},
    "material": {
        "m": (MIN_SLOPE, MAX_SLOPE),
        "roughness_factor": (0, 1),
        "f0": (0, 0.999),
        "ks": (0, MAX_WEIGHT),
        "kd": (0, MAX_WEIGHT),
        "second_slope": (1 / MAX_SECOND_SLOPE, MAX_SECOND_SLOPE),
        "lobe_weight": (0, 1),
        "opacity": (0, 1),
        "alpha_cutoff": (0, HIGHEST),
        "normal_strength": (0, MAX_NORMAL_STRENGTH),
        "occlusion_strength": (0, 1),
    },
    "shading": {"m": (MIN_SLOPE, MAX_SLOPE), "ks": (0, MAX_WEIGHT)},
    "image": {"size": (1, 16384), "samples": (1, 64), "anisotropy": (1, 16)},
}
EXPOSURE_LIMITS = (-100.0, 100.0)
_WHOLE = {"triangles", "size", "samples"}
_TOGETHER = {"m", "second_slope", "lobe_weight"}  # numbers of a material that limit each other
ID = "[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}"

_ID = re.compile(ID)
_SPEC = re.compile(r"[+-]?0?[0-9]{0,2}(\.[0-9]{1,2})?[defgs]?")
_LONGEST_FAULT = 400  # characters
_MOST_GOOD = 4096  # tables that are known to be good
_MOST_TWICE = 10_000  # ids that are looked for again


@dataclass(frozen=True, slots=True)
class Row:
    """A job of a batch.

    Attributes
    ----------
    number : its place in the table, from 0
    id : what its files are named by: letters, digits, . _ -, not . first, at most 128
    tables : what was given, as :meth:`facerender.Job.from_dict` reads it: plain nested data, paths
        absolute; beside an environment no lights and no ambient light where none are given. Rows
        share parts of it: it is to be read alone
    passes : what is drawn, names of PASSES
    exposure : of 8-bit images, in stops
    plan : tables "shading" and "planned" that image.png is drawn with in place of its own
    """

    number: int
    id: str
    tables: Table
    passes: tuple[str, ...] = ("image",)
    exposure: float = 0.0
    plan: Table | None = None


@dataclass(frozen=True)
class Checked:
    """What a table of jobs holds.

    Attributes
    ----------
    rows : how many, the bad ones too
    meshes : how many different mesh files the good ones name, the built-in head being one
    faults : what is wrong with the first bad rows, a line each
    more : how many more are wrong
    """

    rows: int
    meshes: int
    faults: tuple[str, ...]
    more: int


def file_name(name: str) -> str:
    """Return what the file of a pass is named."""
    return "layers.exr" if name == "layers" else f"{name}.png"


def read_jobs(path: str | os.PathLike[str], common: Mapping[str, Any] = {}) -> Iterator[Row]:
    """Yield the rows of a table, one after the other.

    Parameters
    ----------
    path : .jsonl, .csv, .parquet, .toml or .py
    common : what rows have that do not say otherwise; keys as of a row

    Raises
    ------
    InputError : a file that cannot be read or has no rows, or a row whose keys, id, passes or
        exposure are none. Values are checked by :func:`check_jobs`, and by
        :meth:`facerender.Job.from_dict`
    """
    for _, row in _rows(path, common):
        if isinstance(row, InputError):
            raise row
        yield row


def check_jobs(
    path: str | os.PathLike[str], common: Mapping[str, Any] = {}, most: int = 10
) -> Checked:
    """Read a whole table and tell what is wrong with it.

    Parameters
    ----------
    path, common : as of :func:`read_jobs`
    most : of the bad rows, how many are told

    Raises
    ------
    InputError : a file that cannot be read, or has no rows
    """
    faults: list[str] = []
    count = bad = 0
    meshes: set[int] = set()
    ids = array("q")  # hashes: eight bytes a row
    good: set[int] = set()
    for place, row in _rows(path, common):
        count += 1
        try:
            if isinstance(row, InputError):
                raise row
            if len(good) > _MOST_GOOD:
                good.clear()
            _check(row, place, good)
        except InputError as error:
            bad += 1
            if len(faults) < most:
                faults.append(short(str(error), _LONGEST_FAULT))
            continue
        ids.append(hash(row.id))
        meshes.add(hash(row.tables.get("mesh", {}).get("path")))
    ordered = np.sort(np.asarray(ids))
    twice = ordered[1:][ordered[1:] == ordered[:-1]]
    bad += len(twice)
    if len(twice) and len(faults) < most:
        some = set(twice[:_MOST_TWICE].tolist())
        faults += _duplicates(path, common, some, most - len(faults))
    return Checked(count, len(meshes), tuple(faults), bad - len(faults))


def _rows(
    path: str | os.PathLike[str], common: Mapping[str, Any]
) -> Iterator[tuple[str, Row | InputError]]:
    """Yield rows, or what is wrong with them, each with its place as messages tell it."""
    name = PurePath(path).name
    base, folder = nested(common), os.getcwd()
    number = -1
    for number, (line, found) in enumerate(found_rows(path)):
        place = f"{name}, row {number + 1}" + (f" (line {line})" if line else "")
        row: Row | InputError
        try:
            if isinstance(found, InputError):
                raise found
            row = _row(number, merged(base, found), folder)
        except InputError as error:
            row = InputError(short(f"{place}: {error}", _LONGEST_FAULT))
        yield place, row
    if number < 0:
        raise InputError(f"{name} has no rows: give at least one")


def _row(number: int, given: Table, folder: str) -> Row:
    tables: Table = {key: listed(value, key) for key, value in given.items()}
    template, passes, exposure = (tables.pop(key, None) for key in OWN)
    for key in tables:
        if key not in TABLES:
            raise InputError(f"unknown key {told(key)}; known: {', '.join((*OWN, *TABLES))}")
    if type(image := tables.get("image")) is dict and type(image.get("size")) in (str, int):
        tables["image"] = {**image, "size": _size(image["size"])}
    if type(mesh := tables.get("mesh")) is dict:
        paths = {
            name: _absolute(mesh[name], f"mesh {name}", folder)
            for name in MESH_PATHS
            if name in mesh
        }
        tables["mesh"] = {**mesh, **paths}
    if "environment" in tables:  # it is in the place of other light, as in facerender render
        tables = {"lights": [], "ambient": 0.0, **tables}
    environment = tables.get("environment")
    if type(environment) is dict and environment.get("file", STUDIO) != STUDIO:
        file = _absolute(environment["file"], "environment file", folder)
        tables["environment"] = {**environment, "file": file}
    if exposure is not None:
        check_range("exposure", exposure, *EXPOSURE_LIMITS)
    return Row(
        number,
        f"{number:08d}" if template is None else _id(template, number, tables),
        tables,
        ("image",) if passes is None else _passes(passes),
        0.0 if exposure is None else float(exposure),
    )


def _size(given: str | int) -> list[int]:
    try:
        numbers = [int(word) for word in str(given).lower().split("x")]
        width, height = numbers * 2 if len(numbers) == 1 else numbers
    except ValueError:
        raise InputError(
            f"image size = {told(given)}: give N, WxH or [W, H], such as 512 or 640x480"
        ) from None
    return [width, height]


def _absolute(path: Any, name: str, folder: str) -> Any:
    """A path that a worker elsewhere understands; what is no text, from_dict refuses."""
    return _absolute_text(path, name, folder) if isinstance(path, str) else path


@lru_cache(4096)
def _absolute_text(path: str, name: str, folder: str) -> str:
    try:
        if not path or "\0" in os.fsencode(path).decode(errors="replace"):
            raise ValueError
    except ValueError:
        raise InputError(f"{name} = {told(path)} is no path: give another") from None
    return path if "://" in path else os.path.normpath(os.path.join(folder, path))


def _passes(given: Any) -> tuple[str, ...]:
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else given
    if not isinstance(names, list) or not names:
        raise InputError(f"passes = {told(given)}: give a list of {', '.join(PASSES)}")
    for name in names:
        if name not in PASSES:
            raise InputError(f"unknown pass {told(name)}; known: {', '.join(PASSES)}")
        if names.count(name) > 1:
            raise InputError(f"pass {name} is given twice: leave one out")
    return tuple(names)


# --- ids -----------------------------------------------------------------------------------------


def _id(given: Any, number: int, tables: Table) -> str:
    text = given
    if isinstance(given, str) and not given.isalnum():
        try:
            parts = _parts(given)
        except ValueError as error:
            raise InputError(f"id = {told(given)} is no template: {error}") from None
        text = "".join([_part(given, *part, number, tables) for part in parts])
    elif type(given) is int:
        text = str(given)
    if not isinstance(text, str) or not _ID.fullmatch(text):
        raise InputError(
            f"id = {told(text)}: give 1 to 128 letters, digits, '.', '_' and '-', and no '.' first"
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
                    f"id = {told(template)} names {name}, which the row does not give"
                ) from None
    if isinstance(value, bool):
        value = str(value).lower()
    try:
        if isinstance(value, dict | list):
            raise TypeError
        told_value = format(value, spec)
    except (TypeError, ValueError):
        raise InputError(
            f"id = {told(template)}: {name} = {told(value)} cannot be written as {spec!r}"
        ) from None
    return literal + re.sub("[^A-Za-z0-9._-]", "_", told_value.replace("+", ""))


# --- checks --------------------------------------------------------------------------------------


def _check(row: Row, place: str, good: set[int]) -> None:
    """Check what a row has that is not among the good, and note it there, by hashes.

    Raises
    ------
    InputError : a value outside its domain, a shading that names a light that the row has not
    """
    try:
        for key, value in row.tables.items():
            for each in value if key == "lights" and type(value) is list else [value]:
                if (name := hash(f"{key} {_without_good(key, each)!r}")) not in good:
                    _check_table(key, each if each is value else [each])
                    good.add(name)
        if "shading" in row.tables:
            count = len(row.tables.get("lights", Scene.lights))
            if (name := hash(f"{count} {row.tables['shading']!r}")) not in good:
                Shading.from_dict(row.tables["shading"]).check_lights(count)
                good.add(name)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    except (TypeError, ValueError, ArithmeticError) as error:  # of a kind that no check expects
        raise InputError(f"{place}: {told(row.tables)} cannot be used: {error}") from None


def _without_good(key: str, table: Any) -> Any:
    """Return a table without numbers that are good, of which most are seen but once."""
    if type(table) is not dict or key not in LIMITS or "extrinsics" in table:
        return table
    limits = LIMITS[key]
    kept = _TOGETHER if "second_slope" in table else _WHOLE
    return {
        name: value
        for name, value in table.items()
        if type(value) not in (float, int)
        or name not in limits
        or name in kept
        or not limits[name][0] <= value <= limits[name][1]
    }


def _check_table(key: str, value: Any) -> None:
    """Check a table as :meth:`facerender.Job.from_dict` does, without the rest of a job."""
    if key == "mesh":
        from_table(MeshFile, key, value)
    elif key == "image":
        image = from_table(ImageSettings, key, value)
        for name, (low, high) in LIMITS[key].items():
            given = getattr(image, name)
            for number in given if name == "size" else (given,):
                check_range(f"image {name}", number, low, high)
    else:
        scene_value(key, value)


def _duplicates(
    path: str | os.PathLike[str], common: Mapping[str, Any], hashes: set[int], most: int
) -> Iterator[str]:
    """Yield what is told of rows whose id another one has: the table is read again, so that ids
    need not be kept."""
    first: dict[str, int] = {}
    for place, row in _rows(path, common):
        if isinstance(row, Row) and hash(row.id) in hashes:
            if row.id in first:
                yield f"{place}: id = {row.id!r} is that of row {first[row.id] + 1}: give another"
                most -= 1
                if not most:
                    return
            first.setdefault(row.id, row.number)
