"""Sources of meshes (files, bytes and open files) and their formats."""

from __future__ import annotations

import json
import os
import re
import struct
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facerender.errors import InputError, check_path, clipped, reason, shown
from facerender.system.data import data_dir
from facerender.system.files import (
    MOST,
    check_downloaded,
    check_suffix,
    open_file,
    read_file,
    suffix_of,
)

GLTF = (".glb", ".gltf")
NORMAL_MAP_Y = ("up", "down")
_BEGINNINGS = (
    (b"PK\x03\x04", "a ZIP archive (as USDZ is)", "unpack or export it"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"BZh", "a bzip2 archive", "unpack it"),
    (b"\xfd7zXZ", "an xz archive", "unpack it"),
    (b"7z\xbc\xaf", "a 7z archive", "unpack it"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard archive", "unpack it"),
    (b"Rar!", "a RAR archive", "unpack it"),
    (b"Kaydara FBX", "an FBX file", "export it as .glb"),
    (b"; FBX", "an FBX file", "export it as .glb"),
    (b"PXR-USDC", "a USD file", "export it as .glb"),
    (b"#usda", "a USD file", "export it as .glb"),
    (b"BLENDER", "a Blender file", "export it as .glb"),
    (b"DRACO", "a bare Draco file", "export it as .glb"),
    (b"\x89PNG", "a PNG image", "give a mesh, and the image as --albedo"),
    (b"\xff\xd8\xff", "a JPEG image", "give a mesh, and the image as --albedo"),
    (b"%PDF", "a PDF document", "give a mesh"),
    (b"\x89HDF", "an HDF5 file", "export it as .glb"),
    (b"\x93NUMPY", "a NumPy file", "export it as .glb"),
    (b"\x7fELF", "a program", "give a mesh"),
)
_MESHES = ((b"glTF", ".glb"), (b"ply\n", ".ply"), (b"ply\r\n", ".ply"))
FORMATS = {".glb": "glTF", ".gltf": "glTF", ".obj": "OBJ", ".ply": "PLY", ".stl": "STL"}
_LONGEST_START = 1 << 16  # bytes at the start of a file that are searched for its format
_OBJ = re.compile(rb"(?:^|\n)[ \t]*(?:v|vn|vt|f|o|g|usemtl|mtllib)[ \t]+\S")


def check_normal_map_y(value: Any) -> None:
    """Raise InputError unless a value is "up" or "down"."""
    if not (isinstance(value, str) and value in NORMAL_MAP_Y):
        raise InputError(f"normal_map_y = {shown(value)}: give {' or '.join(NORMAL_MAP_Y)}")


@dataclass(frozen=True)
class Source:
    """A mesh file, or its content."""

    path: Path  # for content in memory, a name for messages
    suffix: str  # .glb, .gltf, .obj, .ply or .stl for the format; may differ from that of the path
    content: bytes | None  # None to read the file
    folder: Path | None  # folder of the files that the mesh refers to; None if unknown

    @property
    def name(self) -> str:
        return clipped(self.path.name, 80)

    def read(self) -> bytes:
        """Return the content; errors as of :func:`read_file`."""
        return read_file(self.path, "a mesh file") if self.content is None else self.content


def source_of(source: Any, kind: str | None = None) -> Source:
    """Return the Source of a mesh; parameters and errors as in :func:`facerender.load_mesh`."""
    suffix = None if kind is None else f".{str(kind).lower().removeprefix('.')}"
    if suffix not in (None, *FORMATS):
        kinds = ", ".join(key[1:] for key in FORMATS)
        raise InputError(f"unknown mesh kind {shown(kind)}; known: {kinds}")
    if source is None:
        source = data_dir("assets") / "head.glb"
    if isinstance(source, str | os.PathLike):
        check_path("mesh file", source)
        path = Path(source)
        return Source(path, suffix or _suffix_at(path), None, path.parent)
    folder, path = None, Path("bytes")
    if hasattr(source, "read"):
        name = getattr(source, "name", None)
        path = Path(name if isinstance(name, str) and name else "file")
        folder = path.parent if os.path.isfile(path) else None
        source = _content(source, path.name)
    if not isinstance(source, bytes | bytearray | memoryview):
        raise InputError(
            f"mesh file = {shown(source)}: give a path, bytes, an open file, or a trimesh mesh or "
            "scene"
        )
    content = bytes(source)
    if suffix is None and (suffix := _suffix_of(content, path)) is None:
        raise InputError(f"{path.name}: unknown mesh format; specify it, such as kind='obj'")
    return Source(path, suffix, content, folder)


def _content(file: Any, name: str) -> bytes:
    try:
        content = file.read(MOST + 1)
    except (OSError, ValueError) as error:
        why = reason(error)
        raise InputError(f"cannot read {name}: {why}; give a file open for reading") from None
    if not isinstance(content, bytes):
        raise InputError(f"{name} is open as text: open it as bytes, with mode 'rb'")
    if len(content) > MOST:
        raise InputError(f"{name} has more than {MOST} bytes; give a mesh file")
    if not content:
        raise InputError(f"{name} has no more bytes to read: rewind it with seek(0), or fill it")
    return content


def _suffix_at(path: Path) -> str:
    """Return the suffix of the format of a mesh file; see :func:`_suffix_of`."""
    named = path.suffix.lower() in FORMATS
    try:
        with open_file(path, "a mesh file") as file:
            content = file.read(_LONGEST_START if named else MOST)
    except InputError:
        suffix_of(path, (*FORMATS,), "mesh", "a mesh file")  # may suggest another name
        raise
    return _suffix_of(content, path) or check_suffix(path, (*FORMATS,), "mesh")


def _suffix_of(data: bytes, path: Path) -> str | None:
    """Return the suffix of the format of a mesh file's bytes, or None if the format is unknown. The
    first bytes identify glTF and PLY. For other formats the name decides, or else the content.

    Raises
    ------
    InputError : the content has a format that is not supported
    """
    start = data[:_LONGEST_START].removeprefix(b"\xef\xbb\xbf").lstrip()
    for beginning, suffix in _MESHES:
        if start.startswith(beginning):
            return suffix
    if (named := path.suffix.lower()) in FORMATS:
        return named
    if start.startswith(b"{"):
        return ".gltf"
    binary = len(data) > 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]
    if binary or (start[:5].lower() == b"solid" and b"facet" in start):
        return ".stl"
    check_format(data, None, path.name)
    return ".obj" if b"\0" not in start and _OBJ.search(start) else None


def check_format(data: bytes, suffix: str | None, name: str) -> None:
    """Raise InputError if the content has a known format that differs from the suffix; None accepts
    all mesh formats."""
    start = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    format_name = suffix and FORMATS[suffix]
    subject = f"{name} is not {format_name} but" if format_name else f"{name} is"
    for beginning, kind, remedy in _BEGINNINGS:
        if start.startswith(beginning):
            raise InputError(f"{subject} {kind}; {remedy}")
    check_downloaded(start, subject)
    if start.startswith(b"<"):
        raise InputError(f"{subject} an XML file; download the file itself")
    if data[257:262] == b"ustar":
        raise InputError(f"{subject} a tar archive; unpack it")
    for beginning, actual_suffix in _MESHES if format_name else ():
        if start.startswith(beginning) and FORMATS[actual_suffix] != format_name:
            raise InputError(f"{subject} {FORMATS[actual_suffix]}; name it {actual_suffix}")
    if format_name not in (None, "glTF") and start.startswith(b"{"):
        raise InputError(f"{subject} {_json(data)}")


def _json(data: bytes) -> str:
    with suppress(ValueError, RecursionError):
        document = json.loads(data) if len(data) < 1 << 20 else None
        if isinstance(document, dict) and "asset" in document:
            return "glTF; name it .gltf"
    return f"JSON ({clipped(data[:200].decode('utf-8', 'replace'), 60)}); give a mesh"
