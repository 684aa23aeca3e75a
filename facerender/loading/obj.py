"""Prepare OBJ files for trimesh, which neither resolves negative references of faces nor keeps
groups of the same material apart."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.source import color_bytes, text_of
from facerender.scenes.repair import Piece

# A face with a reference below 1. The reference -1 means the last element defined before the face;
# the reference 0 is invalid.
RELATIVE = re.compile(rb"^[ \t]*f[^\n]*[ \t/][-0]", re.MULTILINE)
_LINE = re.compile(rb"^[ \t]*(v|vt|vn|f)[ \t]([^\n]*)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)
# A statement that sets the object, group or material of the following faces.
_OWNER = re.compile(rb"^[ \t]*(o|g|usemtl)(?:[ \t]+([^\r\n]*?))?[ \t]*\r?$", re.MULTILINE)
_MOST_GROUPS = 256  # maximum number of parts: each part needs a draw call
_KINDS = (b"v", b"vt", b"vn")  # vertex, texture coordinate, normal: the references of a corner


def normalized(data: bytes, file: str) -> bytes:
    """Return an OBJ file as UTF-8 with the line ends and spaces that trimesh expects: it reads
    neither tabs after keywords nor indented lines nor comments behind numbers.

    Raises
    ------
    InputError : the file is UTF-16 without a byte order mark
    """
    if any(half and not half.strip(b"\0") for half in (data[:128:2], data[1:128:2])):
        raise InputError(f"{file} is UTF-16 without a byte order mark: save it as UTF-8")
    if b"#MRGB" in data:
        warn(f"{file} has colours of ZBrush (#MRGB), which are not read: export it as .ply or .glb")
    data = text_of(data).replace("\t", " ").replace("\\\n", "").encode()
    for pattern in (_INDENTED, _COMMENT):
        if pattern.search(data):
            data = pattern.sub(rb"\1", data)
    return data


def vertex_colors(data: bytes, file: str) -> NDArray[np.uint8] | None:
    """Return the sRGB colour (N, 3) of each vertex of a normalised OBJ file, which follows its
    position; None without colours. trimesh drops them in files with texture coordinates or
    materials."""
    columns = np.array(_COLORS.findall(data), dtype=np.bytes_).reshape(-1, 3)
    missing = columns[:, 0] == b""
    if missing.all():
        return None
    try:
        colors = color_bytes(np.where(missing[:, None], b"nan", columns).astype(np.float64))
    except ValueError:
        return None
    if missing.any():
        warn(f"{file} has vertices without colour ({missing.sum()}): drawn white")
        colors[missing] = 255
    return colors


def with_absolute(data: bytes) -> tuple[bytes, int]:
    """Convert the references in an OBJ file to absolute references. Return the new content, and the
    number of faces dropped because of invalid references."""
    totals = {
        key: len(re.findall(rb"^[ \t]*" + key + rb"[ \t]", data, re.MULTILINE)) for key in _KINDS
    }
    counts = dict.fromkeys(_KINDS, 0)
    dropped = 0

    def repaired(line: re.Match[bytes]) -> bytes:
        nonlocal dropped
        if line[1] != b"f":
            counts[line[1]] += 1
            return line[0]
        text, hash_, comment = line[2].partition(b"#")
        corners = [_absolute(corner, counts, totals) for corner in text.split()]
        if len(corners) < 3 or not all(corners):
            dropped += 1
            return b""
        return b" ".join([b"f", *corners]) + hash_ + comment

    return _LINE.sub(repaired, data), dropped


def _absolute(corner: bytes, counts: Mapping[bytes, int], totals: Mapping[bytes, int]) -> bytes:
    """Convert the references of a corner to absolute; return b"" if a reference is invalid."""
    references: list[bytes] = []
    for reference, key in zip(corner.split(b"/"), _KINDS, strict=False):
        if not reference and key != b"v":
            references.append(reference)
            continue
        try:
            number = int(reference)
        except ValueError:
            return b""
        number += counts[key] + 1 if number < 0 else 0
        if not 1 <= number <= totals[key]:
            return b""
        references.append(b"%d" % number)
    return b"/".join(references)


# A vertex: position, in some files a weight, and a colour or nothing.
_COLORS = re.compile(rb"^v(?: +\S+){3,4}?(?: +(\S+) +(\S+) +(\S+))? *$", re.MULTILINE)
_INDENTED = re.compile(rb"^ +()", re.MULTILINE)
_COMMENT = re.compile(rb"^((?:v[tn]?|f) [^\n#]*)#[^\n]*", re.MULTILINE)

Owners = tuple[bytes, ...]  # names of object, group and material


def with_parts(data: bytes, file: str) -> tuple[bytes, list[str], list[str]]:
    """Rewrite an OBJ file to have one numbered object for each combination of object, group and
    material that has faces. Return the content, and in order of object numbers the names of the
    parts and of their materials, which are "" without usemtl.

    A part is named after its group, or else its object, or else its material. Parts with the same
    name are renamed to group.material or, if they share this name, too, to object.group.material.
    """
    owners = {b"o": b"", b"g": b"", b"usemtl": b""}
    starts, ends, keys, heads = [0], [0], [tuple(owners.values())], [b""]
    for line in _OWNER.finditer(data):
        owners[line[1]] = line[2] or b""
        starts.append(line.start())
        ends.append(line.end())
        keys.append(tuple(owners.values()))
        heads.append(line[0] if line[1] == b"usemtl" else b"")
    starts.append(len(data))
    spans = [*zip(ends, starts[1:], strict=True)]
    has_faces = [_FACE.search(data, *span) is not None for span in spans]
    parts = _with_faces(keys, has_faces)
    if len(parts) > _MOST_GROUPS:
        keys = [(b"", b"", key[2]) for key in keys]
        joined = _with_faces(keys, has_faces)
        if len(joined) < len(parts):
            warn(
                f"{file} has {len(parts)} groups with faces, but the limit is {_MOST_GROUPS} "
                "parts: groups of the same material are joined"
            )
        parts = joined
    materials = [" ".join(material.decode().split()) for *_, material in parts]
    if len(parts) < 2:
        return data, _names(parts), materials
    numbers = {key: number for number, key in enumerate(parts)}
    lines = [
        b"o %d\n%b%b" % (numbers.get(key, len(parts)), head, data[slice(*span)])
        for key, head, span in zip(keys, heads, spans, strict=True)
    ]
    return b"".join(lines), _names(parts), materials


def _with_faces(keys: Sequence[Owners], has_faces: Sequence[bool]) -> list[Owners]:
    return [*dict.fromkeys(key for key, has_face in zip(keys, has_faces, strict=True) if has_face)]


def _names(parts: Sequence[Owners]) -> list[str]:
    names = [group or owner or material for owner, group, material in parts]
    for which in (slice(1, 3), slice(0, 3)):
        counts = Counter(names)
        names = [
            name if counts[name] == 1 else b".".join(filter(None, key[which]))
            for name, key in zip(names, parts, strict=True)
        ]
    return [name.decode() for name in names]


_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_TRIANGLE = re.compile(rb"^[ \t]*f" + 3 * rb"[ \t]+(\d+)(?:/\S*)?" + rb"[ \t]*\r?$", re.MULTILINE)
_MULTIPLIERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)


def number_vertices(
    data: bytes, pieces: Sequence[Piece], colors: NDArray[np.uint8] | None = None
) -> None:
    """Set the sources of the pieces of an OBJ file: the index of each vertex in the file. Set the
    colours of pieces without albedo map.

    trimesh splits vertices at texture seams and does not return the indices, so that positions
    identify the vertices. If several vertices of the file share a position, the faces identify
    them in a file with one piece of triangles; in other files the piece stays without sources.

    colors : the result of :func:`vertex_colors`
    """
    try:
        places = np.array(_VERTEX.findall(data), dtype=np.bytes_).astype(np.float64).reshape(-1, 3)
    except ValueError:  # trimesh accepts more than three numbers without spaces between them
        return
    hashes, first, counts = np.unique(_hashes(places), return_index=True, return_counts=True)
    for piece in pieces:
        rows = np.arange(len(places))
        if len(pieces) > 1 or not np.array_equal(piece.positions, places):
            matches = np.searchsorted(hashes, _hashes(piece.positions)).clip(max=len(hashes) - 1)
            rows, known = first[matches], bool((counts[matches] == 1).all())
            if not known and len(pieces) == 1 and (by_faces := _by_faces(data, piece)) is not None:
                rows, known = by_faces, bool(by_faces.max() < len(places))
            if known and (places[rows] == piece.positions).all():
                piece.sources, piece.source_count = rows, len(places)
        if colors is not None and piece.material.albedo_map is None and len(colors) == len(places):
            piece.colors = srgb_to_linear(colors[rows.clip(max=len(places) - 1)] / 255.0)


def _hashes(places: NDArray[np.float64]) -> NDArray[np.uint64]:
    bits = np.ascontiguousarray(places + 0.0).view(np.uint64)  # -0 becomes 0
    return np.asarray(np.bitwise_xor.reduce(bits * _MULTIPLIERS, axis=1))


def _by_faces(data: bytes, piece: Piece) -> NDArray[np.int64] | None:
    """Return the source of each vertex, if the faces of the piece are the triangles of the file."""
    corners = np.array(_TRIANGLE.findall(data), dtype=np.bytes_)
    if corners.shape != piece.faces.shape:
        return None
    sources = np.zeros(len(piece.positions), dtype=np.int64)
    sources[piece.faces] = corners.astype(np.int64) - 1
    return sources
