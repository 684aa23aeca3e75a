"""Jobs that are drawn, written and committed together, and their names: a digest of all that their
pixels depend on. A chunk whose record is there is done."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from facerender._version import __version__
from facerender.batch.jobs import Row
from facerender.loading.references import named_files
from facerender.system.data import data_dir

if TYPE_CHECKING:
    from facerender.drawing.context import Backend

Layout = Literal["files", "shards"]
Record = dict[str, Any]  # what is kept of a job, drawn or failed

_PACKAGE = Path(__file__).parents[1]
_DRAWS = ("terms", "glsl", "scenes", "loading", "drawing", "images")  # rooms that pixels come from
_ALSO = ("batch/passes.py", "job.py", "shading.py")
_HELD = 64  # chunks of rows that wait for others of their mesh
_FILES = ("path", "albedo", "normal_map", "specular_map", "roughness_map", "lobe_map")


@dataclass(frozen=True)
class Settings:
    """What all jobs of a batch share, and where they go.

    Attributes
    ----------
    output : a folder, or a URL
    layout : "files", a folder for each job, or "shards", a tar for each chunk
    backend : of OpenGL, see :class:`facerender.Renderer`
    timeout : seconds after which a worker that says nothing hangs
    tries : of a job that kills or hangs its worker
    painter : digest of the package that draws, see :func:`painter`
    run : of the command, so that workers of one that was killed know of the next
    """

    output: str
    layout: Layout = "files"
    backend: Backend = "auto"
    timeout: float = 300.0
    tries: int = 3
    painter: str = ""
    run: str = field(default_factory=lambda: uuid4().hex)


@dataclass(frozen=True)
class Chunk:
    """Jobs, in the order of their numbers.

    Attributes
    ----------
    number : its place among the chunks of the batch
    rows, keys : the jobs, and for each a digest of what its files depend on
    kept : by position, records of jobs that an earlier run has drawn
    """

    number: int
    rows: tuple[Row, ...]
    keys: tuple[str, ...]
    kept: Mapping[int, Record] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"chunk {self.number}"

    @property
    def name(self) -> str:
        """What its files are named."""
        return f"{self.number:06d}-{digest_of(*self.keys)[:16]}"


def chunk_size(total: int) -> int:
    """Return how many jobs a chunk of a batch has, of the number of all alone, so that it is the
    same however many workers there are: 64 chunks or more, of at most 128 jobs."""
    size = 1
    while size < 128 and total >= 128 * size:
        size *= 2
    return size


def chunks(rows: Iterable[Row], size: int) -> Iterator[Chunk]:
    """Divide rows into chunks of one mesh and one image size where there are enough of them; few
    rows are held at a time."""
    waiting: dict[str, list[Row]] = {}
    number = held = 0

    def close(group: list[Row]) -> Chunk:
        nonlocal number, held
        keys = tuple(map(key_of, group))
        number, held = number + 1, held - len(group)
        return Chunk(number - 1, tuple(group), keys)

    def pack() -> list[Row]:
        """The groups that wait longest, as many as fit."""
        packed: list[Row] = []
        for name in list(waiting):
            if packed and len(packed) + len(waiting[name]) > size:
                break
            packed += waiting.pop(name)
        return packed

    for row in rows:
        name = json.dumps([row.tables.get("mesh"), row.tables.get("image")])
        group = waiting.setdefault(name, [])
        group.append(row)
        held += 1
        if len(group) == size:
            yield close(waiting.pop(name))
        elif held >= _HELD * size:
            yield close(pack())
    while waiting:
        yield close(pack())


@cache
def painter() -> str:
    """Return a digest of what draws: the version, and the sources of package and shaders."""
    shaders = sorted(path for path in data_dir("shaders").rglob("*") if path.is_file())
    own = sources(_DRAWS, _ALSO)
    return digest_of(__version__, *own, *(path.read_bytes() for path in shaders))


def sources(rooms: Iterable[str], modules: Iterable[str]) -> list[bytes]:
    """Return the source of rooms and modules of the package."""
    paths = [path for room in rooms for path in sorted((_PACKAGE / room).rglob("*.py"))]
    return [path.read_bytes() for path in (*paths, *(_PACKAGE / name for name in modules))]


def key_of(row: Row) -> str:
    """Return a digest of all that a job's files depend on. Files that it names are read once, until
    :func:`forget_files`."""
    facts = [row.id, with_contents(row.tables), row.passes, row.exposure]
    facts += [row.plan] if row.plan else []
    return digest_of(painter(), json.dumps(facts, sort_keys=True))[:24]


def with_contents(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a job with digests of files in place of their paths."""
    tables = dict(tables)
    tables["mesh"] = _mesh_facts(json.dumps(tables.get("mesh", {})))
    if isinstance(environment := tables.get("environment"), dict):
        tables["environment"] = environment | {"file": _content(environment["file"])}
    return tables


def forget_files() -> None:
    """Have files read again, which may be others than they were."""
    _mesh_facts.cache_clear()
    _mesh_content.cache_clear()
    _content.cache_clear()


@lru_cache(100_000)
def _mesh_facts(table: str) -> str:
    """What is asked of a mesh, with digests in place of paths."""
    mesh = json.loads(table)
    source = mesh.get("path") or str(data_dir("assets") / "head.glb")
    files = [_content(mesh.get(name) or "") for name in _FILES[1:]]
    others = [(key, mesh[key]) for key in sorted(mesh) if key not in _FILES]
    return json.dumps([_mesh_content(source), files, others])


@lru_cache(100_000)
def _mesh_content(path: str) -> str:
    """A digest of a mesh file and of the files that it names."""
    return digest_of(_content(path), *(_content(str(each)) for each in named_files(Path(path))))


@lru_cache(100_000)
def _content(path: str) -> str:
    """A digest of a file; what cannot be read is named."""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    except (OSError, ValueError):
        pass  # who loads it is told
    return f"absent: {path}"


def hash_of(text: str) -> int:
    """Return 64 bits of a digest, which stand for a text where very many have to fit in memory."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def digest_of(*pieces: str | bytes) -> str:
    """Return a digest of pieces, each told from its neighbours."""
    whole = hashlib.blake2b(digest_size=16)
    for piece in pieces:
        content = piece.encode() if isinstance(piece, str) else piece
        whole.update(len(content).to_bytes(8, "little") + content)
    return whole.hexdigest()
