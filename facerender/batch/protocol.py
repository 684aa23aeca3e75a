"""Messages between a supervisor and its worker, the process that draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facerender.batch.chunk import Chunk, Record, Settings


@dataclass(frozen=True)
class Order:
    """The jobs of a chunk that a worker draws.

    Attributes
    ----------
    left : their positions in the chunk
    tar, size : see :class:`facerender.batch.records.Writer`
    """

    settings: Settings
    chunk: Chunk
    left: tuple[int, ...]
    tar: Path | None
    size: int


@dataclass(frozen=True)
class Message:
    """A step of a worker: it loads a job's mesh, draws the job, is done with it, keeps the files of
    an earlier run, or failed; it cannot draw any job; it is at the end of the chunk. "starts" is
    the supervisor's own.

    Attributes
    ----------
    position : of the job in the chunk
    record : of a job that is done, kept or failed
    size : bytes of the tar so far
    text : why nothing can be drawn
    """

    step: Literal["starts", "loads", "draws", "done", "kept", "failed", "cannot", "end"]
    position: int = -1
    record: Record | None = None
    size: int = 0
    text: str = ""


def failure(chunk: Chunk, position: int, kind: str, text: str) -> Record:
    """Return the record of a job that failed."""
    row = chunk.rows[position]
    job = {"id": row.id, "number": row.number, "key": chunk.keys[position]}
    return {**job, "error": text, "kind": kind, "job": row.tables}
