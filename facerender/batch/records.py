"""Files of a chunk: the outputs of its jobs as separate files or one tar, and the chunk's record.

The record is written last: its presence marks a finished chunk.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from io import BytesIO
from pathlib import Path

from facerender.batch.chunk import Chunk, Record, Settings
from facerender.batch.jobs import Row, file_name
from facerender.batch.storage import Storage
from facerender.system.atomic import CannotUse

ABOUT = "batch.json"  # Settings of the batch, and the ID of the last run.
BEGUN = "begun"  # Folder: for each unfinished chunk, a list of its files.
RECORDS = "records"
STALE = "stale"  # Folder: records of chunks whose jobs have changed.
_BLOCK = 512  # Bytes per tar block.


class Writer:
    """Writer of a chunk's output files, in the order of its jobs: separate files or one tar.

    ``tar``: the unfinished tar with layout "shards"; None with layout "files"; ``size``: number of
    valid bytes in the tar; the constructor cuts off the rest.
    """

    def __init__(self, settings: Settings, chunk: Chunk, tar: Path | None, size: int) -> None:
        self.storage, self.chunk, self._run = Storage(settings.output), chunk, settings.run
        self.size, self._tar = size, tar
        self._get = lru_cache(1)(self.storage.get)  # Consecutive jobs mostly share a tar.
        if tar is not None:
            with self.storage.scratch(), tar.open("r+b" if size else "wb") as file:
                file.truncate(size)

    def write(self, position: int, files: Mapping[str, bytes], facts: Record) -> Record:
        """Write the files of a job and return the job's record; errors as in Storage."""
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
        record = self._record(position, facts, written)
        if self._tar is not None:
            members = {f"{row.id}.{name}": content for name, content in files.items()}
            members[f"{row.id}.json"] = json.dumps(record).encode()
            with self.storage.scratch():
                self.size = _append(self._tar, itertools.starmap(_member, members.items()))
        return record

    def keep(self, position: int) -> Record | None:
        """Reuse the files of a job that an earlier run drew, and return the new record.

        Return None if no earlier run drew the job, or if its files have changed.
        """
        if (record := self.chunk.kept.get(position)) is None:
            return None
        try:
            files = _read_files(self._get, record)
        except (OSError, CannotUse, KeyError, tarfile.TarError):
            return None
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
        if digests != {name: about["sha256"] for name, about in record["files"].items()}:
            return None  # Another run has overwritten the files.
        facts = {key: record[key] for key in record if key not in ("id", "number", "key", "files")}
        if self._tar is None:
            return self._record(position, facts, record["files"])
        return self.write(position, files, facts)

    def _record(self, position: int, facts: Record, files: Record) -> Record:
        row = self.chunk.rows[position]
        about = {"id": row.id, "number": row.number, "key": self.chunk.keys[position]}
        return {**about, **facts, "files": files}


def _check_run(storage: Storage, run: str) -> None:
    """Raise CannotUse if another run of the batch has started."""
    try:
        about = json.loads(storage.get(ABOUT))
    except FileNotFoundError:  # batch.json exists only if a coordinator runs the batch.
        return
    if about["run"] != run:
        raise CannotUse(
            f"another run of the batch has started in {storage.root}: wait for it, or give another "
            "folder"
        )


def begin(settings: Settings, chunk: Chunk) -> None:
    """Write a list of the files that a chunk will have.

    If the chunk is interrupted and its jobs change, a later run removes the listed files.

    Raises
    ------
    CannotUse : the list cannot be written, or another run has started
    """
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    named: list[Record] = []
    for row in chunk.rows:
        names = map(file_name, row.outputs)
        files = {n: {"path": _path(chunk, row, n, settings.layout == "shards")} for n in names}
        named.append({"id": row.id, "key": "", "files": files})
    _put_records(storage, f"{BEGUN}/{chunk.name}.jsonl", chunk, named, 0)


def commit(settings: Settings, chunk: Chunk, tar: Path | None, records: Sequence[Record]) -> None:
    """Finish the tar of a chunk, then write the chunk's record, which marks the chunk as done.
    A chunk without drawn jobs has no tar.

    The first line of the record counts the drawn and failed jobs; each further line describes one
    job. Raises CannotUse if a file cannot be written, or another run has started.
    """
    storage = Storage(settings.output)
    _check_run(storage, settings.run)
    done = sum("error" not in record for record in records)
    if tar is not None and done:
        with storage.scratch():
            _append(tar, [bytes(2 * _BLOCK)])
        storage.move(tar, f"shards/{chunk.name}.tar")
    _put_records(
        storage, f"{RECORDS}/{chunk.name}.jsonl", chunk, records, done, len(records) - done
    )
    storage.drop(f"{BEGUN}/{chunk.name}.jsonl")


def _put_records(
    storage: Storage, name: str, chunk: Chunk, records: Sequence[Record], done: int, failed: int = 0
) -> None:
    head = {"chunk": chunk.number, "done": done, "failed": failed}
    lines = "".join(json.dumps(entry) + "\n" for entry in (head, *records))
    storage.put(name, lines.encode())


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
    """Append to an existing tar and return the new size of the tar.

    This function never creates a tar: if another coordinator has removed the tar, a new one would
    lack the earlier members.
    """
    with tar.open("r+b") as file:
        file.seek(0, os.SEEK_END)
        file.writelines(pieces)
        return file.tell()


def _member(name: str, content: bytes) -> bytes:
    entry = tarfile.TarInfo(name)  # Default owner, mode and time: equal jobs give equal bytes.
    entry.size = len(content)
    return entry.tobuf(tarfile.GNU_FORMAT) + content + bytes(-len(content) % _BLOCK)


def read_head(storage: Storage, name: str) -> dict[str, int]:
    """Return the first line of a chunk's record: "chunk", "done" and "failed"."""
    head = storage.get(f"{RECORDS}/{name}.jsonl", 200).partition(b"\n")[0]
    return dict(json.loads(head))


def records_of(storage: Storage, name: str, folder: str = RECORDS) -> Iterator[Record]:
    """Yield the records of a chunk's drawn and failed jobs."""
    for line in storage.get(f"{folder}/{name}.jsonl").splitlines()[1:]:
        yield json.loads(line)


def record_names(storage: Storage, folder: str = RECORDS) -> set[str]:
    """Return the names of the chunks that have a record."""
    return {n.removesuffix(".jsonl") for n in storage.names(folder) if n.endswith(".jsonl")}
