"""Finds the remaining work of a batch: compares its chunks with the records of earlier runs."""

from __future__ import annotations

import pickle
import tempfile
from array import array
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import IO

import numpy as np

from facerender.batch.chunk import Chunk, Record, Settings, chunks, forget_files
from facerender.batch.jobs import Row
from facerender.batch.records import (
    BEGUN,
    RECORDS,
    STALE,
    read_head,
    record_names,
    records_of,
)
from facerender.batch.storage import Storage, temporary_folder
from facerender.errors import InputError
from facerender.system.atomic import reported

_IN_MEMORY = 1 << 20  # maximum bytes of a temporary file in memory; a larger file is on disk


class Spool:
    """The chunks of a batch in a temporary file.

    The table of jobs is therefore read only once, with few rows in memory at a time.

    Attributes
    ----------
    names : names of all chunks, in order
    ids : hashes of the ids of all jobs, 8 bytes each
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.ids = file, array("q")
        self._of: dict[str, tuple[int, int]] = {}  # keyed by chunk name: number of jobs, offset

    def add(self, chunk: Chunk) -> None:
        """Append a chunk to the temporary file."""
        self._of[chunk.name] = len(chunk.rows), self._file.tell()
        self.ids.extend(hash(row.id) for row in chunk.rows)
        pickle.dump(chunk, self._file, protocol=pickle.HIGHEST_PROTOCOL)

    @property
    def names(self) -> Iterable[str]:
        return self._of.keys()

    def jobs(self, names: Iterable[str]) -> int:
        """Return the number of jobs of the named chunks."""
        return sum(self._of[name][0] for name in names)

    def chunks(self, names: Iterable[str]) -> Iterator[Chunk]:
        """Read the named chunks."""
        for name in names:
            self._file.seek(self._of[name][1])
            chunk: Chunk = pickle.load(self._file)
            yield chunk


@contextmanager
def spooled(rows: Iterable[Row], settings: Settings, size: int | None) -> Iterator[Spool]:
    """Read all rows and store them as chunks; `size` as in :func:`chunks`.

    Raises
    ------
    InputError : the temporary file cannot be written; an id contains a dot, which layout "shards"
        does not allow
    """
    forget_files()
    with ExitStack() as stack:
        file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115
        stack.callback(_close, file)
        spool = Spool(file)
        with reported("write", temporary_folder(), "or set TMPDIR to another folder"):
            for chunk in chunks(_with_valid_ids(rows, settings), size, settings.layout):
                spool.add(chunk)
            file.flush()
        yield spool


def _close(file: IO[bytes]) -> None:
    with suppress(OSError):  # on a full disk, the rest of the buffer cannot be written
        file.close()


def _with_valid_ids(rows: Iterable[Row], settings: Settings) -> Iterator[Row]:
    for row in rows:
        if settings.layout == "shards" and "." in row.id:
            raise InputError(
                f"id {row.id!r} contains a dot, at which readers of shards split the name: give "
                "an id without a dot, or use --layout files"
            )
        yield row


@dataclass(frozen=True)
class Work:
    """The remaining work of a batch.

    Attributes
    ----------
    spool : all chunks
    todo : names of the chunks to draw
    jobs : number of jobs in all chunks
    left : number of jobs in the chunks to draw
    stale : names of chunks that an earlier run drew or began and whose jobs have changed since
    """

    spool: Spool
    todo: tuple[str, ...]
    jobs: int
    left: int
    stale: frozenset[str]


def check_removed(spool: Spool, storage: Storage, table: str) -> None:
    """Raise InputError if the table of jobs lacks jobs that an earlier run has drawn."""
    drawn = array("q")
    for folder in (RECORDS, STALE):
        for name in record_names(storage, folder).difference(spool.names):
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
        for name in spool.names
        if name not in finished or (retry_failed and read_head(storage, name)["failed"])
    )
    stale = (finished | record_names(storage, BEGUN)).difference(spool.names)
    return Work(spool, todo, spool.jobs(spool.names), spool.jobs(todo), frozenset(stale))


def with_kept(work: Work, storage: Storage) -> Iterator[Chunk]:
    """Yield the chunks to draw, each with the records of its jobs that are already drawn.

    The records come from stale chunks, or from the same chunk if another of its jobs failed.
    """
    stale_records = _DrawnBefore(storage)
    names = record_names(storage)
    for chunk in work.spool.chunks(work.todo):
        records = records_of(storage, chunk.name) if chunk.name in names else ()
        drawn = {record["key"]: record for record in records if "error" not in record}
        kept_records = {}
        for position, key in enumerate(chunk.keys):
            if (record := drawn.get(key) or stale_records.find(key)) is not None:
                kept_records[position] = record
        yield replace(chunk, kept=kept_records)


class _DrawnBefore:
    """Index of the stale records of drawn jobs, keyed by the job's key; 16 bytes per record."""

    def __init__(self, storage: Storage) -> None:
        self._names = sorted(record_names(storage, STALE))
        hashes, numbers = array("q"), array("L")
        for number, name in enumerate(self._names):
            for record in records_of(storage, name, STALE):
                if "error" not in record:
                    hashes.append(hash(record["key"]))
                    numbers.append(number)
        order = np.argsort(np.asarray(hashes), kind="stable")
        self._hashes, self._numbers = np.asarray(hashes)[order], np.asarray(numbers)[order]
        self._read = lru_cache(4)(
            lambda name: {entry["key"]: entry for entry in records_of(storage, name, STALE)}
        )

    def find(self, key: str) -> Record | None:
        bounds = (np.searchsorted(self._hashes, hash(key), side) for side in ("left", "right"))
        for number in self._numbers[slice(*bounds)]:
            record: Record | None = self._read(self._names[number]).get(key)
            if record is not None and "error" not in record:
                return record
        return None
