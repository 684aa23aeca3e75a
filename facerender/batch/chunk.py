"""Chunks: groups of jobs that are drawn, written and committed together.

The name of a chunk contains a digest of everything that the chunk's files depend on. A chunk is
done if its record exists.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from facerender import __version__
from facerender.batch.jobs import FILES, Row
from facerender.errors import InputError
from facerender.job import MESH_PATHS
from facerender.loading.references import named_files
from facerender.system.data import data_dir
from facerender.system.files import digest_of

if TYPE_CHECKING:
    from facerender.drawing.context import Backend

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

    def __str__(self) -> str:
        return f"chunk {self.number}"

    @property
    def name(self) -> str:
        """The name, without suffix, of the chunk's record and of its tar."""
        return f"{self.number:06d}-{digest_of(*self.keys)[:16]}"


def chunk_size(total: int, layout: Layout) -> int:
    """Return the number of jobs per chunk.

    The size depends only on the total number of jobs and the layout: any number of workers gives
    the same chunks.
    """
    size = 32 if layout == "shards" else 1  # Readers shuffle whole tars.
    while size < _LARGEST and total >= 2 * _CHUNKS * size:
        size *= 2
    return size


def chunks(
    rows: Iterable[Row], size: int | None = None, layout: Layout = "files"
) -> Iterator[Chunk]:
    """Divide rows into chunks; rows with equal mesh and image tables share a chunk where possible.

    Few rows are in memory at a time. Raise InputError for an id with a dot in layout "shards".

    size : maximum number of jobs per chunk; None: the result of :func:`chunk_size`
    """
    rows = iter(rows)
    if size is None:
        first_rows = [*islice(rows, _CHUNKS * _LARGEST)]
        size = chunk_size(len(first_rows), layout)
        rows = chain(first_rows, rows)
        del first_rows
    waiting: dict[str, list[Row]] = {}
    waiting_count, numbers = 0, count()

    def close(group: list[Row]) -> Chunk:
        return Chunk(next(numbers), tuple(group), tuple(map(key_of, group)))

    def pack() -> list[Row]:
        """Return the rows of the longest-waiting groups: as many groups as fit into a chunk."""
        packed: list[Row] = []
        for name in list(waiting):
            if packed and len(packed) + len(waiting[name]) > size:
                break
            packed += waiting.pop(name)
        return packed

    for row in rows:
        if layout == "shards" and "." in row.id:
            raise InputError(
                f"id {row.id!r} contains a dot, at which readers of shards split the name: give "
                "an id without a dot, or use --layout files"
            )
        name = json.dumps([row.tables.get("mesh"), row.tables.get("image")])
        group = waiting.setdefault(name, [])
        group.append(row)
        waiting_count += 1
        if len(group) == size:
            packed = waiting.pop(name)
        elif waiting_count >= _CHUNKS * size:
            packed = pack()
        else:
            continue
        waiting_count -= len(packed)
        yield close(packed)
    while waiting:
        yield close(pack())


@cache
def code_version() -> str:
    """Return a digest of the package version and of all sources that the pixels depend on."""
    folders = ("terms", "glsl", "scenes", "loading", "drawing", "images")
    paths = [path for name in folders for path in sorted((_PACKAGE / name).rglob("*.py"))]
    paths += (_PACKAGE / name for name in ("batch/outputs.py", "job.py", "shading.py"))
    paths += sorted(path for path in data_dir("shaders").rglob("*") if path.is_file())
    return digest_of(__version__, *(path.read_bytes() for path in paths))


def key_of(row: Row) -> str:
    """Return a digest of everything that a job's files and record depend on.

    The digests of the job's input files are cached until :func:`forget_files` is called.
    """
    facts = [row.id, _with_contents(row.tables), row.outputs, row.exposure]
    facts += [row.meta] if row.meta else []
    return digest_of(code_version(), json.dumps(facts, sort_keys=True))[:24]


def _with_contents(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a job, with digests of files instead of their paths."""
    tables = dict(tables)
    tables["mesh"] = _mesh_facts(json.dumps(tables.get("mesh", {})))
    for key, names in FILES.items():
        if isinstance(table := tables.get(key), dict):
            tables[key] = table | {n: _content(table[n]) for n in names if table.get(n)}
    if isinstance(landmarks := tables.get("landmarks"), str):
        tables["landmarks"] = _content(landmarks)
    return tables


def forget_files() -> None:
    """Clear the cached digests of files, which may have changed."""
    _mesh_facts.cache_clear()
    _mesh_content.cache_clear()
    _content.cache_clear()


@lru_cache(100_000)
def _mesh_facts(table: str) -> str:
    """Return a mesh table as JSON, with digests of files instead of paths."""
    mesh = json.loads(table)
    source = mesh.get("path") or str(data_dir("assets") / "head.glb")
    files = [_content(mesh.get(name) or "") for name in MESH_PATHS if name != "path"]
    options = [(key, mesh[key]) for key in sorted(mesh) if key not in MESH_PATHS]
    return json.dumps([_mesh_content(source), files, options])


@lru_cache(100_000)
def _mesh_content(path: str) -> str:
    """Return a digest of a mesh file and of the files that it references."""
    return digest_of(
        _content(path), *(_content(str(reference)) for reference in named_files(Path(path)))
    )


@lru_cache(100_000)
def _content(path: str) -> str:
    """Return a digest of a file's content, or the file's path if the file cannot be read."""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    except (OSError, ValueError):
        pass  # the loader reports the error
    return f"absent: {path}"
