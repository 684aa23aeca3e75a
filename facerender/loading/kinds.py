"""What a file is that should be a mesh, by how it begins."""

from __future__ import annotations

import json
import re
import struct

from facerender.errors import InputError, clipped
from facerender.system.files import check_downloaded

_BEGINNINGS = (
    (b"PK\x03\x04", "a ZIP archive, as USDZ is too", "unpack or export it"),
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
    (b"\x89PNG", "a PNG image", "give it as --albedo, and a mesh"),
    (b"\xff\xd8\xff", "a JPEG image", "give it as --albedo, and a mesh"),
    (b"%PDF", "a PDF document", "give a mesh"),
    (b"\x89HDF", "an HDF5 file", "export it as .glb"),
    (b"\x93NUMPY", "a NumPy file", "export it as .glb"),
    (b"\x7fELF", "a program", "give a mesh"),
)
_MESHES = ((b"glTF", ".glb"), (b"ply\n", ".ply"), (b"ply\r\n", ".ply"))
FORMATS = {".glb": "glTF", ".gltf": "glTF", ".obj": "OBJ", ".ply": "PLY", ".stl": "STL"}


_OBJ = re.compile(rb"(?:^|\n)[ \t]*(?:v|vn|vt|f|o|g|usemtl|mtllib)[ \t]+\S")


def kind_of(data: bytes, name: str) -> str:
    """Return the suffix of what some bytes are, by how they begin.

    Raises
    ------
    InputError : they are none of these kinds
    """
    start = data[: 1 << 16].removeprefix(b"\xef\xbb\xbf").lstrip()
    for beginning, suffix in _MESHES:
        if start.startswith(beginning):
            return suffix
    if start.startswith(b"{"):
        return ".gltf"
    if len(data) > 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        return ".stl"
    if start[:5].lower() == b"solid" and b"facet" in start:
        return ".stl"
    check_kind(data, ".obj", name)
    if b"\0" not in start and _OBJ.search(start):
        return ".obj"
    raise InputError(f"{name}: no mesh is known by these bytes; say its kind, such as kind='obj'")


def check_kind(data: bytes, suffix: str, name: str) -> None:
    """Raise InputError where a file's content is known, and not what its suffix says."""
    start = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    wanted = FORMATS[suffix]
    for beginning, kind, remedy in _BEGINNINGS:
        if start.startswith(beginning):
            raise InputError(f"{name} is not {wanted} but {kind}; {remedy}")
    check_downloaded(start, f"{name} is not {wanted} but")
    if start.startswith(b"<"):
        raise InputError(f"{name} is not {wanted} but an XML file; download the file itself")
    if data[257:262] == b"ustar":
        raise InputError(f"{name} is not {wanted} but a tar archive; unpack it")
    for beginning, other in _MESHES:
        if start.startswith(beginning) and FORMATS[other] != wanted:
            raise InputError(f"{name} is not {wanted} but {FORMATS[other]}; name it {other}")
    if wanted != "glTF" and start.startswith(b"{"):
        raise InputError(f"{name} is not {wanted} but {_json(data)}")


def _json(data: bytes) -> str:
    try:
        document = json.loads(data) if len(data) < 1 << 20 else None
    except (ValueError, RecursionError):
        document = None
    if isinstance(document, dict) and "asset" in document:
        return "glTF; name it .gltf"
    return f"JSON ({clipped(data[:200].decode('utf-8', 'replace'), 60)}); give a mesh"
