"""The files that a mesh file names, found without reading it as a mesh."""

from __future__ import annotations

import glob
import json
import re
import struct
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote

UDIM = "<UDIM>"  # in the name of a map stands for the number of a tile
_TILE = 4 * "[0-9]"
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|norm|disp|decal|refl)\s+(.*\S)", re.MULTILINE | re.I)
_LIBRARY = re.compile(rb"^\s*mtllib\s+(.*\S)", re.MULTILINE)
_TEXTURE = re.compile(rb"^comment\s+TextureFile\s+(.*\S)", re.MULTILINE)


def named_files(path: Path) -> list[Path]:
    """Return the files that a mesh file names, where they would lie; they need not be there. Of a
    file that cannot be read there are none."""
    try:
        if (suffix := path.suffix.lower()) in (".gltf", ".glb"):
            return [path.parent / unquote(uri) for uri in _uris(path)]
        if suffix == ".obj":
            lines = _found(_LIBRARY, path)
            libraries = [path.parent / name for line in lines for name in (line, *line.split())]
            maps = [each for library in libraries for each in _maps(library)]
            return libraries + maps
        if suffix == ".ply":
            return [path.parent / name for name in _found(_TEXTURE, path, 1 << 16)]
    except (OSError, ValueError, TypeError, RecursionError, struct.error):
        pass  # who loads it is told
    return []


def _uris(path: Path) -> list[str]:
    with _open(path) as file:
        text = file.read(20)
        if text[:4] == b"glTF":
            text = file.read(struct.unpack_from("<I", text, 12)[0])
        else:
            text += file.read()
    document = json.loads(text)
    tables = document if isinstance(document, dict) else {}
    entries = [each for key in ("buffers", "images") for each in tables.get(key) or ()]
    uris = [each.get("uri") for each in entries if isinstance(each, dict)]
    return [uri for uri in uris if isinstance(uri, str) and not uri.startswith("data:")]


def _maps(library: Path) -> list[Path]:
    """Maps of an MTL: the whole line after the word, and its last word, for options come before."""
    try:
        lines = _found(_MAP, library)
    except OSError:
        return []
    names = {name.strip('"') for line in lines for name in (line, line.split()[-1])}
    tiled = {name for name in names if UDIM in name}
    patterns = (glob.escape(str(library.parent / name)) for name in sorted(tiled))
    tiles = [each for pattern in patterns for each in glob.glob(pattern.replace(UDIM, _TILE))]
    return [*(library.parent / name for name in sorted(names - tiled)), *map(Path, tiles)]


def _open(path: Path) -> BinaryIO:
    if not path.is_file():  # a pipe may never end
        raise FileNotFoundError(path)
    return path.open("rb")


def _found(pattern: re.Pattern[bytes], path: Path, most: int = -1) -> list[str]:
    with _open(path) as file:
        content = file.read(most)
    names = [name.decode("utf-8", "replace") for name in pattern.findall(content)]
    return [name.replace("\\", "/") for name in names]
