"""What stands in a batch's folder beside data and records: what was asked for, the table of all
jobs, what failed, cameras for readers of radiance fields. And what it tells of itself."""

from __future__ import annotations

import fcntl
import json
from array import array
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerender._version import __version__
from facerender.batch.chunk import Record, Settings
from facerender.batch.output import (
    ABOUT,
    BEGUN,
    RECORDS,
    STALE,
    read_head,
    record_names,
    records_of,
)
from facerender.batch.passes import transforms_frame
from facerender.batch.place import Place
from facerender.batch.work import Work
from facerender.errors import InputError, reason
from facerender.system.signals import if_ended

TABLES = ("jobs.jsonl", "jobs.parquet", "failed.jsonl", "transforms.json")
Table = Literal["jsonl", "parquet"]


@dataclass(frozen=True)
class Status:
    """What became of a batch so far: jobs asked for, drawn, failed; and what was asked for."""

    jobs: int
    done: int
    failed: int
    about: Mapping[str, Any]


@contextmanager
def driving(settings: Settings, about: Mapping[str, Any]) -> Iterator[Place]:
    """Write down what is asked for, and keep other drivers away; in an object store nothing does.

    Raises
    ------
    InputError : another driver writes there, or nothing can be written
    """
    place = Place(settings.output)
    with ExitStack() as held:
        try:
            if not place.remote:
                Path(place.root).mkdir(parents=True, exist_ok=True)
                lock = held.enter_context(Path(place.root, ".lock").open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                place.sweep()
                held.callback(place.sweep)
                held.enter_context(if_ended(place.sweep))
            tell(place, settings, about)
        except BlockingIOError:
            raise InputError(
                f"another batch is being written to {place.root}: wait for it, or give another "
                "folder"
            ) from None
        except OSError as error:
            raise InputError(f"cannot write to {place.root}: {reason(error)}") from None
        yield place


def tell(place: Place, settings: Settings, about: Mapping[str, Any]) -> None:
    """Write down what is asked for."""
    facts = {"facerender": __version__, "layout": settings.layout, "run": settings.run, **about}
    place.put(ABOUT, json.dumps(facts, indent=2).encode() + b"\n")


def status(output: str) -> Status:
    """Read what became of a batch.

    Raises
    ------
    InputError : there is none
    """
    place = Place(output)
    try:
        about = json.loads(place.get(ABOUT))
        heads = [read_head(place, name) for name in record_names(place)]
        jobs = int(about["jobs"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{output} holds no batch ({ABOUT}: {error!r}); give its folder") from None
    return Status(jobs, sum(h.done for h in heads), sum(h.failed for h in heads), about)


def set_aside(place: Place, work: Work) -> None:
    """Remove tables that will be others, and then move records of jobs that are no longer asked for
    as they were out of the way."""
    for name in TABLES if work.todo or work.stale else ():
        place.drop(name)
    for name in work.stale & record_names(place):
        place.rename(f"{RECORDS}/{name}.jsonl", f"{STALE}/{name}.jsonl")
    known = record_names(place, STALE)
    for name in work.stale & record_names(place, BEGUN):
        if name in known:  # and tells more
            place.drop(f"{BEGUN}/{name}.jsonl")
        else:
            place.rename(f"{BEGUN}/{name}.jsonl", f"{STALE}/{name}.jsonl")


def finish(place: Place, table: Table, transforms: bool) -> None:
    """Write the tables of a batch that is done, where they are not there, and remove what no job of
    it names.

    Parameters
    ----------
    table : of the jobs that were drawn: jobs.jsonl, a record a line, or jobs.parquet; those that
        failed are in failed.jsonl
    transforms : whether transforms.json is written too
    """
    wanted = f"jobs.{table}"
    if place.has(wanted) and (place.has("transforms.json") or not transforms):
        return
    drawn, failed = place.unfinished(), place.unfinished()
    with drawn.open("w") as good, failed.open("w") as bad:
        for name in sorted(record_names(place)):
            for record in records_of(place, name):
                (bad if "error" in record else good).write(json.dumps(record) + "\n")
    _drop_stale(place, drawn)
    for name in place.names(BEGUN):  # cut off behind its record
        place.drop(f"{BEGUN}/{name}")
    if failed.stat().st_size:
        place.move(failed, "failed.jsonl")
    else:
        failed.unlink()
    if transforms:
        place.move(_transforms(place, drawn), "transforms.json")
    if table == "parquet":
        from facerender.batch.parquet import write_parquet

        write_parquet(drawn, parquet := place.unfinished())
        drawn.unlink()
        place.move(parquet, wanted)
    else:
        place.move(drawn, wanted)


def _records(lines: Path) -> Iterator[Record]:
    with lines.open() as file:
        yield from map(json.loads, file)


def _drop_stale(place: Place, drawn: Path) -> None:
    """Remove stale records, and the files that they alone name."""
    if not (stale := place.names(STALE)):
        return
    named = array("q")  # hashes of paths: eight bytes each
    for record in _records(drawn):
        named.extend(hash(about["path"]) for about in record["files"].values())
    current = np.sort(np.frombuffer(named, np.int64)) if named else np.empty(0, np.int64)
    for name in stale:
        for record in records_of(place, name.removesuffix(".jsonl"), STALE):
            for path in {about["path"] for about in record.get("files", {}).values()}:
                at = np.searchsorted(current, hash(path))
                if at == len(current) or current[at] != hash(path):
                    place.drop(path)
                    place.prune(path)
        place.drop(f"{STALE}/{name}")


def _transforms(place: Place, drawn: Path) -> Path:
    """Cameras of all jobs, as nerfstudio and instant-ngp read them."""
    target = place.unfinished()
    with target.open("w") as file:
        file.write('{"camera_model": "OPENCV", "frames": [')
        for number, record in enumerate(_records(drawn)):
            image = next(about["path"] for about in record["files"].values())
            frame = json.dumps(transforms_frame(record["camera"], image))
            file.write(f"{',' * (number > 0)}\n{frame}")
        file.write("\n]}\n")
    return target
