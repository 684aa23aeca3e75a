"""PLY files, checked before trimesh reads them and after."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from facerender.errors import clipped

_MOST_HEADER = 1 << 16  # bytes
_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16", "float16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "int64", "uint64", "float64"), 8),
}
_TYPE = "|".join(_BYTES)
_LINES = re.compile(
    r"ply|format (?:ascii|binary_little_endian|binary_big_endian) \S+|(?:comment|obj_info)\b.*|"
    rf"element \S+ \d{{1,18}}|property (?:{_TYPE}) \S+|property list (?:{_TYPE}) (?:{_TYPE}) \S+"
)
_TEXTURE = re.compile(r"comment\s+texturefile\s+(.*\S)", re.I)
_INDICES = ("vertex_index", "vertex_indices")
_SLACK = 16  # blank lines at the end


def checked_ply(data: bytes) -> tuple[bytes, str | None]:
    """Return a PLY file without its edges, of which trimesh would make a drawing, and the name of
    its texture.

    Raises
    ------
    ValueError : its header is damaged, or tells of more elements than its bytes can hold
    """
    end = data.find(b"end_header", 0, _MOST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no header of PLY")
    lines = [" ".join(line.split()) for line in data[:end].decode("utf-8", "replace").splitlines()]
    lines = [line for line in lines if line]
    rest = data[end:]
    is_text = any(line.startswith("format ascii") for line in lines)
    texture = None
    count = rows = needed = 0
    for line in lines:
        if _LINES.fullmatch(line) is None:
            raise ValueError(f"its header says {clipped(line, 60)!r}")
        words = line.split()
        if words[0] == "element":
            count = int(words[2])
            rows += count
        elif words[0] == "property":
            needed += count * _least_bytes(words, is_text)
        elif (found := _TEXTURE.fullmatch(line)) is not None:
            texture = found[1]
    if needed > len(rest):
        raise ValueError(f"its header tells of {needed} bytes or more, it has {len(rest)}")
    if is_text and rest.count(b"\n") > rows + _SLACK:
        raise ValueError(f"its header tells of {rows} lines, it has more")
    kept = [line.replace("element edge ", "element line ") for line in lines]
    return "\n".join([*kept, ""]).encode() + rest, texture


def _least_bytes(words: list[str], is_text: bool) -> int:
    """How many bytes a property takes at least; the list of a face has three entries."""
    if words[1] != "list":
        return 2 if is_text else _BYTES[words[1]]
    entries = 3 if words[4] in _INDICES else 0
    return 2 * (1 + entries) if is_text else _BYTES[words[2]] + entries * _BYTES[words[3]]


def check_faces(metadata: Mapping[str, Any]) -> None:
    """Check the faces of a file as trimesh has read them, before it made triangles of them.

    Raises
    ------
    ValueError : they have other numbers of corners than the first has, or their texture coordinates
        were taken from vertices that are not there
    """
    # Private to trimesh, which keeps the faces of the file nowhere else once it has cut polygons.
    elements = metadata.get("_ply_raw", {})
    faces = elements.get("face", {}).get("data")
    if isinstance(faces, np.ndarray) and faces.dtype.names:
        for name in faces.dtype.names:
            column = faces[name]
            if column.dtype.names and (column["f0"] != column["f0"][:1]).any():
                raise ValueError(f"its faces have different numbers of {clipped(name, 40)}")
            _check_indices(name, column["f1"] if column.dtype.names else column, elements)
    elif isinstance(faces, dict):
        for name, column in faces.items():
            _check_indices(name, column, elements)


def _check_indices(name: str, column: Any, elements: Mapping[str, Any]) -> None:
    if name not in _INDICES:
        return
    has_uv = any(each in elements["vertex"]["properties"] for each in ("s", "u", "texture_u"))
    has_uv = has_uv or "texcoord" in elements["face"]["properties"]
    if has_uv and column.dtype != object and column.size and column.min() < 0:
        raise ValueError(f"a face names vertex {column.min()}")
