"""Files that others made, opened with care: only regular ones, of a size that was declared."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from facerender.errors import InputError, clipped, reason

MOST = 1 << 30  # bytes
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def read_file(path: str | os.PathLike[str], what: str, most: int = MOST) -> bytes:
    """Return the content of a regular file; nothing else is opened, for a pipe may never begin and
    a device never end.

    Parameters
    ----------
    what : that should be given in its place, for the message: "an image file"
    most : bytes that it may have

    Raises
    ------
    InputError : it is missing, may not be read, is no regular file, or is larger
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
            return file.read(facts.st_size)
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise InputError(f"cannot read {shown}: {reason(error)}; give {what}") from None
