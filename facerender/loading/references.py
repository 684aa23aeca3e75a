"""Find, check and read the files that a mesh file refers to."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path, PurePath
from urllib.parse import unquote, unquote_to_bytes

from facerender.errors import InputError, clipped, warn
from facerender.loading.gltf_document import chunks
from facerender.loading.source import GLTF, source_of
from facerender.system.files import MOST, read_file

ALLOW = "pass --allow-outside (allow_outside=True)"
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|norm|disp|decal|refl)\s+(.*\S)", re.MULTILINE | re.I)
_LIBRARY = re.compile(rb"^\s*mtllib\s+(.*\S)", re.MULTILINE)
# The comment of a PLY header that names the texture.
TEXTURE_FILE = re.compile(rb"^[ \t]*comment[ \t]+texturefile[ \t]+(.*\S)", re.MULTILINE | re.I)
# Windows-1252, in which the five unused bytes are control characters.
_WINDOWS = {byte: bytes([byte]).decode("cp1252", "ignore") or chr(byte) for byte in range(256)}


class References:
    """The files that a mesh file refers to. Each referenced file is read once.

    Only paths below the mesh file's folder are opened. For other paths, a file of the same name in
    that folder is tried. Symbolic links are followed, because the user created the folder.

    Attributes
    ----------
    name : name of the mesh file, for messages
    folder : folder of the mesh file; None for a mesh in memory: its referenced files are not opened
    files : contents of the referenced files, keyed by the name in the mesh file; None for a file
        that was not read
    """

    def __init__(self, name: str, folder: Path | None, allow_outside: bool) -> None:
        self.name = name
        self.folder = folder
        self.allow_outside = allow_outside
        self.files: dict[str, bytes | None] = {}

    def read(self, name: str, what: str) -> bytes:
        """Return the content of a file.

        name : name of the file, as in the mesh file
        what : description of the expected file for messages, such as "an image file"

        Raises
        ------
        FileNotFoundError : the file is missing, or its path is not allowed
        InputError : the file is not a regular file, or all files together are too large
        """
        if (cached := self.files.get(name)) is not None:
            return cached
        self.files[name] = None
        if not self.folder or (path := _place(self.folder, name, self.allow_outside)) is None:
            raise FileNotFoundError(self.why_not(name))
        if path not in (self.folder / spelling for spelling in _spellings(name)):
            used = os.path.relpath(path, self.folder)
            warn(
                f"{clipped(name, 80)} (named by {self.name}) not found: {clipped(used, 80)} is "
                "used, whose name differs in upper and lower case"
            )
        remaining = MOST - sum(map(len, filter(None, self.files.values())))
        content = self.files[name] = read_file(path, what, remaining)
        return content

    def missing(self) -> list[str]:
        return [name for name, content in self.files.items() if content is None]

    def why_not(self, name: str) -> str:
        """Return why a file was not found, as the end of a message."""
        if self.folder is None:
            return "cannot be opened, because a mesh given as bytes has no folder: give a path"
        folder = clipped(str(self.folder), 120)
        if not self.allow_outside and not _is_inside(self.folder, _spellings(name)[0]):
            return f"lies outside {folder} and is not opened: {ALLOW}"
        return f"not found in {folder}"


def content_of(folder: Path, name: str, allow_outside: bool) -> bytes | None:
    """Return the content of a file ``name`` to which a mesh file in ``folder`` refers, or None."""
    path = _place(folder, name, allow_outside)
    with suppress(InputError):
        return None if path is None else read_file(path, "a file")
    return None


def inline(uri: str) -> bytes | None:
    """Return the content of a data: URI, or None for another URI. Raise ValueError if the data are
    damaged."""
    head, comma, content = uri.partition(",")
    if not head.lower().startswith("data:"):
        return None
    if not comma:
        raise ValueError("a data: URI without data")
    return (base64.b64decode if head.endswith(";base64") else unquote_to_bytes)(content)


def text_of(content: bytes) -> str:
    """Decode the text of a file: UTF-16 with a byte order mark, UTF-8, or else Windows-1252, which
    decodes all bytes. All line ends become LF."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = content.decode("utf-16", "replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1").translate(_WINDOWS)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _place(folder: Path, name: str, allow_outside: bool) -> Path | None:
    """Find a referenced file at its path relative to ``folder``, or else by its file name in
    ``folder``. Return its path, or None if it does not exist or is not allowed."""
    for find in (_exact, _in_any_case):
        for spelling in _spellings(name):
            with suppress(ValueError, OSError):  # an invalid file name, or an unreadable folder
                inside = allow_outside or _is_inside(folder, spelling)
                if inside and (path := find(folder, spelling)) is not None:
                    return path
    return None


def _exact(folder: Path, name: str) -> Path | None:
    return folder / name if os.path.exists(folder / name) else None


def _in_any_case(folder: Path, name: str) -> Path | None:
    """Return the first file whose path differs from a path below `folder` in case only."""
    path = folder
    for part in PurePath(name).parts:
        if not os.path.exists(path / part):
            entries = sorted(os.listdir(path))
            part = next((entry for entry in entries if entry.lower() == part.lower()), "")
            if not part:
                return None
        path /= part
    return path if path.is_file() else None


def _spellings(name: str) -> tuple[str, ...]:
    """Return the possible paths of a referenced file, relative to the mesh file's folder."""
    path = name.replace("\\", "/").strip()
    plain = unquote(path)
    return path, plain, path.lstrip("/"), os.path.basename(path), os.path.basename(plain)


def _is_inside(folder: Path, name: str) -> bool:
    """Return whether a path lies below a folder, without resolving symbolic links."""
    base = os.path.abspath(folder)
    try:
        place = os.path.abspath(os.path.join(base, name))
        return place != base and os.path.commonpath([base, place]) == base
    except ValueError:  # the paths are on different drives
        return False


def named_files(path: Path) -> list[Path]:
    """Return the paths of the files to which a mesh file refers, whether they exist or not. The
    list is empty if the mesh file cannot be read."""
    try:
        suffix = source_of(path).suffix
        if suffix in GLTF:
            return _paths(path.parent, [unquote(uri) for uri in _uris(path)])
        if suffix == ".obj":
            lines = _names(_LIBRARY, path)
            names = [name for line in lines for name in (line, *line.split())]
            libraries = _paths(path.parent, names)
            return [*libraries, *(file for library in libraries for file in _maps(library))]
        if suffix == ".ply":
            return _paths(path.parent, _names(TEXTURE_FILE, path))
    except (ValueError, TypeError, RecursionError):  # loading the file reports the error
        pass
    return []


def _paths(folder: Path, names: Iterable[str]) -> list[Path]:
    """Return the paths of referenced files, and the paths of the files that are used instead."""
    paths = ((folder / name, _place(folder, name, False)) for name in names)
    return [*dict.fromkeys(path for pair in paths for path in pair if path is not None)]


def _uris(path: Path) -> list[str]:
    """Return the external URIs of a glTF file. The file may be invalid."""
    document = json.loads(chunks(read_file(path, "a mesh file"), path.name)[0])
    tables = document if isinstance(document, dict) else {}
    entries = (entry for key in ("buffers", "images") for entry in tables.get(key) or ())
    uris = [entry.get("uri") for entry in entries if isinstance(entry, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _maps(library: Path) -> list[Path]:
    """Return possible paths of the maps of an MTL file. Options may precede the name of a
    map: both the whole text and the last word of each statement are used as names."""
    with suppress(InputError):
        lines = _names(_MAP, library)
        names = {name.strip('"') for line in lines for name in (line, line.split()[-1])}
        return _paths(library.parent, sorted(names))
    return []


def _names(pattern: re.Pattern[bytes], path: Path) -> list[str]:
    names = pattern.findall(text_of(read_file(path, "a mesh file")).encode())
    return [name.decode().replace("\\", "/") for name in names]
