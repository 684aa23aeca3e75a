"""Jobs of a batch: makes jobs from the rows of a table, checks them, and divides them into chunks,
which are drawn, written and committed together. This module does not use OpenGL."""

from __future__ import annotations

import hashlib
import json
import os
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import chain, islice
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

import numpy as np

from facerender import __version__
from facerender.batch import tables as formats
from facerender.errors import InputError, check_known, clipped, quoted, warn
from facerender.images.image import TONES, Tone
from facerender.loading import MESH_PATHS
from facerender.loading.source import named_files, source_of
from facerender.mesh.face import RELIEFS
from facerender.scene.background import is_image
from facerender.scene.environment import STUDIO
from facerender.scene.job import ImageSettings, Job
from facerender.scene.scene import ONLY
from facerender.system.files import data_dir, digest_of
from facerender.values.fields import EXPOSURES, PATH, Table, build, limits_of, listed, merged

if TYPE_CHECKING:
    from facerender.drawing.context import Backend

OUTPUTS: tuple[str, ...] = ("image", *ONLY, "layers")
# Keys of a row: the keys of a job, and further keys.
TABLES = tuple(key for key in limits_of(Job) if key not in ("cameras", "outputs"))
ROW_KEYS = ("id", "outputs", "exposure", "tone", "scene", "meta")
# Keys of a table whose values are paths of files, keyed by the table.
FILES = {"mesh": MESH_PATHS, "environment": ("file",)}
FILES |= {"pose": ("vertices",), "before": ("vertices",)}

_NUMBERED = "{number:08d}"  # template of an id
_NAMELESS = {"number", "anonymous"}  # fields of the templates of anonymous jobs
_ID = re.compile("[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
_FIELD = re.compile(r"\{([^{}:!]+):?([+-]?0?[0-9]{0,2}(?:\.[0-9]{1,2})?[defgs]?)\}")


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
    tone: Tone = "linear"  # Tone mapping of the 8-bit images.
    meta: Table = field(default_factory=dict)  # Values that the job's record repeats.

    @property
    def anonymous(self) -> bool:
        """Whether the job's files must not contain names."""
        return "anonymous" in self.tables

    @property
    def inputs(self) -> Table:
        """The items of the job's record that come from its table, with names of files instead of
        paths; none of an anonymous job."""
        if self.anonymous:
            return {}
        tables = with_paths(self.tables, lambda _, path: path and PurePath(path).name)
        return {"job": tables, **({"meta": self.meta} if self.meta else {})}


class JobTable:
    """A table of jobs; each row is checked when it is read.

    path : path of the table, a .jsonl, .csv, .parquet, .toml or .py file
    common : default values of all rows, with the same keys as a row
    most : maximum number of different errors to describe
    """

    def __init__(
        self, path: str | os.PathLike[str], common: Mapping[str, Any] = {}, most: int = 10
    ) -> None:
        self._path, self._common, self._most, self._bad = path, common, most, 0
        self.rows = 0  # Number of rows, including invalid ones.
        self.meshes = 0  # Number of mesh files in the valid rows; the built-in head counts as one.
        self.faults: list[str] = []  # One message for each of the first errors, with its rows.
        self.more = 0  # Number of invalid rows that `faults` does not describe.

    def __iter__(self) -> Iterator[Row]:
        """Read all rows, but yield only the rows before the first invalid row."""
        for _, row, _ in self.valid():
            if not self._bad:
                yield row

    def valid(self) -> Iterator[tuple[str, Row, Job]]:
        """Yield all valid rows, each with its position in the table as a text for messages, and its
        job. Raise InputError if the file cannot be read or has no rows."""
        meshes, ids = set[int](), array("q")  # Hashes of the ids: 8 bytes per row.
        errors: dict[str, tuple[str, array[int]]] = {}  # First position, and numbers of the rows.
        for position, result in self._read():
            self.rows += 1
            if isinstance(result, tuple):
                row, job = result
                ids.append(hash(row.id))
                meshes.add(hash(row.tables.get("mesh", {}).get("path")))
                yield position, row, job
                continue
            self._bad += 1
            text = clipped(str(result), 400)
            if text in errors or len(errors) < self._most:
                errors.setdefault(text, (position, array("L")))[1].append(self.rows)
        self.meshes = len(meshes)
        self.faults = [f"{self._position(*rows)}: {text}" for text, rows in errors.items()]
        described = sum(len(numbers) for _, numbers in errors.values())
        ordered = np.sort(np.asarray(ids))
        twice = ordered[1:][ordered[1:] == ordered[:-1]]
        if len(twice) and len(self.faults) < self._most:
            faults = self._duplicates({*twice[:10_000].tolist()})
            self.faults, described = self.faults + faults, described + len(faults)
        self.more = self._bad + len(twice) - described

    def _read(self) -> Iterator[tuple[str, tuple[Row, Job] | InputError]]:
        """Yield pairs: a row's position, as a text for messages, and the row and its job, or their
        error."""
        _scene_tables.cache_clear()  # the files may have changed
        name = PurePath(self._path).name
        defaults, folder = formats.nested(self._common), os.getcwd()
        base = _over_scene(defaults, defaults.pop("scene", None))
        number = -1
        for number, (line, parse) in enumerate(formats.read_rows(self._path)):
            position = f"{name}, row {number + 1}" + (f" (line {line})" if line else "")
            try:
                values = parse()
                scene = values.pop("scene", None)
                tables = base if scene is None else _over_scene(defaults, scene)
                result: Any = _row(number, merged(tables, values), folder)
            except InputError as error:
                result = error
            yield position, result
        if number < 0:
            raise InputError(f"{name} has no rows: give at least one")

    def _position(self, first: str, numbers: array[int]) -> str:
        """Describe the position of the rows with one error, of which the first is at `first`."""
        count, last = len(numbers), numbers[-1]
        if count == 1:
            return first
        rows = "rows" if count == last - numbers[0] + 1 else f"{count} rows from"
        return f"{PurePath(self._path).name}, {rows} {numbers[0]} to {last}"

    def _duplicates(self, hashes: set[int]) -> list[str]:
        """Describe the rows that repeat the id of an earlier row."""
        # This reads the table a second time, because only hashes of the ids are in memory.
        row_numbers: dict[str, int] = {}
        faults: list[str] = []
        for position, result in self._read():
            if isinstance(result, tuple) and hash(result[0].id) in hashes:
                row = result[0]
                first = row_numbers.setdefault(row.id, row.number) + 1
                if first <= row.number:
                    problem = f"id = {row.id!r} is used by row {first}"
                    faults.append(f"{position}: {problem}: give another")
                if len(self.faults) + len(faults) == self._most:
                    break
        return faults


def _over_scene(tables: Table, scene: Any) -> Table:
    """Return the tables of the scene file `scene`, if given, updated with `tables`."""
    return tables if scene is None else merged(_scene_tables(PATH.check("scene", scene)), tables)


@lru_cache(64)
def _scene_tables(path: str) -> Table:
    """Return the tables of a scene file; `facerender plan` writes such files."""
    tables = formats.nested(formats.read_toml(Path(path)))
    if tables.pop("outputs", None):  # a batch has a list of outputs for all jobs
        warn(f"the outputs of {path} are not used: name the outputs with --outputs")
    return tables


def _row(number: int, values: Table, folder: str) -> tuple[Row, Job]:
    """Return row and job of the merged tables of scene file, defaults and row. Paths are relative
    to `folder`, and become absolute, because workers may have another working directory."""
    values = formats.with_default_lights(values)
    meta = values.pop("meta", {})
    if type(meta) is not dict:
        raise InputError(f"meta = {quoted(meta)}: give a table, or values such as meta.age")
    tables: Table = {key: listed(value, key, formats.NAMED) for key, value in values.items()}
    template = tables.pop("id", _NUMBERED)
    if "anonymous" in tables and {field[1] for field in _FIELD.finditer(str(template))} - _NAMELESS:
        template = _NUMBERED
    outputs, exposure = tables.pop("outputs", "image"), tables.pop("exposure", 0.0)
    check_known("tone", tone := tables.pop("tone", "linear"), TONES)
    for key in tables:
        check_known("key", key, (*ROW_KEYS, *TABLES))
    if type(image := tables.get("image")) is dict and type(image.get("size")) in (str, int):
        size = build(ImageSettings, {"size": str(image["size"])}, "image").size
        tables["image"] = {**image, "size": [*size]}
    tables = with_paths(tables, lambda name, path: _absolute(path, name, folder))
    if "environment" in tables:  # An environment replaces default lights, as in facerender render.
        tables = {"lights": [], "ambient": 0.0, **tables}
    exposure = EXPOSURES.check("exposure", exposure)
    row_id = _id(template, number, tables)
    row = Row(number, row_id, tables, _outputs(outputs), exposure, tone, meta)
    job = Job.from_dict(tables)
    job.shading.check_lights(len(job.lights))
    return row, job


def with_paths(tables: Table, replace: Callable[[str, Any], Any]) -> Table:
    """Return the tables of a job with `replace(name, path)` instead of each path of a file."""
    tables = dict(tables)
    for key, names in FILES.items():
        if type(table := tables.get(key)) is dict:
            paths = {name: replace(f"{key} {name}", table[name]) for name in names if name in table}
            tables[key] = table | paths
    for key in ("landmarks", "background"):
        if key in tables and (key == "landmarks" or is_image(tables[key])):
            tables[key] = replace(key, tables[key])
    return tables


def _absolute(path: Any, name: str, folder: str) -> Any:
    if not isinstance(path, str) or (name, path) == ("environment file", STUDIO):
        return path  # If it is not a text, the constructor of the job rejects it.
    with suppress(ValueError):
        if path and b"\0" not in os.fsencode(path):
            return path if "://" in path else os.path.normpath(os.path.join(folder, path))
    raise InputError(f"{name} = {quoted(path)} is not a path: give another")


def _outputs(value: Any) -> tuple[str, ...]:
    names = [name.strip() for name in value.split(",")] if isinstance(value, str) else value
    if not isinstance(names, list) or not names:
        raise InputError(f"outputs = {quoted(value)}: give a list of {', '.join(OUTPUTS)}")
    for name in names:
        check_known("output", name, OUTPUTS)
    if (twice := formats.repeated(names)) is not None:
        raise InputError(f"output {twice} is given twice: leave one out")
    return tuple(names)


def file_name(output: str) -> str:
    """Return the file name of an output."""
    return "layers.exr" if output == "layers" else f"{output}.png"


def _id(template: Any, number: int, tables: Table) -> str:
    text = str(template) if type(template) is int else template
    if isinstance(text, str) and not text.isalnum():
        if not {"{", "}"}.isdisjoint(_FIELD.sub("", text)):
            remedy = "give {NAME} or {NAME:FORMAT}, such as {number:06d}"
            raise InputError(f"id = {quoted(template)} is not a template: {remedy}")
        text = _FIELD.sub(lambda field: _formatted(field, number, tables), text)
    if not isinstance(text, str) or not _ID.fullmatch(text):
        remedy = "give 1 to 128 letters, digits, '.', '_' and '-', and no '.' first"
        raise InputError(f"id = {quoted(text)}: {remedy}")
    return text


def _formatted(field: re.Match[str], number: int, tables: Table) -> str:
    """Return the text of a field {NAME:FORMAT} of a template."""
    template, (name, spec) = field.string, field.groups()
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
                problem = f"uses {name}, which the row does not define"
                raise InputError(f"id = {quoted(template)} {problem}") from None
    if isinstance(value, bool):
        value = str(value).lower()
    try:
        if isinstance(value, dict | list):
            raise TypeError
        text = format(value, spec)
    except (TypeError, ValueError):
        problem = f"{name} = {quoted(value)} cannot be formatted as {spec!r}"
        raise InputError(f"id = {quoted(template)}: {problem}") from None
    return re.sub("[^A-Za-z0-9._-]", "_", text.replace("+", ""))


Layout = Literal["files", "shards"]
Record = dict[str, Any]  # the record of a drawn or failed job

_PACKAGE = Path(__file__).parents[1]
_LARGEST = 128  # maximum number of jobs per chunk
# Minimum number of chunks, if there are enough jobs. Jobs wait in memory for more jobs with the
# same mesh; the waiting jobs would fill at most this number of chunks.
_CHUNKS = 64


@dataclass(frozen=True)
class Settings:
    """Settings that all jobs of a batch share."""

    output: str  # A folder, or a URL.
    layout: Layout = "files"  # "files": a folder per job; "shards": a tar per chunk.
    backend: Backend = "auto"
    timeout: float = 300.0  # Seconds without a message after which a worker counts as hung.
    tries: int = 3  # Maximum number of attempts for a job that crashes or hangs its worker.
    code_version: str = ""  # Digest of the code that draws, see :func:`code_version`.
    # ID of the command. A worker that outlives its killed command stops writing if batch.json
    # contains the ID of another command.
    run: str = field(default_factory=lambda: uuid4().hex)


@dataclass(frozen=True)
class Chunk:
    """A group of jobs."""

    number: int  # Index among the chunks of the batch.
    rows: tuple[Row, ...]
    keys: tuple[str, ...]  # For each job, a digest of everything that its files depend on.
    # Records of jobs that an earlier run has drawn, keyed by the job's index in the chunk.
    kept: Mapping[int, Record] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name, without suffix, of the chunk's record and of its tar."""
        return f"{self.number:06d}-{digest_of(*self.keys)[:16]}"

    def identity(self, position: int) -> Record:
        """Return the items of a job's record that identify the job."""
        row = self.rows[position]
        return {"id": row.id, "number": row.number, "key": self.keys[position]}


def chunks(
    rows: Iterable[Row], size: int | None = None, layout: Layout = "files"
) -> Iterator[Chunk]:
    """Divide rows into chunks of at most `size` jobs, or of 1 to 128, depending on the number of
    rows. Rows with equal mesh and image tables share a chunk where possible. Raise InputError for
    an id with a dot in layout "shards"."""
    rows = iter(rows)
    if size is None:
        # A table may have more rows than fit into memory: read only as many as determine the size.
        first_rows = [*islice(rows, _CHUNKS * _LARGEST)]
        # The size does not depend on the workers: any number of workers gives the same chunks.
        size = 32 if layout == "shards" else 1  # Readers shuffle whole tars.
        while size < _LARGEST and len(first_rows) >= 2 * _CHUNKS * size:
            size *= 2
        rows = chain(first_rows, rows)
        del first_rows
    for number, group in enumerate(_groups(rows, size, layout)):
        yield Chunk(number, tuple(group), tuple(map(key_of, group)))


def _groups(rows: Iterable[Row], size: int, layout: Layout) -> Iterator[list[Row]]:
    waiting: dict[str, list[Row]] = {}  # keyed by mesh and image, in the order of the first rows
    waiting_count = 0

    def packed() -> list[Row]:
        """Return the rows of the longest-waiting groups: as many groups as fit into a chunk."""
        rows_of_groups: list[Row] = []
        for name in list(waiting):
            if rows_of_groups and len(rows_of_groups) + len(waiting[name]) > size:
                break
            rows_of_groups += waiting.pop(name)
        return rows_of_groups

    for row in rows:
        if layout == "shards" and "." in row.id:
            problem = f"id {row.id!r} contains a dot, at which readers of shards split the name"
            raise InputError(f"{problem}: give an id without a dot, or use --layout files")
        name = json.dumps([row.tables.get("mesh"), row.tables.get("image")])
        group = waiting.setdefault(name, [])
        group.append(row)
        waiting_count += 1
        if len(group) == size or waiting_count >= _CHUNKS * size:
            group = waiting.pop(name) if len(group) == size else packed()
            waiting_count -= len(group)
            yield group
    while waiting:
        yield packed()


@cache
def code_version() -> str:
    """Return a digest of the package version and of all sources that the pixels depend on."""
    # Whole packages: drawing a job once too often is cheaper than mixing images of two versions.
    lower = "values", "terms", "images", "texture", "mesh", "loading", "scene"
    folders = *lower, "glsl", "drawing"
    paths = [path for name in folders for path in sorted((_PACKAGE / name).rglob("*.py"))]
    paths += (_PACKAGE / name for name in ("batch/outputs.py", "material.py"))
    paths.append(RELIEFS)  # the frame of a camera depends on them
    paths += sorted(path for path in data_dir("shaders").rglob("*") if path.is_file())
    return digest_of(__version__, *(path.read_bytes() for path in paths))


def key_of(row: Row) -> str:
    """Return a digest of everything that a job's files and record depend on."""
    mesh = _mesh_with_contents(json.dumps(row.tables.get("mesh", {})))
    tables = with_paths({**row.tables, "mesh": mesh}, lambda _, path: _content(path))
    inputs = [row.id, tables, row.outputs, row.exposure, row.tone]
    inputs += [row.meta] if row.meta else []
    return digest_of(code_version(), json.dumps(inputs, sort_keys=True))[:24]


def forget_files() -> None:
    """Clear the cached digests of files, which may have changed."""
    for cached in (_mesh_with_contents, _mesh_content, _content):
        cached.cache_clear()


@lru_cache(100_000)
def _mesh_with_contents(table: str) -> str:
    """Return a mesh table as JSON, with digests of files instead of paths."""
    mesh = json.loads(table)
    source = mesh.get("path") or str(data_dir("assets") / "head.glb")
    files = [_content(mesh.get(name) or "") for name in MESH_PATHS if name != "path"]
    options = [(key, mesh[key]) for key in sorted(mesh) if key not in MESH_PATHS]
    return json.dumps([_mesh_content(source), files, options])


@lru_cache(100_000)
def _mesh_content(path: str) -> str:
    """Return a digest of a mesh file and of the files that it references."""
    try:
        source = source_of(path)
    except InputError:
        return digest_of(_content(path))
    content = hashlib.blake2b(source.content).hexdigest()[:32]
    return digest_of(content, *(_content(str(reference)) for reference in named_files(source)))


@lru_cache(100_000)
def _content(path: str) -> str:
    """Return a digest of a file's content, or the file's path if the file cannot be read."""
    # The loader reports the error of an unreadable file, for its job only.
    with suppress(OSError, ValueError):
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return f"absent: {path}"
