"""The files that a mesh file refers to: their names, which of them are opened, and why others are
not."""

from __future__ import annotations

import base64
import glob
import json
import os
import re
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

from facerender.errors import InputError, clipped
from facerender.loading.gltf_document import chunks
from facerender.system.files import MOST, read_file

ALLOW = "pass --allow-outside (allow_outside=True)"
UDIM = "<UDIM>"  # in the name of a map stands for the number of a tile
_TILE = 4 * "[0-9]"
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|norm|disp|decal|refl)\s+(.*\S)", re.MULTILINE | re.I)
_LIBRARY = re.compile(rb"^\s*mtllib\s+(.*\S)", re.MULTILINE)
_TEXTURE = re.compile(rb"^comment\s+TextureFile\s+(.*\S)", re.MULTILINE)


class References:
    """Reads what a mesh file refers to, each file once.

    Only what lies below the mesh file's folder by its name is opened, or else a file of that name
    beside the mesh file; a link in that folder may lead elsewhere, for it is the user's own.

    Attributes
    ----------
    name : of the mesh file, for messages
    folder : of the mesh file; None of content in memory, of which nothing else is opened
    files : by the name in the mesh file what was read; None was not
    """

    def __init__(self, name: str, folder: Path | None, allow_outside: bool) -> None:
        self.name = name
        self.folder = folder
        self.allow_outside = allow_outside
        self.files: dict[str, bytes | None] = {}

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
        content = self.files[name] = read_file(found, what, most)
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


def named_files(path: Path) -> list[Path]:
    """Return the files that a mesh file names, where they would lie; they need not be there. Of a
    file that cannot be read there are none."""
    suffix = path.suffix.lower()
    try:
        if suffix in (".gltf", ".glb"):
            return [path.parent / unquote(uri) for uri in _uris(path)]
        if suffix == ".obj":
            lines = _names(_LIBRARY, path)
            libraries = [path.parent / name for line in lines for name in (line, *line.split())]
            return libraries + [each for library in libraries for each in _maps(library)]
        if suffix == ".ply":
            return [path.parent / name for name in _names(_TEXTURE, path)]
    except (ValueError, TypeError, RecursionError):  # loading it reports what is wrong
        pass
    return []


def _uris(path: Path) -> list[str]:
    """The files of a glTF file that need not be valid."""
    document = json.loads(chunks(read_file(path, "a mesh file"), path.name)[0])
    tables = document if isinstance(document, dict) else {}
    entries = [each for key in ("buffers", "images") for each in tables.get(key) or ()]
    uris = [each.get("uri") for each in entries if isinstance(each, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _maps(library: Path) -> list[Path]:
    """Maps of an MTL: the whole line after the word, and its last word, for options come before."""
    try:
        lines = _names(_MAP, library)
    except InputError:
        return []
    names = {name.strip('"') for line in lines for name in (line, line.split()[-1])}
    tiled = {name for name in names if UDIM in name}
    patterns = (glob.escape(str(library.parent / name)) for name in sorted(tiled))
    tiles = [each for pattern in patterns for each in glob.glob(pattern.replace(UDIM, _TILE))]
    return [*(library.parent / name for name in sorted(names - tiled)), *map(Path, tiles)]


def _names(pattern: re.Pattern[bytes], path: Path) -> list[str]:
    names = pattern.findall(read_file(path, "a mesh file"))
    return [name.decode("utf-8", "replace").replace("\\", "/") for name in names]
