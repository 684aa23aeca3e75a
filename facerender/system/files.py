"""Files that others made, opened with care: only regular ones, of a size that was declared."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from facerender.errors import InputError, clipped, reason

MOST = 1 << 30  # bytes
# More names than any table has above each other: the parser's time and memory grow with the square.
_DEEP_KEY = re.compile(
    r"""(?<![\w"'.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}"""
)
# What a file may hold in place of its content: how it begins in lower case, kind and remedy.
_NOT_DOWNLOADED = (
    (b"version https://git-lfs", "a Git LFS pointer", "fetch it with git lfs pull"),
    (b"<!doctype html", "an HTML page", "download the file itself"),
    (b"<html", "an HTML page", "download the file itself"),
)
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def open_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> Iterator[BinaryIO]:
    """Open a regular file; nothing else is opened, for a pipe may never begin and a device never
    end.

    Parameters
    ----------
    what : that should be given in its place, for the message: "an image file"
    most : bytes that it may have

    Raises
    ------
    InputError : it is missing, may not be read, is no regular file, or is larger; also what reading
        it raises
    """
    shown = clipped(os.fsdecode(path))
    try:
        facts = os.stat(path)
        if not stat.S_ISREG(facts.st_mode):
            kind = _KINDS.get(stat.S_IFMT(facts.st_mode), "no regular file")
            raise InputError(f"{shown} is {kind}; give {what}")
        if facts.st_size > most:
            raise InputError(f"{shown} has {facts.st_size} bytes, of {most} at most; give {what}")
        with Path(path).open("rb") as file:
            yield file
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"cannot read {shown}: {reason(error)}; give {what}") from None


def read_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> bytes:
    """Return the content of a regular file; parameters and errors as of :func:`open_file`."""
    with open_file(path, what, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def digest_of(*pieces: str | bytes | memoryview) -> str:
    """Return a digest of pieces, as 32 hexadecimal digits; their lengths count."""
    whole = hashlib.blake2b(digest_size=16)
    for piece in pieces:
        content = memoryview(piece.encode() if isinstance(piece, str) else piece).cast("B")
        whole.update(content.nbytes.to_bytes(8, "little"))
        whole.update(content)
    return whole.hexdigest()


def check_downloaded(content: bytes, subject: str) -> None:
    """Raise InputError where a Git LFS pointer or an HTML page lies in place of a file's content.

    subject : begins the message: "a.png is", "head.glb is not glTF but"
    """
    start = content[:64].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for beginning, kind, remedy in _NOT_DOWNLOADED:
        if start.startswith(beginning):
            raise InputError(f"{subject} {kind}; {remedy}")


def tables_of(content: bytes, name: str) -> dict[str, Any]:
    """Return the tables of a TOML file, with a byte order mark or without.

    Raises
    ------
    InputError : it is none, is nested too deep, or has a number of thousands of digits
    """
    import tomllib

    try:
        text = content.decode("utf-8-sig")
        if _DEEP_KEY.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except RecursionError:
        why = "nested too deep"
    except ValueError as error:  # Python reads no numbers of 5000 digits
        why = reason(error)
    raise InputError(f"{name} is not TOML: {why}; mend it")
