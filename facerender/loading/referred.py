"""The files that a mesh file refers to: what of them is opened, and why another is not."""

from __future__ import annotations

import base64
import os
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

from facerender.errors import InputError, clipped
from facerender.system.files import MOST, read_file

ALLOW = "pass --allow-outside (allow_outside=True)"


class Referred:
    """Reads what a mesh file refers to, each file once.

    Only what lies below the mesh file's folder by its name is opened, or else a file of that name
    beside the mesh file; a link in that folder may lead elsewhere, for it is the user's own.

    Attributes
    ----------
    name : of the mesh file, for messages
    folder : of the mesh file; None of content in memory, of which nothing else is opened
    files : by the name in the mesh file what was read; None was not
    refused : what is there and cannot be read
    """

    def __init__(self, name: str, folder: Path | None, allow_outside: bool) -> None:
        self.name = name
        self.folder = folder
        self.allow_outside = allow_outside
        self.files: dict[str, bytes | None] = {}
        self.refused: list[InputError] = []

    def read(self, name: str, what: str) -> bytes:
        """Return the content of a file.

        name : as the mesh file has it
        what : that should be given in its place, for the message

        Raises
        ------
        FileNotFoundError : it is not there, or may not be opened
        InputError : it is no file, or all are too large together
        """
        if (known := self.files.get(name)) is not None:
            return known
        self.files[name] = None
        found = self.folder and _place(self.folder, name, self.allow_outside)
        if found is None:
            raise FileNotFoundError(self.why_not(name))
        most = MOST - sum(len(each) for each in self.files.values() if each is not None)
        try:
            content = self.files[name] = read_file(found, what, most)
        except InputError as error:
            self.refused.append(error)
            raise
        return content

    def missing(self) -> list[str]:
        return [name for name, content in self.files.items() if content is None]

    def why_not(self, name: str) -> str:
        """Why a file was not found, for behind the mesh file's name."""
        if self.folder is None:
            return "is not in the bytes that were given, which have no folder: give a path"
        folder = clipped(str(self.folder), 120)
        if not self.allow_outside and not _is_inside(self.folder, _spellings(name)[0]):
            return f"lies outside {folder}, and is not opened: {ALLOW}"
        return f"not found in {folder}"


def content_of(folder: Path, name: str, allow_outside: bool) -> bytes | None:
    """Return what a mesh file in a folder finds under a name, or None."""
    found = _place(folder, name, allow_outside)
    try:
        return None if found is None else read_file(found, "a file")
    except InputError:
        return None


def inline(uri: str) -> bytes | None:
    """Return the content of a data: URI, or None of another.

    Raises
    ------
    ValueError : it is damaged
    """
    head, comma, content = uri.partition(",")
    if not head.lower().startswith("data:"):
        return None
    if not comma:
        raise ValueError("a data: URI without data")
    if head.endswith(";base64"):
        return base64.b64decode(content)
    return unquote_to_bytes(content)


def _place(folder: Path, name: str, allow_outside: bool) -> Path | None:
    """Where the file of a name lies: by its path, or else beside the mesh file."""
    for each in _spellings(name):
        if allow_outside or _is_inside(folder, each):
            try:
                if os.path.exists(folder / each):
                    return folder / each
            except ValueError:  # a name that no file can have
                pass
    return None


def _spellings(name: str) -> tuple[str, ...]:
    path = name.replace("\\", "/").strip()
    plain = unquote(path)
    return path, plain, path.lstrip("/"), os.path.basename(path), os.path.basename(plain)


def _is_inside(folder: Path, name: str) -> bool:
    """Whether a path stays below a folder by its name, whatever links lead to."""
    base = os.path.abspath(folder)
    try:
        place = os.path.abspath(os.path.join(base, name))
        return place != base and os.path.commonpath([base, place]) == base
    except ValueError:  # another drive
        return False
