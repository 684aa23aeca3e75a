"""Write output files completely or not at all."""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EIO, ENOSPC, EPERM, EROFS
from pathlib import Path

from facerender.errors import InputError, reason
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
    """Create a folder for results, with its parents, and return its path.

    Raises
    ------
    InputError : the folder cannot be created
    """
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
    file to ``path``.

    Raises
    ------
    InputError : as in :func:`check_writable`, or writing fails, for example on a full disk
    """
    target = check_writable(path)
    temporary = target.with_name(f"{TEMPORARY}{os.urandom(8).hex()}")

    def remove() -> None:
        with suppress(OSError):
            temporary.unlink()

    with if_ended(remove), reported("write", target):
        try:
            write(str(temporary))
            os.replace(temporary, target)
        finally:
            remove()


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
