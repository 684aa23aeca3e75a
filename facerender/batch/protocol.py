"""Messages between a supervisor and its worker process, which draws the jobs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facerender.batch.chunk import Chunk, Record, Settings
from facerender.batch.jobs import Row

NO_MEMORY = 9  # Exit status of a worker: out of memory.


@dataclass(frozen=True)
class Order:
    """A request to draw the remaining jobs of a chunk."""

    settings: Settings
    chunk: Chunk
    left: tuple[int, ...]  # Indices of the remaining jobs in the chunk.
    tar: Path | None  # See :class:`facerender.batch.records.Writer`.
    size: int


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
