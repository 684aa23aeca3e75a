"""Read untrusted files safely: only regular files, and only up to a maximum size."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from facerender.errors import InputError, clipped, reason

MOST = 1 << 30  # default size limit of a file in bytes
# Matches a dotted TOML key with more parts than any key of a valid table. It is refused because the
# parser's time and memory grow quadratically with the number of parts.
_DEEP_KEY = re.compile(
    r"""(?<![\w"'.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}"""
)
# First bytes, in lower case, of a PNG image whose line ends or encoding were converted.
_MANGLED = (b"\x89png\n", b"\x89png\r\r\n", b"\x89png\r\n\x1a\r\n", b"\xef\xbf\xbdpng")
# First bytes, in lower case, of a placeholder instead of the content, or of a damaged PNG image:
# bytes, kind, remedy.
_NOT_DOWNLOADED = (
    (b"version https://git-lfs", "a Git LFS pointer", "fetch it with git lfs pull"),
    (b"<!doctype html", "an HTML page", "download the file itself"),
    (b"<html", "an HTML page", "download the file itself"),
    *(
        (start, "a PNG image that was converted as text", "transfer it again as binary data")
        for start in _MANGLED
    ),
)
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def check_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> None:
    """Raise InputError unless a path is the name of a regular file. Other files are refused: a pipe
    may block, and a device may never end.

    Parameters
    ----------
    what : description of the expected file for messages, such as "an image file"
    most : maximum size in bytes
    """
    shown = clipped(os.fsdecode(path))
    if not shown:
        raise InputError(f"the name of a file is empty; give {what}")
    try:
        facts = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: an invalid file name
        raise InputError(f"cannot read {shown}: {reason(error)}; give {what}") from None
    if not stat.S_ISREG(facts.st_mode):
        kind = _KINDS.get(stat.S_IFMT(facts.st_mode), "not a regular file")
        raise InputError(f"{shown} is {kind}; give {what}")
    if facts.st_size > most:
        raise InputError(f"{shown} has {facts.st_size} bytes, but the limit is {most}; give {what}")


def suffix_of(
    path: str | os.PathLike[str], known: Sequence[str], kind: str, what: str, most: int = MOST
) -> str:
    """Return the suffix of a file, in lower case.

    Parameters
    ----------
    kind : kind of the file for messages, such as "image"
    what, most : see :func:`check_file`, which also lists the errors

    Raises
    ------
    InputError : the suffix is unknown
    """
    name = clipped(os.fsdecode(path))
    beside = [
        f"{name}{suffix}" for suffix in known if os.path.isfile(f"{os.fsdecode(path)}{suffix}")
    ]
    check_file(path, beside[0] if beside else what, most)
    return check_suffix(path, known, kind)


def check_suffix(path: str | os.PathLike[str], known: Sequence[str], kind: str) -> str:
    """Return the suffix of a path, which need not exist, in lower case; see :func:`suffix_of`."""
    name, suffix = clipped(os.fsdecode(path)), Path(path).suffix.lower()
    formats = " or ".join(filter(None, [", ".join(known[:-1]), known[-1]]))
    if not suffix:
        raise InputError(f"{name} has no suffix, which sets the {kind} format; give {formats}")
    if suffix not in known:
        raise InputError(f"{name}: unknown {kind} format {clipped(suffix, 40)!r}; give {formats}")
    return suffix


@contextmanager
def open_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> Iterator[BinaryIO]:
    """Open a regular file.

    Raises
    ------
    InputError : reading the file fails; parameters and other errors as in :func:`check_file`
    """
    check_file(path, what, most)
    try:
        with Path(path).open("rb") as file:
            yield file
    except InputError:
        raise
    except (OSError, ValueError) as error:
        shown = clipped(os.fsdecode(path))
        raise InputError(f"cannot read {shown}: {reason(error)}; give {what}") from None


def read_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> bytes:
    """Return the content of a regular file; parameters and errors as in :func:`open_file`."""
    with open_file(path, what, most) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def digest_of(*pieces: str | bytes | memoryview) -> str:
    """Return a digest of pieces and of their lengths, as 32 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=16)
    for piece in pieces:
        content = memoryview(piece.encode() if isinstance(piece, str) else piece).cast("B")
        digest.update(content.nbytes.to_bytes(8, "little"))
        digest.update(content)
    return digest.hexdigest()


def check_downloaded(content: bytes, subject: str) -> None:
    """Raise InputError for a Git LFS pointer, an HTML page, or a PNG image converted as text.

    subject : start of the message, such as "a.png is" or "head.glb is not glTF but"
    """
    start = content[:64].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for beginning, kind, remedy in _NOT_DOWNLOADED:
        if start.startswith(beginning):
            raise InputError(f"{subject} {kind}; {remedy}")


def tables_of(content: bytes, name: str) -> dict[str, Any]:
    """Return the tables of a TOML file, with or without a byte order mark.

    Raises
    ------
    InputError : the file is not TOML, is nested too deep, or has an integer of thousands of digits
    """
    import tomllib

    try:
        text = content.decode("utf-8-sig")
        if _DEEP_KEY.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except RecursionError:
        why = "nested too deep"
    except ValueError as error:  # also an integer with more digits than Python parses
        why = reason(error)
    raise InputError(f"{name} is not valid TOML: {why}; correct it")
