"""Files that only save time: entries by the digest of what they depend on, in
$XDG_CACHE_HOME/facerender or ~/.cache/facerender. An entry is there whole or not at all; a place
that cannot be read or written is passed over. The least recently used go when all together take
more than $FACERENDER_CACHE_MIB."""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from facerender.errors import InputError
from facerender.system.atomic import ABANDONED, write_whole
from facerender.system.files import open_file

_LIMIT = "FACERENDER_CACHE_MIB"
_DEFAULT_LIMIT = 1024
_HEAD = struct.Struct("<12sI")  # magic, CRC-32 of the content
_MAGIC = b"facerender 1"
_START = 64  # of the content: what is aligned in it is aligned in memory


def folder() -> Path:
    """Return where the entries lie; it need not be there."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    home = os.path.expanduser("~/.cache")
    return Path(base if os.path.isabs(base) else home, "facerender")


def limit() -> int:
    """Return how many bytes all entries may take together.

    Raises
    ------
    InputError : FACERENDER_CACHE_MIB is no number from 0 on
    """
    text = os.environ.get(_LIMIT) or str(_DEFAULT_LIMIT)
    if not text.isdecimal():
        raise InputError(f"{_LIMIT} = {text!r}: give a whole number of MiB; 0 keeps nothing")
    return int(text) << 20


def size() -> int:
    """Return how many bytes the entries take."""
    return sum(count for _, count, _ in _entries())


def read(kind: str, name: str) -> memoryview | None:
    """Return the content of an entry, or None if it is absent or damaged, or nothing is kept.

    Raises
    ------
    InputError : as of :func:`limit`
    """
    if not limit():
        return None
    path = folder() / kind / name
    try:
        with open_file(path, "an entry") as file:
            data = np.fromfile(file, dtype=np.uint8).data  # not set to 0 first, as a bytearray is
    except InputError:
        return None
    with suppress(OSError):  # another user's
        os.utime(path)  # it was used now
    if len(data) < _START:
        return None
    content = data[_START:]
    whole = _HEAD.unpack_from(data) == (_MAGIC, zlib.crc32(content))
    return content if whole else None


def write(kind: str, name: str, pieces: Sequence[bytes | memoryview]) -> None:
    """Keep an entry, of pieces one after the other, and let go what is too much.

    Raises
    ------
    InputError : as of :func:`limit`
    """
    if _START + sum(memoryview(piece).nbytes for piece in pieces) > limit():
        return
    checksum = 0
    for piece in pieces:
        checksum = zlib.crc32(piece, checksum)
    head = _HEAD.pack(_MAGIC, checksum).ljust(_START, b"\0")

    def write_pieces(temporary: str) -> None:
        with open(temporary, "wb") as file:
            file.write(head)
            file.writelines(pieces)

    path = folder() / kind / name
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, write_pieces)
    except (OSError, InputError):
        return
    _let_go(path)


def _entries() -> list[tuple[float, int, Path]]:
    """When each was used last, its bytes, its path."""
    found = []
    for path in folder().glob("*/*"):
        try:
            facts = path.stat()
        except OSError:  # another process has removed it
            continue
        found.append((facts.st_mtime, facts.st_size, path))
    return found


def _let_go(newest: Path) -> None:
    """Remove the least recently used entries beyond the limit, and what writers that were cut off
    have left."""
    total = 0
    for used, count, path in sorted(_entries(), reverse=True):
        total += count
        abandoned = path.name.startswith(".") and used < time.time() - ABANDONED
        if (total > limit() or abandoned) and path != newest:
            with suppress(OSError):
                path.unlink()
