"""What a supervisor and the process that draws tell each other."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facerender.batch.chunk import Chunk, Record, Settings
from facerender.batch.groups import Group


@dataclass(frozen=True)
class Order:
    """What a worker is to draw of a chunk.

    Attributes
    ----------
    left : positions of the jobs that are left
    tar, size : see :class:`Writer`
    """

    settings: Settings
    chunk: Chunk
    left: tuple[int, ...]
    tar: Path | None
    size: int


@dataclass(frozen=True)
class PlanOrder:
    """What a worker is to plan."""

    settings: Settings
    group: Group


@dataclass(frozen=True)
class Said:
    """What a worker says of a job: that it loads its mesh, that it draws it, and when it is done,
    kept or failed its record, and how long the tar is now; or that no job can be drawn here, or
    that the chunk is at its end. That it starts is what its supervisor says. Of a plan, what is
    known so far is its record."""

    what: Literal["starts", "loads", "draws", "plans", "done", "kept", "failed", "cannot", "end"]
    position: int = -1
    record: Record | None = None
    size: int = 0
    text: str = ""


def failure(chunk: Chunk, position: int, kind: str, text: str) -> Record:
    """The record of a job that failed."""
    row = chunk.rows[position]
    job = {"id": row.id, "number": row.number, "key": chunk.keys[position]}
    return {**job, "error": text, "kind": kind, "job": row.tables}
