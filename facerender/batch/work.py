"""What is left of a batch to do: its chunks against the records that are there."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from facerender.batch.chunk import (
    Chunk,
    Record,
    Settings,
    chunk_size,
    chunks,
    forget_files,
    hash_of,
)
from facerender.batch.jobs import Row
from facerender.batch.output import BEGUN, STALE, read_head, record_names, records_of
from facerender.batch.place import Place
from facerender.errors import InputError


@dataclass(frozen=True)
class Work:
    """What a batch has to do.

    Attributes
    ----------
    size : jobs of a chunk
    jobs, left : how many there are, and how many of them in chunks without a record
    todo : names of those chunks by their numbers
    stale : names of chunks that were drawn or begun, and are no longer asked for as they were
    """

    size: int
    jobs: int
    left: int
    todo: Mapping[int, str]
    stale: frozenset[str]


def work_of(
    rows: Iterable[Row], total: int, settings: Settings, size: int | None, retry_failed: bool
) -> Work:
    """Compare the jobs with the records that are there.

    Parameters
    ----------
    rows, total : the jobs, and how many there are
    size : of a chunk; None for what suits the number of jobs
    retry_failed : whether chunks with failed jobs have to be drawn again
    """
    forget_files()
    place = Place(settings.output)
    size = size or chunk_size(total)
    found = record_names(place)
    todo, left, current = dict[int, str](), 0, set[str]()
    for chunk in chunks(_with_keys(rows, settings), size):
        current.add(chunk.name)
        done = chunk.name in found
        if not done or (retry_failed and read_head(place, chunk.name).failed):
            todo[chunk.number] = chunk.name
            left += len(chunk.rows)
    known = found | record_names(place, BEGUN)
    return Work(size, total, left, todo, frozenset(known - current))


def _with_keys(rows: Iterable[Row], settings: Settings) -> Iterator[Row]:
    """Rows whose ids can name what a layout holds."""
    for row in rows:
        if settings.layout == "shards" and "." in row.id:
            raise InputError(
                f"id {row.id!r}: readers of shards end a name at its first dot; give an id without "
                "one, or --layout files"
            )
        yield row


def with_kept(source: Iterable[Chunk], place: Place) -> Iterator[Chunk]:
    """Chunks with the records of those of their jobs that are drawn: of stale records, or of their
    own that has failed jobs besides."""
    known = _Known(place)
    names = record_names(place)
    for chunk in source:
        own = records_of(place, chunk.name) if chunk.name in names else ()
        drawn = {record["key"]: record for record in own if "error" not in record}
        kept = {}
        for position, key in enumerate(chunk.keys):
            if (record := drawn.get(key) or known.find(key)) is not None:
                kept[position] = record
        yield replace(chunk, kept=kept)


class _Known:
    """Stale records of drawn jobs by key, of which few are in memory: 16 bytes for each."""

    def __init__(self, place: Place) -> None:
        self._names = sorted(record_names(place, STALE))
        hashes, places = array("Q"), array("L")
        for number, name in enumerate(self._names):
            for record in records_of(place, name, STALE):
                if "error" not in record:
                    hashes.append(hash_of(record["key"]))
                    places.append(number)
        order = np.argsort(np.asarray(hashes), kind="stable")
        self._hashes, self._places = np.asarray(hashes)[order], np.asarray(places)[order]
        self._read = lru_cache(4)(
            lambda name: {each["key"]: each for each in records_of(place, name, STALE)}
        )

    def find(self, key: str) -> Record | None:
        wanted = np.uint64(hash_of(key))
        first, last = (np.searchsorted(self._hashes, wanted, side) for side in ("left", "right"))
        for number in self._places[first:last]:
            record: Record | None = self._read(self._names[number]).get(key)
            if record is not None and "error" not in record:
                return record
        return None
