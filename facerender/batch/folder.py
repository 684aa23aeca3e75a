"""The output folder of a batch: lock, batch.json, tables of drawn and failed jobs, cameras, status,
and the work that earlier runs left. ``records.py`` writes the data and the records of chunks."""

from __future__ import annotations

import json
import pickle
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from facerender import __version__
from facerender.batch.jobs import Row
from facerender.batch.outputs import transforms_frame
from facerender.batch.records import (
    ABOUT,
    BEGUN,
    RECORDS,
    STALE,
    Chunk,
    Record,
    Settings,
    Storage,
    chunks,
    forget_files,
    read_head,
    record_names,
    records_of,
    temporary_folder,
)
from facerender.errors import InputError, reason
from facerender.system.files import reported
from facerender.system.signals import if_ended

_IN_MEMORY = 1 << 20  # maximum bytes of a temporary file in memory; a larger file is on disk


class Spool:
    """The chunks of a batch in a temporary file.

    The table of jobs is therefore read only once, with few rows in memory at a time.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.ids = array("q")  # hashes of the ids of all jobs, 8 bytes each
        self.sizes: dict[str, int] = {}  # number of jobs, keyed by the name of a chunk, in order
        self._offsets: dict[str, int] = {}

    def add(self, chunk: Chunk) -> None:
        """Append a chunk to the temporary file."""
        self.sizes[chunk.name], self._offsets[chunk.name] = len(chunk.rows), self._file.tell()
        self.ids.extend(hash(row.id) for row in chunk.rows)
        pickle.dump(chunk, self._file, protocol=pickle.HIGHEST_PROTOCOL)

    def chunks(self, names: Iterable[str]) -> Iterator[Chunk]:
        """Read the named chunks."""
        for name in names:
            self._file.seek(self._offsets[name])
            chunk: Chunk = pickle.load(self._file)
            yield chunk


@contextmanager
def spooled(rows: Iterable[Row], settings: Settings, size: int | None) -> Iterator[Spool]:
    """Read all rows and store them as chunks; `size` and errors as in :func:`chunks`. Raise
    CannotUse if the temporary file cannot be written."""
    forget_files()
    file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115
    try:
        spool = Spool(file)
        with reported("write", temporary_folder(), "or set TMPDIR to another folder"):
            for chunk in chunks(rows, size, settings.layout):
                spool.add(chunk)
            file.flush()
        yield spool
    finally:
        with suppress(OSError):  # on a full disk, the rest of the buffer cannot be written
            file.close()


@dataclass(frozen=True)
class Work:
    """The remaining work of a batch."""

    spool: Spool
    todo: tuple[str, ...]  # Names of the chunks to draw.
    jobs: int  # Number of jobs in all chunks.
    left: int  # Number of jobs in the chunks to draw.
    stale: frozenset[str]  # Chunks that an earlier run drew or began; their jobs have changed.


def check_removed(spool: Spool, storage: Storage, table: str) -> None:
    """Raise InputError if the table of jobs lacks jobs that an earlier run has drawn."""
    drawn = array("q")
    for folder in (RECORDS, STALE):
        for name in record_names(storage, folder).difference(spool.sizes):
            records = records_of(storage, name, folder)
            # A list from the folder BEGUN has empty keys: its jobs are not finished.
            drawn.extend(
                hash(record["id"]) for record in records if record["key"] and "error" not in record
            )
    # With millions of ids, setdiff1d takes tens of MiB, which most batches do not need.
    if drawn and (count := len(np.setdiff1d(np.asarray(drawn), np.asarray(spool.ids)))):
        raise InputError(
            f"{table} lacks {count} of the finished jobs in {storage.root}: give another folder, "
            "or --prune to delete their files"
        )


def work_of(spool: Spool, storage: Storage, retry_failed: bool) -> Work:
    """Find the remaining work: compare all chunks with the existing records.

    retry_failed : whether to draw chunks with failed jobs again
    """
    finished = record_names(storage)
    todo = tuple(
        name
        for name in spool.sizes
        if name not in finished or (retry_failed and read_head(storage, name)["failed"])
    )
    stale = (finished | record_names(storage, BEGUN)).difference(spool.sizes)
    left = sum(map(spool.sizes.__getitem__, todo))
    return Work(spool, todo, sum(spool.sizes.values()), left, frozenset(stale))


def with_kept(work: Work, storage: Storage) -> Iterator[Chunk]:
    """Yield the chunks to draw, each with the records of its jobs that are already drawn.

    The records come from stale chunks, or from the same chunk if another of its jobs failed.
    """
    find_stale = _stale_records(storage)
    names = record_names(storage)
    for chunk in work.spool.chunks(work.todo):
        records = records_of(storage, chunk.name) if chunk.name in names else ()
        drawn = {record["key"]: record for record in records if "error" not in record}
        kept_records = {}
        for position, key in enumerate(chunk.keys):
            if (record := drawn.get(key) or find_stale(key)) is not None:
                kept_records[position] = record
        yield replace(chunk, kept=kept_records)


def _stale_records(storage: Storage) -> Callable[[str], Record | None]:
    """Return a function that finds the stale record of a drawn job by the job's key.

    Its index takes 16 bytes per record.
    """
    names = sorted(record_names(storage, STALE))
    hashes, numbers = array("q"), array("L")
    for number, name in enumerate(names):
        for record in records_of(storage, name, STALE):
            if "error" not in record:
                hashes.append(hash(record["key"]))
                numbers.append(number)
    order = np.argsort(np.asarray(hashes), kind="stable")
    sorted_hashes, sorted_numbers = np.asarray(hashes)[order], np.asarray(numbers)[order]

    @lru_cache(4)
    def read(name: str) -> dict[str, Record]:
        return {record["key"]: record for record in records_of(storage, name, STALE)}

    def find(key: str) -> Record | None:
        index = np.searchsorted(sorted_hashes, hash(key))
        if index == len(order) or sorted_hashes[index] != hash(key):
            return None
        return read(names[sorted_numbers[index]]).get(key)

    return find


FAILED = "failed.jsonl"  # Records of the failed jobs.
TABLES = ("jobs.jsonl", "jobs.parquet", FAILED, "transforms.json")
Table = Literal["jsonl", "parquet"]


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
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"another batch is being written to {storage.root}: wait for it, or give "
                    "another folder"
                ) from None
            storage.sweep()
            stack.callback(storage.sweep)
            stack.enter_context(if_ended(storage.sweep))
        yield storage


def start(storage: Storage, settings: Settings, about: Mapping[str, Any]) -> None:
    """Write batch.json; a worker that outlives an earlier run then stops writing."""
    facts = {"facerender": __version__, "layout": settings.layout, "run": settings.run}
    storage.put(ABOUT, json.dumps({**facts, **about}, indent=2).encode() + b"\n")


def status(output: str) -> dict[str, int]:
    """Return the number of "jobs" of a batch, and how many of them are "done", "failed", "left".
    Raise InputError if the output contains no batch."""
    storage = Storage(output)
    try:
        jobs = int(json.loads(storage.get(ABOUT))["jobs"])
        heads = [read_head(storage, name) for name in record_names(storage)]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{output} is not a batch: its {ABOUT} cannot be read ({reason(error)}); "
            "give the output folder of facerender batch"
        ) from None
    done, failed = (sum(head[name] for head in heads) for name in ("done", "failed"))
    return {"jobs": jobs, "done": done, "failed": failed, "left": jobs - done - failed}


def set_aside(storage: Storage, work: Work) -> None:
    """Remove tables that will change, then move records of changed chunks to the folder STALE."""
    for name in TABLES if work.todo or work.stale else ():
        storage.drop(name)
    for name in work.stale & record_names(storage):
        storage.rename(f"{RECORDS}/{name}.jsonl", f"{STALE}/{name}.jsonl")
    stale_names = record_names(storage, STALE)
    for name in work.stale & record_names(storage, BEGUN):
        if name in stale_names:  # the record in STALE has more data than the list in BEGUN
            storage.drop(f"{BEGUN}/{name}.jsonl")
        else:
            storage.rename(f"{BEGUN}/{name}.jsonl", f"{STALE}/{name}.jsonl")


def finish(storage: Storage, table: Table, transforms: bool) -> None:
    """Write the missing tables of a finished batch, and remove files that no job uses.

    table : format of the table of drawn jobs, jobs.jsonl (one record per line) or jobs.parquet.
        Failed jobs are always in failed.jsonl
    transforms : whether to write transforms.json
    """
    table_name = f"jobs.{table}"
    if storage.has(table_name) and (storage.has("transforms.json") or not transforms):
        return
    with storage.temporary() as drawn, storage.temporary() as failed:
        with storage.scratch(), drawn.open("w") as good, failed.open("w") as bad:
            for name in sorted(record_names(storage)):
                for record in records_of(storage, name):
                    (bad if "error" in record else good).write(json.dumps(record) + "\n")
        _drop_stale(storage, drawn)
        for name in storage.names(BEGUN):  # a finished chunk's list remains if its run was killed
            storage.drop(f"{BEGUN}/{name}")
        if failed.stat().st_size:
            storage.move(failed, FAILED)
        if transforms:
            _put(storage, "transforms.json", _write_transforms, drawn)
        if table == "jsonl":
            storage.move(drawn, table_name)
        else:
            from facerender.batch.formats import write_parquet

            _put(storage, table_name, write_parquet, drawn)


def _put(storage: Storage, name: str, write: Callable[[Path, Path], None], drawn: Path) -> None:
    """Write a file atomically with a function that converts the records of the drawn jobs."""
    with storage.temporary() as file:
        with storage.scratch():
            write(drawn, file)
        storage.move(file, name)


def failures(storage: Storage) -> Iterator[Record]:
    """Yield the records of the failed jobs of a finished batch, from the first 16 MiB of FAILED."""
    if storage.has(FAILED):
        lines = storage.get(FAILED, 1 << 24).splitlines(keepends=True)
        yield from (json.loads(line) for line in lines if line.endswith(b"\n"))


def _records(lines: Path) -> Iterator[Record]:
    with lines.open() as file:
        yield from map(json.loads, file)


def _drop_stale(storage: Storage, drawn: Path) -> None:
    """Remove stale records, and each of their files that no current record lists."""
    if not (stale := storage.names(STALE)):
        return
    named = array("q")  # hashes of paths: 8 bytes each
    for record in _records(drawn):
        named.extend(hash(about["path"]) for about in record["files"].values())
    current = np.sort(np.asarray(named))
    for name in stale:
        for record in records_of(storage, name.removesuffix(".jsonl"), STALE):
            for path in {about["path"] for about in record.get("files", {}).values()}:
                index = np.searchsorted(current, hash(path))
                if index == len(current) or current[index] != hash(path):
                    storage.drop(path)
                    storage.prune(path)
        storage.drop(f"{STALE}/{name}")


def _write_transforms(drawn: Path, target: Path) -> None:
    """Write all cameras to a file in the format of nerfstudio and instant-ngp."""
    with target.open("w") as file:
        file.write('{"camera_model": "OPENCV", "frames": [')
        for number, record in enumerate(_records(drawn)):
            name, about = next(iter(record["files"].items()))
            # Readers cannot open a member of a tar: its name is the path after unpacking.
            image = f"{record['id']}.{name}" if about["path"].endswith(".tar") else about["path"]
            frame = json.dumps(transforms_frame(record["camera"], image))
            file.write(f"{',' * (number > 0)}\n{frame}")
        file.write("\n]}\n")
