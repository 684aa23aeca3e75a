"""Read untrusted files safely, and write output files completely or not at all."""

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

AnyPath = str | os.PathLike[str]
ABANDONED = 3600.0  # age in seconds at which a temporary file counts as abandoned
TEMPORARY = ".facerender-"  # prefix of temporary files
_REMEDIES = {
    **dict.fromkeys((ENOSPC, EDQUOT), "free space there"),
    **dict.fromkeys((EACCES, EPERM), "correct its permissions"),
    EROFS: "make it writable",
    EFBIG: "raise the limit of file sizes (ulimit -f)",
    EIO: "check the disk",
}


def check_writable(path: AnyPath) -> Path:
    """Return ``path`` as a Path. Raise InputError unless a regular file can be written there."""
    target, mode = Path(path), stat.S_IFREG
    try:
        with suppress(FileNotFoundError):
            mode = target.stat().st_mode
        target.parent.stat()
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise PermissionError(EACCES, os.strerror(EACCES))
    except OSError as error:
        remedy = "give a file in a writable folder"
        raise InputError(f"cannot write {target}: {reason(error)}; {remedy}") from None
    if not stat.S_ISREG(mode):
        fault = _FILE_TYPES[stat.S_IFDIR] if stat.S_ISDIR(mode) else "not a regular file"
        raise InputError(f"cannot write {target}: it is {fault}; give a file name")
    return target


def make_folder(path: AnyPath) -> Path:
    """Create a folder for results, with its parents, and return its path."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create {path}: {reason(error)}; give a writable folder") from None
    return Path(path)


class CannotUse(InputError):
    """A file or folder for results cannot be written or read."""


@contextmanager
def reported(action: str, path: object, then: str = "or give another path") -> Iterator[None]:
    """Raise CannotUse for an OSError within the context, for example if a disk is full. The message
    has the action, "write" or "read", the path, a remedy and ``then``."""
    try:
        yield
    except OSError as error:
        number = error.errno or 0
        remedy, why = _REMEDIES.get(number, "correct this"), reason(error)
        if number in _REMEDIES:  # pyarrow's errors have the system's number but another text
            why = os.strerror(number).lower()
        raise CannotUse(f"cannot {action} {path}: {why}; {remedy}, {then}") from None


def write_whole(path: AnyPath, write: Callable[[str], object]) -> None:
    """Call ``write`` with a temporary path in the same folder, then rename the file to ``path``."""
    target = check_writable(path)
    temporary = target.with_name(f"{TEMPORARY}{os.urandom(8).hex()}")

    def remove() -> None:
        with suppress(OSError):
            temporary.unlink()

    with if_ended(remove, always=True), reported("write", target):
        write(str(temporary))
        os.replace(temporary, target)


def remove_abandoned(folder: AnyPath) -> None:
    """Remove the temporary files of :func:`write_whole` that killed processes left in a folder."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(TEMPORARY):
                with suppress(OSError):
                    if entry.stat().st_mtime < time.time() - ABANDONED:
                        os.unlink(entry)


def write_bytes(path: AnyPath, content: bytes) -> None:
    """Write a file completely or not at all; see :func:`write_whole`."""
    write_whole(path, lambda name: Path(name).write_bytes(content))


def write_text(path: AnyPath, text: str) -> None:
    """Write text as UTF-8. Invalid bytes, which file names may contain, are escaped."""
    write_bytes(path, text.encode(errors="backslashreplace"))


MAX_FILE_BYTES = 1 << 30  # default size limit of a file in bytes
# Matches a dotted TOML key with more parts than any key of a valid table. It is refused because the
# parser's time and memory grow quadratically with the number of parts.
_DEEP = re.compile(r"""(?<![\w"'.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){32}""")
# First bytes, in lower case, of a placeholder instead of the content, or of a PNG image whose line
# ends or encoding were converted: bytes, description, remedy.
_NOT_DOWNLOADED = (
    (b"version https://git-lfs", "a Git LFS pointer", "fetch it with git lfs pull"),
    (b"<!doctype html", "an HTML page", "download the file itself"),
    (b"<html", "an HTML page", "download the file itself"),
    *(
        (start, "a PNG image that was converted as text", "transfer it again as binary data")
        for start in (b"\x89png\n", b"\x89png\r\r\n", b"\x89png\r\n\x1a\r\n", b"\xef\xbf\xbdpng")
    ),
)
_FILE_TYPES = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    **dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "a device"),
}


def check_file(path: AnyPath, what: str, most: int = MAX_FILE_BYTES) -> None:
    """Raise InputError unless a path is the name of a regular file. Other files are refused: a pipe
    may block, and a device may never end.

    what : description of the expected file for messages, such as "an image file"
    most : maximum size in bytes
    """
    name = clipped(os.fsdecode(path))
    if not name:
        raise InputError(f"the name of a file is empty; give {what}")
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: an invalid file name
        raise InputError(f"cannot read {name}: {reason(error)}; give {what}") from None
    if not stat.S_ISREG(status.st_mode):
        file_type = _FILE_TYPES.get(stat.S_IFMT(status.st_mode), "not a regular file")
        raise InputError(f"{name} is {file_type}; give {what}")
    if status.st_size > most:
        raise InputError(f"{name} has {status.st_size} bytes, but the limit is {most}; give {what}")


def suffix_of(
    path: AnyPath, known: Sequence[str], noun: str, what: str, most: int = MAX_FILE_BYTES
) -> str:
    """Return the suffix of a file, in lower case, as :func:`check_suffix` does. For ``what``,
    ``most`` and further errors see :func:`check_file`."""
    name = clipped(os.fsdecode(path))
    beside = (f"{name}{end}" for end in known if os.path.isfile(f"{os.fsdecode(path)}{end}"))
    check_file(path, next(beside, what), most)
    return check_suffix(path, known, noun)


def check_suffix(path: AnyPath, known: Sequence[str], noun: str) -> str:
    """Return the suffix of a path, which need not exist, in lower case. Raise InputError if it is
    unknown; ``noun`` names the file in messages, such as "image"."""
    name, suffix = clipped(os.fsdecode(path)), Path(path).suffix.lower()
    formats = " or ".join(filter(None, [", ".join(known[:-1]), known[-1]]))
    if not suffix:
        raise InputError(f"{name} has no suffix, which sets the {noun} format; give {formats}")
    if suffix not in known:
        raise InputError(f"{name}: unknown {noun} format {clipped(suffix, 40)!r}; give {formats}")
    return suffix


@contextmanager
def open_file(path: AnyPath, what: str, most: int = MAX_FILE_BYTES) -> Iterator[BinaryIO]:
    """Open a regular file. Raise InputError as :func:`check_file`, or if reading fails."""
    check_file(path, what, most)
    try:
        with Path(path).open("rb") as file:
            yield file
    except InputError:
        raise
    except (OSError, ValueError) as error:
        name = clipped(os.fsdecode(path))
        raise InputError(f"cannot read {name}: {reason(error)}; give {what}") from None


def read_file(path: AnyPath, what: str, most: int = MAX_FILE_BYTES) -> bytes:
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
    """Raise InputError for a Git LFS pointer, an HTML page, or a PNG image converted as text. The
    message starts with ``subject``, such as "a.png is" or "head.glb is not glTF but"."""
    start = content[:64].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    for beginning, content_type, remedy in _NOT_DOWNLOADED:
        if start.startswith(beginning):
            raise InputError(f"{subject} {content_type}; {remedy}")


def tables_of(content: bytes, name: str) -> dict[str, Any]:
    """Return the tables of a TOML file, with or without a byte order mark."""
    import tomllib

    try:
        text = content.decode("utf-8-sig")
        if _DEEP.search(text):
            raise RecursionError
        return tomllib.loads(text)
    except RecursionError:
        why = "nested too deep"
    except ValueError as error:  # also an integer with more digits than Python parses
        why = reason(error)
    raise InputError(f"{name} is not valid TOML: {why}; correct it")


def data_dir(name: str) -> Path:
    """Return the data folder ``name``: in the installed package, or next to it in a checkout."""
    installed = Path(__file__).parents[1] / name
    return installed if installed.is_dir() else Path(__file__).parents[2] / name
