"""The output of a batch: a local folder, or a URL that fsspec supports (s3://...), with the files
and records of jobs, batch.json, and the tables of a finished batch. The messages between a worker
and its supervisor are here as well.

The name of a chunk contains a digest of the keys of its jobs. The presence of its record marks a
finished chunk, so the records alone define which jobs are done."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import shutil
import tarfile
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from io import BytesIO
from itertools import starmap
from pathlib import Path
from typing import IO, Literal
from uuid import uuid4

import numpy as np

from facerender import __version__
from facerender.batch.jobs import Chunk, Record, Row, Settings, chunks, file_name, forget_files
from facerender.batch.outputs import transforms_frame
from facerender.batch.tables import json_lines, write_parquet
from facerender.errors import InputError, reason, withheld
from facerender.system.files import TEMPORARY, CannotUse, reported
from facerender.system.process import optional
from facerender.system.signals import if_ended

_UNFINISHED = ".unfinished"
_AGAIN = "and run the same command again"


class Storage:
    """Files below a folder, or a URL that fsspec supports, with relative paths as names. Methods
    raise CannotUse if a file cannot be written or read."""

    def __init__(self, root: str) -> None:
        self.root = self._path = root.rstrip("/")
        self.remote = "://" in self.root
        if not self.remote:
            return
        remedy = "pip install 'facerender[batch]'"
        fsspec = optional("fsspec.core", f"{self.root} needs fsspec: {remedy}")
        try:
            # A cached listing would miss files that other processes have written since.
            system, path = fsspec.url_to_fs(self.root, use_listings_cache=False)
        except (ValueError, ImportError) as error:
            remedy = "give a folder or a URL"
            raise InputError(f"{self.root} cannot be reached ({error}); {remedy}") from None
        self._system, self._path = system, str(path)

    def _at(self, name: str) -> str:
        return f"{self._path}/{name}"

    def put(self, name: str, content: bytes) -> None:
        """Write a file atomically."""
        if self.remote:
            with self._writing(name):
                self._system.pipe_file(self._at(name), content)
        else:
            self.write(name, lambda file: file.write_bytes(content))

    def write(self, name: str, write: Callable[[Path], object]) -> None:
        """Write a file atomically with a function that writes to a path."""
        with self.temporary() as file:
            with self.scratch():
                write(file)
            self.move(file, name)

    def move(self, source: Path | str, name: str) -> None:
        """Move a local file from :meth:`temporary`, or a file with a name in this storage."""
        with self._writing(name):
            if not self.remote:
                source = Path(self.root, source) if isinstance(source, str) else source
                target = Path(self.root, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(source, target)
            elif isinstance(source, str):
                self._system.mv(self._at(source), self._at(name))
            else:
                self._system.put_file(str(source), self._at(name))
                source.unlink()

    def has(self, name: str) -> bool:
        """Return whether a file exists."""
        with self._reading(name):
            exists = self._system.exists if self.remote else os.path.exists
            return bool(exists(self._at(name)))

    @contextmanager
    def temporary(self) -> Iterator[Path]:
        """Yield a unique local path, whose folder exists. Remove the file at the end of the context
        unless it has been moved."""
        if self.remote:
            # All users of a machine share this folder: a subfolder would belong to the first user.
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

    def get(self, name: str, max_bytes: int | None = None) -> bytes:
        """Return a file's content, or its first bytes; raise FileNotFoundError if absent."""
        with self._reading(name):
            if self.remote:
                return bytes(self._system.cat_file(self._at(name), end=max_bytes))
            with open(self._at(name), "rb") as file:
                return file.read(max_bytes)

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder; empty if the folder does not exist."""
        try:
            with self._reading(folder):
                if not self.remote:
                    return os.listdir(self._at(folder))
                paths = self._system.ls(self._at(folder), detail=False)
                return [path.rpartition("/")[2] for path in paths]
        except FileNotFoundError:
            return []

    def drop(self, name: str) -> None:
        """Remove a file if it exists."""
        with self._writing(name):
            if not self.remote:
                Path(self.root, name).unlink(missing_ok=True)
            elif self._system.exists(self._at(name)):
                self._system.rm_file(self._at(name))

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


ABOUT = "batch.json"  # Settings of the batch, and the ID of the last run.
BEGUN = "begun"  # Folder: for each unfinished chunk, a list of its files.
RECORDS = "records"
STALE = "stale"  # Folder: records of chunks whose jobs have changed.
_BLOCK = 512  # Bytes per tar block.


class Writer:
    """Writer of a chunk's output files, in the order of its jobs: separate files or, with layout
    "shards", one unfinished tar, of which the first `size` bytes are valid."""

    def __init__(self, settings: Settings, chunk: Chunk, tar: Path | None, size: int) -> None:
        self.storage, self.chunk, self._run = Storage(settings.output), chunk, settings.run
        self.size, self._tar = size, tar
        self._get = lru_cache(1)(self.storage.get)  # Consecutive jobs mostly share a tar.
        if tar is not None:
            with self.storage.scratch(), tar.open("r+b" if size else "wb") as file:
                file.truncate(size)

    def write(self, position: int, files: Mapping[str, bytes], description: Record) -> Record:
        """Write the files of a job, and return the job's record with the items of `description`."""
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
        record = {**self.chunk.identity(position), **description, "files": written}
        if self._tar is not None:
            members = {f"{row.id}.{name}": content for name, content in files.items()}
            members[f"{row.id}.json"] = json.dumps(record).encode()
            with self.storage.scratch():
                self.size = _append(self._tar, starmap(_member, members.items()))
        return record

    def keep(self, position: int) -> Record | None:
        """Reuse the files of a job in `chunk.kept`, and return the new record; return None if the
        files have changed since."""
        record = self.chunk.kept[position]
        try:
            files = _read_files(self._get, record)
        except (OSError, CannotUse, KeyError, tarfile.TarError):
            return None
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        if digests != {name: about["sha256"] for name, about in record["files"].items()}:
            return None  # Another run has overwritten the files.
        identity = self.chunk.identity(position)
        if self._tar is None:
            return {**record, **identity}
        description = {key: record[key] for key in record if key not in (*identity, "files")}
        return self.write(position, files, description)


def _check_run(storage: Storage, run: str) -> None:
    """Raise CannotUse if another run of the batch has started."""
    try:
        about = json.loads(storage.get(ABOUT))
    except FileNotFoundError:  # batch.json exists only if a coordinator runs the batch.
        return
    if about["run"] != run:
        remedy = "wait for it, or give another folder"
        raise CannotUse(f"another run of the batch has started in {storage.root}: {remedy}")


def begin(settings: Settings, chunk: Chunk) -> None:
    """Write a list of the files that a chunk will have."""
    # If the chunk is interrupted and its jobs change, a later run removes the listed files.
    named: list[Record] = []
    for row in chunk.rows:
        names = map(file_name, row.outputs)
        files = {n: {"path": _path(chunk, row, n, settings.layout == "shards")} for n in names}
        named.append({"id": row.id, "key": "", "files": files})
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    _put_records(storage, BEGUN, chunk, named)


def commit(settings: Settings, chunk: Chunk, tar: Path | None, records: Sequence[Record]) -> None:
    """Finish the tar of a chunk, then write the chunk's record, which marks the chunk as done.
    A chunk without drawn jobs has no tar."""
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    if tar is not None and not all("error" in record for record in records):
        with storage.scratch():
            _append(tar, [bytes(2 * _BLOCK)])
        storage.move(tar, f"shards/{chunk.name}.tar")
    _put_records(storage, RECORDS, chunk, records)
    storage.drop(f"{BEGUN}/{chunk.name}.jsonl")


def _put_records(storage: Storage, folder: str, chunk: Chunk, records: Sequence[Record]) -> None:
    """Write a line that counts the drawn and failed jobs, then a line for each job."""
    failed = sum("error" in record for record in records)
    head = {"chunk": chunk.number, "done": len(records) - failed, "failed": failed}
    lines = "".join(json.dumps(entry) + "\n" for entry in (head, *records))
    storage.put(f"{folder}/{chunk.name}.jsonl", lines.encode())


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
    """Append to an existing tar and return the new size of the tar."""
    # This mode never creates a tar: if another coordinator has removed the tar, a new one would
    # lack the earlier members.
    with tar.open("r+b") as file:
        file.seek(0, os.SEEK_END)
        file.writelines(pieces)
        return file.tell()


def _member(name: str, content: bytes) -> bytes:
    # With the default owner, mode and time, equal jobs give equal bytes.
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    return entry.tobuf(tarfile.GNU_FORMAT) + content + bytes(-len(content) % _BLOCK)


def read_head(storage: Storage, name: str) -> dict[str, int]:
    """Return the first line of a chunk's record: "chunk", "done" and "failed"."""
    head = storage.get(f"{RECORDS}/{name}.jsonl", 200).partition(b"\n")[0]
    return dict(json.loads(head))


def read_records(storage: Storage, name: str, folder: str = RECORDS) -> Iterator[Record]:
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


def failure(chunk: Chunk, position: int, error_type: str, text: str) -> Record:
    """Return the record of a failed job."""
    row = chunk.rows[position]
    error = {"error": withheld(1, "message") if row.anonymous else text, "kind": error_type}
    return {**chunk.identity(position), **error, **row.inputs}


FAILED = "failed.jsonl"  # Records of the failed jobs.
TABLES = ("jobs.jsonl", "jobs.parquet", FAILED, "transforms.json")
# Maximum bytes of a temporary file in memory; a larger file is on disk.
_IN_MEMORY = 1 << 20


class Work:
    """The chunks of a batch in a temporary file, and the names of the chunks to draw."""

    # A Python table may give other rows when it is read again, and a large table does not fit into
    # memory.

    def __init__(self, file: IO[bytes], all_chunks: Iterable[Chunk]) -> None:
        self._file = file
        self.ids = array("q")  # hashes of the ids of all jobs, 8 bytes each
        self.sizes: dict[str, int] = {}  # number of jobs, keyed by the name of a chunk, in order
        self.todo: list[str] = []  # names of the chunks to draw, see `start`
        self._offsets: dict[str, int] = {}
        for chunk in all_chunks:
            self.sizes[chunk.name], self._offsets[chunk.name] = len(chunk.rows), file.tell()
            self.ids.extend(hash(row.id) for row in chunk.rows)
            pickle.dump(chunk, file, protocol=pickle.HIGHEST_PROTOCOL)
        file.flush()

    @property
    def left(self) -> int:
        """The number of jobs in the chunks to draw."""
        return sum(self.sizes[name] for name in self.todo)

    def chunks(self, storage: Storage) -> Iterator[Chunk]:
        """Yield the chunks to draw, each with the records of its jobs that are already drawn.

        The records come from stale chunks, or from the same chunk if another of its jobs failed.
        """
        finished = record_names(storage)
        chunks_of_folders = [(RECORDS, name) for name in self.todo if name in finished]
        chunks_of_folders += [(STALE, n) for n in sorted(record_names(storage, STALE))]
        find = _finder(storage, chunks_of_folders)
        for name in self.todo:
            self._file.seek(self._offsets[name])
            chunk: Chunk = pickle.load(self._file)
            pairs = ((i, find(key)) for i, key in enumerate(chunk.keys))
            yield replace(chunk, kept={i: record for i, record in pairs if record})


@contextmanager
def spooled(rows: Iterable[Row], settings: Settings, size: int | None) -> Iterator[Work]:
    """Read all rows and store them as chunks; `size` and errors as in :func:`chunks`. Raise
    CannotUse if the temporary file cannot be written."""
    forget_files()
    file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115
    try:
        with reported("write", temporary_folder(), "or set TMPDIR to another folder"):
            work = Work(file, chunks(rows, size, settings.layout))
        yield work
    finally:
        with suppress(OSError):  # on a full disk, the rest of the buffer cannot be written
            file.close()


def _finder(
    storage: Storage, chunks_of_folders: list[tuple[str, str]]
) -> Callable[[str], Record | None]:
    """Return a function that finds the record of a drawn job by the job's key, in the records of
    chunks, of which each has a folder and a name."""
    hashes, numbers = array("q"), array("L")  # 16 bytes per record; a dict needs ten times as many
    for number, (folder, name) in enumerate(chunks_of_folders):
        for record in read_records(storage, name, folder):
            if "error" not in record:
                hashes.append(hash(record["key"]))
                numbers.append(number)
    order = np.argsort(np.asarray(hashes), kind="stable")
    sorted_hashes = np.asarray(hashes)[order]

    @lru_cache(4)
    def read(number: int) -> dict[str, Record]:
        folder, name = chunks_of_folders[number]
        return {record["key"]: record for record in read_records(storage, name, folder)}

    def find(key: str) -> Record | None:
        index = np.searchsorted(sorted_hashes, hash(key))
        if index == len(order) or sorted_hashes[index] != hash(key):
            return None
        return read(numbers[order[index]]).get(key)

    return find


@contextmanager
def locked(output: str) -> Iterator[Storage]:
    """Create and lock the output folder. An output URL is not locked. Raise InputError if another
    command writes to the folder, or the folder cannot be written."""
    import fcntl  # absent on Windows

    storage = Storage(output)
    with ExitStack() as stack:
        if not storage.remote:
            with storage.scratch():
                Path(storage.root).mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context(Path(storage.root, ".lock").open("w"))
            # The lock ends with this process, also if the process is killed.
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                problem = f"another batch is being written to {storage.root}"
                raise InputError(f"{problem}: wait for it, or give another folder") from None
            storage.sweep()
            stack.enter_context(if_ended(storage.sweep, always=True))
        yield storage


def start(
    work: Work, storage: Storage, settings: Settings, table: str, prune: bool, retry_failed: bool
) -> None:
    """Start a run: find the chunks to draw, with `retry_failed` also chunks with failed jobs, and
    set records of changed chunks aside in STALE. Raise InputError if the table lacks jobs that an
    earlier run has drawn, unless `prune` is set."""
    if not prune:
        _check_removed(work, storage, table)
    run = {"facerender": __version__, "layout": settings.layout, "run": settings.run}
    about = {**run, "table": Path(table).name, "jobs": len(work.ids)}
    # A worker that outlives an earlier run now stops writing.
    storage.put(ABOUT, json.dumps(about, indent=2).encode() + b"\n")
    finished, begun = record_names(storage), record_names(storage, BEGUN)
    work.todo = [
        name
        for name in work.sizes
        if name not in finished or (retry_failed and read_head(storage, name)["failed"])
    ]
    stale = (finished | begun).difference(work.sizes)
    # In this order: a run that is killed here leaves no table that disagrees with the records.
    for name in TABLES if work.todo or stale else ():
        storage.drop(name)
    for name in stale & finished:
        storage.move(f"{RECORDS}/{name}.jsonl", f"{STALE}/{name}.jsonl")
    set_aside = record_names(storage, STALE)
    for name in stale & begun:
        if name in set_aside:  # the record in STALE has more data than the list in BEGUN
            storage.drop(f"{BEGUN}/{name}.jsonl")
        else:
            storage.move(f"{BEGUN}/{name}.jsonl", f"{STALE}/{name}.jsonl")


def _check_removed(work: Work, storage: Storage, table: str) -> None:
    """Raise InputError if the table of jobs lacks jobs that an earlier run has drawn."""
    finished = array("q")
    for folder in (RECORDS, STALE):
        for name in record_names(storage, folder).difference(work.sizes):
            # A list from the folder BEGUN has empty keys: its jobs are not finished.
            finished.extend(
                hash(record["id"])
                for record in read_records(storage, name, folder)
                if record["key"] and "error" not in record
            )
    # With millions of ids, setdiff1d takes tens of MiB, which most batches do not need.
    if finished and (count := len(np.setdiff1d(np.asarray(finished), np.asarray(work.ids)))):
        remedy = "give another folder, or --prune to delete their files"
        raise InputError(f"{table} lacks {count} of the finished jobs in {storage.root}: {remedy}")


def status(output: str) -> dict[str, int]:
    """Return the number of "jobs" of a batch, and how many of them are "done", "failed", "left".
    Raise InputError if the output contains no batch."""
    storage = Storage(output)
    try:
        jobs = int(json.loads(storage.get(ABOUT))["jobs"])
        heads = [read_head(storage, name) for name in record_names(storage)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"{output} is not a batch: its {ABOUT} cannot be read ({reason(error)})"
        raise InputError(f"{problem}; give the output folder of facerender batch") from None
    done, failed = (sum(head[name] for head in heads) for name in ("done", "failed"))
    return {"jobs": jobs, "done": done, "failed": failed, "left": jobs - done - failed}


def finish(storage: Storage, table: str, transforms: bool) -> None:
    """Write the missing tables of a finished batch, and remove files that no job uses. `table` is
    the suffix of the table of drawn jobs; `transforms`, whether to write transforms.json."""
    table_name = f"jobs.{table}"
    if storage.has(table_name) and (storage.has("transforms.json") or not transforms):
        return
    with storage.temporary() as jobs, storage.temporary() as failed:
        with storage.scratch(), jobs.open("w") as good, failed.open("w") as bad:
            # Sorted: the workers finish chunks in any order, but the tables do not depend on it.
            for name in sorted(record_names(storage)):
                for record in read_records(storage, name):
                    (bad if "error" in record else good).write(json.dumps(record) + "\n")
        _drop_stale(storage, jobs)
        for name in storage.names(BEGUN):  # a finished chunk's list remains if its run was killed
            storage.drop(f"{BEGUN}/{name}")
        if failed.stat().st_size:
            storage.move(failed, FAILED)
        if transforms:
            storage.write("transforms.json", partial(_write_transforms, jobs))
        if table == "jsonl":
            storage.move(jobs, table_name)
        else:
            storage.write(table_name, partial(write_parquet, jobs))


def failures(storage: Storage) -> Iterator[Record]:
    """Yield the records of the failed jobs of a finished batch, from the first 16 MiB of FAILED."""
    if storage.has(FAILED):
        lines = storage.get(FAILED, 1 << 24).splitlines(keepends=True)
        yield from (json.loads(line) for line in lines if line.endswith(b"\n"))


def _drop_stale(storage: Storage, jobs: Path) -> None:
    """Remove stale records, and each of their files that no current record lists."""
    if not (stale := storage.names(STALE)):
        return
    named = array("q")  # hashes of paths: 8 bytes each
    for record in json_lines(jobs):
        named.extend(hash(about["path"]) for about in record["files"].values())
    current = np.sort(np.asarray(named))
    for name in stale:
        for record in read_records(storage, name.removesuffix(".jsonl"), STALE):
            for path in {about["path"] for about in record.get("files", {}).values()}:
                index = np.searchsorted(current, hash(path))
                if index == len(current) or current[index] != hash(path):
                    storage.drop(path)
                    if not storage.remote:
                        with suppress(OSError):  # the folder has other files
                            Path(storage.root, path).parent.rmdir()
        storage.drop(f"{STALE}/{name}")


def _write_transforms(jobs: Path, target: Path) -> None:
    """Write all cameras to a file in the format of nerfstudio and instant-ngp."""
    with target.open("w") as file:
        file.write('{"camera_model": "OPENCV", "frames": [')
        for number, record in enumerate(json_lines(jobs)):
            name, about = next(iter(record["files"].items()))
            # Readers cannot open a member of a tar: its name is the path after unpacking.
            image = f"{record['id']}.{name}" if about["path"].endswith(".tar") else about["path"]
            frame = json.dumps(transforms_frame(record["camera"], image))
            file.write(f"{',' * (number > 0)}\n{frame}")
        file.write("\n]}\n")
