"""Finds the remaining work of a batch: compares its chunks with the records of earlier runs."""

from __future__ import annotations

import pickle
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import IO

import numpy as np

from facerender.batch.chunk import Chunk, Record, Settings, chunks, forget_files
from facerender.batch.jobs import Row
from facerender.batch.records import BEGUN, RECORDS, STALE, read_head, record_names, records_of
from facerender.batch.storage import Storage, temporary_folder
from facerender.errors import InputError
from facerender.system.atomic import reported

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
