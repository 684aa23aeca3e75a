"""The output folder of a batch: lock, batch.json, tables of drawn and failed jobs, cameras, status.

``records.py`` writes the data and the records of chunks.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerender import __version__
from facerender.batch.chunk import Record, Settings
from facerender.batch.outputs import transforms_frame
from facerender.batch.records import (
    ABOUT,
    BEGUN,
    RECORDS,
    STALE,
    read_head,
    record_names,
    records_of,
)
from facerender.batch.storage import Storage
from facerender.batch.work import Work
from facerender.errors import InputError, reason
from facerender.system.signals import if_ended

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
            from facerender.batch.parquet import write_parquet

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
