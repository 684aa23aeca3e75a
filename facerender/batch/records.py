"""Chunks of jobs that are drawn, written and committed together, and their storage: a local folder,
or a URL that fsspec supports (s3://...).

The name of a chunk contains a digest of everything that the chunk's files depend on. Each file is
written atomically. The record of a chunk is written last: its presence marks a finished chunk. The
messages between a worker and its supervisor are here as well."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from io import BufferedReader, BytesIO
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

from facerender import __version__
from facerender.batch.jobs import FILES, Row, file_name
from facerender.errors import InputError
from facerender.loading.source import named_files, source_of
from facerender.mesh.face import RELIEFS
from facerender.scene.job import MESH_PATHS
from facerender.system.files import TEMPORARY, CannotUse, data_dir, digest_of, reported

if TYPE_CHECKING:
    from facerender.drawing.context import Backend


_UNFINISHED = ".unfinished"
_AGAIN = "and run the same command again"


class Storage:
    """Files below a root, addressed by relative paths with slashes.

    Parameters
    ----------
    root : path of a folder, or a URL that fsspec supports

    Raises
    ------
    InputError : the protocol of the URL is unknown, or the Python package for it is missing. All
        methods raise CannotUse if a file cannot be written or read
    """

    def __init__(self, root: str) -> None:
        root = root.rstrip("/")
        self.root, self.remote = root, "://" in root
        if not self.remote:
            return
        try:
            import fsspec
        except ImportError:
            raise InputError(f"{root} needs fsspec: pip install 'facerender[batch]'") from None
        try:
            # A cached listing would miss files that other processes have written since.
            self._system, path = fsspec.core.url_to_fs(root, use_listings_cache=False)
        except (ValueError, ImportError) as error:
            raise InputError(
                f"{root} cannot be reached ({error}); give a folder or a URL"
            ) from None
        self._path = str(path)

    def put(self, name: str, content: bytes) -> None:
        """Write a file atomically."""
        if self.remote:
            with self._writing(name):
                self._system.pipe_file(f"{self._path}/{name}", content)
            return
        with self.temporary() as file:
            with self.scratch():
                file.write_bytes(content)
            self.move(file, name)

    def move(self, source: Path, name: str) -> None:
        """Move a local file, usually from :meth:`temporary`, to a name in this storage."""
        with self._writing(name):
            if self.remote:
                self._system.put_file(str(source), f"{self._path}/{name}")
                source.unlink()
                return
            target = Path(self.root, name)
            try:
                os.replace(source, target)
            except FileNotFoundError:
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(source, target)

    def has(self, name: str) -> bool:
        """Return whether a file exists."""
        if self.remote:
            with self._reading(name):
                return bool(self._system.exists(f"{self._path}/{name}"))
        return os.path.exists(Path(self.root, name))

    def rename(self, name: str, other: str) -> None:
        """Rename a file."""
        if self.remote:
            with self._writing(other):
                self._system.mv(f"{self._path}/{name}", f"{self._path}/{other}")
        else:
            self.move(Path(self.root, name), other)

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """Yield a unique local path, whose folder exists. Remove the file at the end of the context
        unless it has been moved."""
        if self.remote:  # Users of a machine share this folder, so it gets no folder of one user.
            file = Path(temporary_folder(), f"{TEMPORARY}{uuid4().hex}")
        else:
            file = Path(self.root, _UNFINISHED, uuid4().hex)
            with self.scratch():
                file.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield file
        finally:
            with suppress(OSError):
                file.unlink()

    def scratch(self) -> AbstractContextManager[None]:
        """Return a context in which an OSError of a temporary file raises CannotUse."""
        return reported("write", temporary_folder() if self.remote else self.root, _AGAIN)

    def get(self, name: str, most: int | None = None) -> bytes:
        """Return a file's content, or its first `most` bytes; raise FileNotFoundError if absent."""
        with self._reading(name):
            if self.remote:
                return bytes(self._system.cat_file(f"{self._path}/{name}", end=most))
            with open(f"{self.root}/{name}", "rb") as file:
                return file.read(-1 if most is None else most)

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder; empty if the folder does not exist."""
        try:
            with self._reading(folder):
                if self.remote:
                    paths = self._system.ls(f"{self._path}/{folder}", detail=False)
                    return [path.rpartition("/")[2] for path in paths]
                return os.listdir(Path(self.root, folder))
        except FileNotFoundError:
            return []

    def drop(self, name: str) -> None:
        """Remove a file if it exists."""
        with self._writing(name):
            if not self.remote:
                Path(self.root, name).unlink(missing_ok=True)
            elif self._system.exists(f"{self._path}/{name}"):
                self._system.rm_file(f"{self._path}/{name}")

    def prune(self, name: str) -> None:
        """Remove the folder of a file if the folder is empty. Call only while no worker writes."""
        with suppress(OSError):
            if not self.remote:
                Path(self.root, name).parent.rmdir()

    def sweep(self) -> None:
        """Remove temporary files of interrupted writers. Call this only while no worker writes."""
        if not self.remote:
            shutil.rmtree(Path(self.root, _UNFINISHED), ignore_errors=True)

    def _writing(self, name: str) -> AbstractContextManager[None]:
        return reported("write", f"{self.root}/{name}", _AGAIN)

    @contextmanager
    def _reading(self, name: str) -> Iterator[None]:
        try:
            yield
        except FileNotFoundError:
            raise
        except OSError:
            with reported("read", f"{self.root}/{name}", _AGAIN):
                raise


def temporary_folder() -> str:
    """Return the folder of temporary files, which may not be writable."""
    try:
        return tempfile.gettempdir()
    except OSError:
        return os.environ.get("TMPDIR", "/tmp")


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
    lower = "values", "terms", "images", "texture", "mesh", "loading", "scene"
    folders = *lower, "glsl", "drawing"
    paths = [path for name in folders for path in sorted((_PACKAGE / name).rglob("*.py"))]
    paths += (_PACKAGE / name for name in ("batch/outputs.py", "material.py"))
    paths.append(RELIEFS)  # the frame of a camera depends on them
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
    try:
        source = source_of(path)
    except InputError:
        return digest_of(_content(path))
    content = _digest_of_file(BytesIO(source.content))
    return digest_of(content, *(_content(str(reference)) for reference in named_files(source)))


@lru_cache(100_000)
def _content(path: str) -> str:
    """Return a digest of a file's content, or the file's path if the file cannot be read."""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as file:
                return _digest_of_file(file)
    except (OSError, ValueError):
        pass  # the loader reports the error
    return f"absent: {path}"


def _digest_of_file(file: BytesIO | BufferedReader) -> str:
    return hashlib.file_digest(file, "blake2b").hexdigest()[:32]


ABOUT = "batch.json"  # Settings of the batch, and the ID of the last run.
BEGUN = "begun"  # Folder: for each unfinished chunk, a list of its files.
RECORDS = "records"
STALE = "stale"  # Folder: records of chunks whose jobs have changed.
_BLOCK = 512  # Bytes per tar block.


class Writer:
    """Writer of a chunk's output files, in the order of its jobs: separate files or one tar.

    ``tar``: the unfinished tar with layout "shards"; None with layout "files"; ``size``: number of
    valid bytes in the tar; the constructor cuts off the rest.
    """

    def __init__(self, settings: Settings, chunk: Chunk, tar: Path | None, size: int) -> None:
        self.storage, self.chunk, self._run = Storage(settings.output), chunk, settings.run
        self.size, self._tar = size, tar
        self._get = lru_cache(1)(self.storage.get)  # Consecutive jobs mostly share a tar.
        if tar is not None:
            with self.storage.scratch(), tar.open("r+b" if size else "wb") as file:
                file.truncate(size)

    def write(self, position: int, files: Mapping[str, bytes], facts: Record) -> Record:
        """Write the files of a job and return the job's record; errors as in Storage."""
        row = self.chunk.rows[position]
        # On remote storage this check would cost one request per job.
        if self._tar is None and not self.storage.remote:
            _check_run(self.storage, self._run)
        written: Record = {}
        for name, content in files.items():
            path = _path(self.chunk, row, name, self._tar is not None)
            if self._tar is None:
                self.storage.put(path, content)
            digest = hashlib.sha256(content).hexdigest()
            written[name] = {"path": path, "bytes": len(content), "sha256": digest}
        record = self._record(position, facts, written)
        if self._tar is not None:
            members = {f"{row.id}.{name}": content for name, content in files.items()}
            members[f"{row.id}.json"] = json.dumps(record).encode()
            with self.storage.scratch():
                self.size = _append(self._tar, itertools.starmap(_member, members.items()))
        return record

    def keep(self, position: int) -> Record | None:
        """Reuse the files of a job that an earlier run drew, and return the new record.

        Return None if no earlier run drew the job, or if its files have changed.
        """
        if (record := self.chunk.kept.get(position)) is None:
            return None
        try:
            files = _read_files(self._get, record)
        except (OSError, CannotUse, KeyError, tarfile.TarError):
            return None
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        if digests != {name: about["sha256"] for name, about in record["files"].items()}:
            return None  # Another run has overwritten the files.
        facts = {key: record[key] for key in record if key not in ("id", "number", "key", "files")}
        if self._tar is None:
            return self._record(position, facts, record["files"])
        return self.write(position, files, facts)

    def _record(self, position: int, facts: Record, files: Record) -> Record:
        row = self.chunk.rows[position]
        about = {"id": row.id, "number": row.number, "key": self.chunk.keys[position]}
        return {**about, **facts, "files": files}


def _check_run(storage: Storage, run: str) -> None:
    """Raise CannotUse if another run of the batch has started."""
    try:
        about = json.loads(storage.get(ABOUT))
    except FileNotFoundError:  # batch.json exists only if a coordinator runs the batch.
        return
    if about["run"] != run:
        raise CannotUse(
            f"another run of the batch has started in {storage.root}: wait for it, or give another "
            "folder"
        )


def begin(settings: Settings, chunk: Chunk) -> None:
    """Write a list of the files that a chunk will have.

    If the chunk is interrupted and its jobs change, a later run removes the listed files.

    Raises
    ------
    CannotUse : the list cannot be written, or another run has started
    """
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    named: list[Record] = []
    for row in chunk.rows:
        names = map(file_name, row.outputs)
        files = {n: {"path": _path(chunk, row, n, settings.layout == "shards")} for n in names}
        named.append({"id": row.id, "key": "", "files": files})
    _put_records(storage, f"{BEGUN}/{chunk.name}.jsonl", chunk, named, 0)


def commit(settings: Settings, chunk: Chunk, tar: Path | None, records: Sequence[Record]) -> None:
    """Finish the tar of a chunk, then write the chunk's record, which marks the chunk as done.
    A chunk without drawn jobs has no tar.

    The first line of the record counts the drawn and failed jobs; each further line describes one
    job. Raises CannotUse if a file cannot be written, or another run has started.
    """
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    done = sum("error" not in record for record in records)
    if tar is not None and done:
        with storage.scratch():
            _append(tar, [bytes(2 * _BLOCK)])
        storage.move(tar, f"shards/{chunk.name}.tar")
    _put_records(
        storage, f"{RECORDS}/{chunk.name}.jsonl", chunk, records, done, len(records) - done
    )
    storage.drop(f"{BEGUN}/{chunk.name}.jsonl")


def _put_records(
    storage: Storage, name: str, chunk: Chunk, records: Sequence[Record], done: int, failed: int = 0
) -> None:
    head = {"chunk": chunk.number, "done": done, "failed": failed}
    lines = "".join(json.dumps(entry) + "\n" for entry in (head, *records))
    storage.put(name, lines.encode())


def _path(chunk: Chunk, row: Row, name: str, shards: bool) -> str:
    """Return the path of a job's file, or of the tar that contains it."""
    return f"shards/{chunk.name}.tar" if shards else f"data/{row.id}/{name}"


def _read_files(get: Callable[[str], bytes], record: Record) -> dict[str, bytes]:
    """Return a drawn job's files; raise FileNotFoundError or KeyError if a file is missing."""
    files: Mapping[str, Mapping[str, str]] = record["files"]
    paths = {name: about["path"] for name, about in files.items()}
    if all(path.startswith("data/") for path in paths.values()):
        return {name: get(path) for name, path in paths.items()}
    with tarfile.open(fileobj=BytesIO(get(next(iter(paths.values()))))) as tar:
        members = {name: tar.extractfile(f"{record['id']}.{name}") for name in paths}
        return {name: file.read() for name, file in members.items() if file}


def _append(tar: Path, pieces: Iterable[bytes]) -> int:
    """Append to an existing tar and return the new size of the tar.

    This function never creates a tar: if another coordinator has removed the tar, a new one would
    lack the earlier members.
    """
    with tar.open("r+b") as file:
        file.seek(0, os.SEEK_END)
        file.writelines(pieces)
        return file.tell()


def _member(name: str, content: bytes) -> bytes:
    entry = tarfile.TarInfo(name)  # Default owner, mode and time: equal jobs give equal bytes.
    entry.size = len(content)
    return entry.tobuf(tarfile.GNU_FORMAT) + content + bytes(-len(content) % _BLOCK)


def read_head(storage: Storage, name: str) -> dict[str, int]:
    """Return the first line of a chunk's record: "chunk", "done" and "failed"."""
    head = storage.get(f"{RECORDS}/{name}.jsonl", 200).partition(b"\n")[0]
    return dict(json.loads(head))


def records_of(storage: Storage, name: str, folder: str = RECORDS) -> Iterator[Record]:
    """Yield the records of a chunk's drawn and failed jobs."""
    for line in storage.get(f"{folder}/{name}.jsonl").splitlines()[1:]:
        yield json.loads(line)


def record_names(storage: Storage, folder: str = RECORDS) -> set[str]:
    """Return the names of the chunks that have a record."""
    return {n.removesuffix(".jsonl") for n in storage.names(folder) if n.endswith(".jsonl")}


NO_MEMORY = 9  # Exit status of a worker: out of memory.


@dataclass(frozen=True)
class Order:
    """A request to draw the remaining jobs of a chunk."""

    settings: Settings
    chunk: Chunk
    left: tuple[int, ...]  # Indices of the remaining jobs in the chunk.
    tar: Path | None  # See :class:`facerender.batch.records.Writer`.
    size: int
    ahead: bool  # Whether to draw the next job while the files of a job are written.


@dataclass(frozen=True)
class Message:
    """A worker's report of one step.

    Steps: "loads": the worker loads the job's mesh; "draws": the worker draws the job; "done": the
    job is drawn; "kept": the files of an earlier run are reused; "failed": the job failed;
    "cannot": no job can be drawn; "end": the chunk is finished. "starts" is never sent: it is the
    supervisor's value until the first message arrives.
    """

    step: Literal["starts", "loads", "draws", "done", "kept", "failed", "cannot", "end"]
    position: int = -1  # Index of the job in the chunk.
    record: Record | None = None  # The job's record in the steps "done", "kept" and "failed".
    size: int = 0  # Size of the tar in bytes after this step.
    text: str = ""  # In the step "cannot", the reason.


def failure(chunk: Chunk, position: int, kind: str, text: str) -> Record:
    """Return the record of a failed job."""
    row = chunk.rows[position]
    job = {"id": row.id, "number": row.number, "key": chunk.keys[position]}
    return {**job, "error": text, "kind": kind, "job": row.tables, **meta_of(row)}


def meta_of(row: Row) -> Record:
    """Return the item "meta" of a job's record, if the job has it."""
    return {"meta": row.meta} if row.meta else {}
