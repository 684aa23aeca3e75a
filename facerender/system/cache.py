"""The cache on disk, in $XDG_CACHE_HOME/facerender or ~/.cache/facerender. The name of a
cache entry is a digest of its inputs. An entry is written completely or not at all. Without
access to the folder, nothing is cached. The least recently used entries are removed when the cache
exceeds $FACERENDER_CACHE_MIB."""

from __future__ import annotations

import mmap
import os
import struct
import time
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from facerender.errors import InputError
from facerender.system.files import ABANDONED, open_file, write_whole

_LIMIT = "FACERENDER_CACHE_MIB"
_HEAD = struct.Struct("<12sI")  # magic, CRC-32 of the content
_MAGIC = b"facerender 1"
_START = 64  # offset of the content in bytes, so that arrays in the content are aligned


def folder() -> Path:
    """Return the folder of the cache. The folder may not exist."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return Path(base if os.path.isabs(base) else os.path.expanduser("~/.cache"), "facerender")


def limit() -> int:
    """Return the largest size of the cache in bytes, from FACERENDER_CACHE_MIB."""
    text = os.environ.get(_LIMIT) or "1024"
    if not text.isdecimal():
        raise InputError(f"{_LIMIT} = {text!r}: give a whole number of MiB; 0 disables the cache")
    return int(text) << 20


def size() -> int:
    """Return the size of the cache in bytes."""
    return sum(count for _, count, _ in _entries())


def read(group: str, name: str) -> memoryview | None:
    """Return the content of a cache entry, mapped copy-on-write from its file. Return None if the
    entry is missing or damaged, or the cache is disabled."""
    if not limit():
        return None
    path = folder() / group / name
    try:
        with open_file(path, "an entry") as file:
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
    except (InputError, OSError, ValueError):  # an empty file cannot be mapped
        return None
    with suppress(OSError):  # the file belongs to another user
        os.utime(path)  # mark the entry as recently used
    content = data[_START:]
    intact = len(data) >= _START and _HEAD.unpack_from(data) == (_MAGIC, zlib.crc32(content))
    return content if intact else None


def write(group: str, name: str, pieces: Sequence[bytes | memoryview]) -> None:
    """Write a cache entry that consists of consecutive pieces, and remove the least recently used
    entries beyond the limit and abandoned files. An entry larger than the limit is not written."""
    if _START + sum(memoryview(piece).nbytes for piece in pieces) > limit():
        return
    checksum = 0
    for piece in pieces:
        checksum = zlib.crc32(piece, checksum)
    head = _HEAD.pack(_MAGIC, checksum).ljust(_START, b"\0")

    def write_pieces(temporary: str) -> None:
        with open(temporary, "wb") as file:
            file.writelines([head, *pieces])

    path = folder() / group / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder().chmod(0o700)  # other users must not read scans of patients
        write_whole(path, write_pieces)
    except (OSError, InputError):
        return
    total = 0
    for used, count, entry in sorted(_entries(), reverse=True):
        total += count
        abandoned = entry.name.startswith(".") and used < time.time() - ABANDONED
        if (total > limit() or abandoned) and entry != path:
            with suppress(OSError):
                entry.unlink()


def _entries() -> list[tuple[float, int, Path]]:
    """Return the time of last use, size and path of each cache entry."""
    entries = []
    for path in folder().glob("*/*"):
        with suppress(OSError):  # another process removed the entry
            status = path.stat()
            entries.append((status.st_mtime, status.st_size, path))
    return entries
