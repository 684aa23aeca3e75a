"""Read untrusted files safely, and write output files completely or not at all.

Only regular files are read, and only up to a maximum size."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EIO, ENOSPC, EPERM, EROFS
from pathlib import Path
from typing import Any, BinaryIO

from facerender.errors import InputError, clipped, reason
from facerender.system.signals import if_ended

ABANDONED = 3600.0  # age in seconds at which a temporary file counts as abandoned
TEMPORARY = ".facerender-"  # prefix of temporary files
_REMEDIES = {
    **dict.fromkeys((ENOSPC, EDQUOT), "free space there"),
    **dict.fromkeys((EACCES, EPERM), "correct its permissions"),
    EROFS: "make it writable",
    EFBIG: "raise the limit of file sizes (ulimit -f)",
    EIO: "check the disk",
}


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Return ``path`` as a Path, if a file can be written or replaced there.

    Raises
    ------
    InputError : the folder is missing or not writable, the name is too long, or the path exists and
        is not a regular file
    """
    target, mode = Path(path), stat.S_IFREG
    try:
        with suppress(FileNotFoundError):
            mode = target.stat().st_mode
        target.parent.stat()
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
    except OSError as error:
        raise InputError(
            f"cannot write {target}: {reason(error)}; give a file in a writable folder"
        ) from None
    if not stat.S_ISREG(mode):
        kind = "a directory" if stat.S_ISDIR(mode) else "not a regular file"
        raise InputError(f"cannot write {target}: it is {kind}; give a file name")
    return target


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder for results, with its parents, and return its path. Raise InputError if it
    cannot be created."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {path}: {reason(error)}; give a writable folder") from None
    return Path(path)


class CannotUse(InputError):
    """A file or folder for results cannot be written or read."""


@contextmanager
def reported(action: str, place: object, then: str = "or give another path") -> Iterator[None]:
    """Raise CannotUse for an OSError within the context, for example if a disk is full.

    action : "write" or "read", for the message
    place : the file or folder
    then : end of the message, after the remedy
    """
    try:
        yield
    except OSError as error:
        number = error.errno or 0
        remedy, why = _REMEDIES.get(number, "correct this"), reason(error)
        if number in _REMEDIES:  # pyarrow's errors have the system's number but another text
            why = os.strerror(number).lower()
        raise CannotUse(f"cannot {action} {place}: {why}; {remedy}, {then}") from None


def write_whole(path: str | os.PathLike[str], write: Callable[[str], object]) -> None:
    """Call ``write`` with a temporary path in the folder of ``path``, then rename the temporary
    file to ``path``. Raise InputError as :func:`check_writable`, or if writing fails, for example
    on a full disk."""
    target = check_writable(path)
    temporary = target.with_name(f"{TEMPORARY}{os.urandom(8).hex()}")

    def remove() -> None:
        with suppress(OSError):
            temporary.unlink()

    with if_ended(remove, always=True), reported("write", target):
        write(str(temporary))
        os.replace(temporary, target)


def remove_abandoned(folder: str | os.PathLike[str]) -> None:
    """Remove the temporary files of :func:`write_whole` that killed processes left in a folder."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(TEMPORARY):
                with suppress(OSError):
                    if entry.stat().st_mtime < time.time() - ABANDONED:
                        os.unlink(entry)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file completely or not at all; errors as in :func:`write_whole`."""
    write_whole(path, lambda name: Path(name).write_bytes(content))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text as UTF-8; errors as in :func:`write_whole`. Invalid bytes, which file names
    may contain, are escaped."""
    write_bytes(path, text.encode(errors="backslashreplace"))


MOST = 1 << 30  # default size limit of a file in bytes
# Matches a dotted TOML key with more parts than any key of a valid table. It is refused because the
# parser's time and memory grow quadratically with the number of parts.
_DEEP_KEY = re.compile(
    r"""(?<![\w"'.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}"""
)
# First bytes, in lower case, of a placeholder instead of the content, or of a PNG image whose line
# ends or encoding were converted: bytes, kind, remedy.
_NOT_DOWNLOADED = (
    (b"version https://git-lfs", "a Git LFS pointer", "fetch it with git lfs pull"),
    (b"<!doctype html", "an HTML page", "download the file itself"),
    (b"<html", "an HTML page", "download the file itself"),
    *(
        (start, "a PNG image that was converted as text", "transfer it again as binary data")
        for start in (b"\x89png\n", b"\x89png\r\r\n", b"\x89png\r\n\x1a\r\n", b"\xef\xbf\xbdpng")
    ),
)
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    **dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "a device"),
}


def check_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> None:
    """Raise InputError unless a path is the name of a regular file. Other files are refused: a pipe
    may block, and a device may never end.

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
    beside = (f"{name}{end}" for end in known if os.path.isfile(f"{os.fsdecode(path)}{end}"))
    check_file(path, next(beside, what), most)
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


def data_dir(name: str) -> Path:
    """Return the data folder ``name``: in the installed package, or next to it in a checkout."""
    package = Path(__file__).parents[1]
    installed = package / name
    return installed if installed.is_dir() else package.parent / name
