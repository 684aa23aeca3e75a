"""Read OBJ files. Lines are classified and parsed as arrays of bytes: an interpreted loop over the
lines of a scan takes seconds. The reader keeps the objects, groups and materials of the faces, and
the number that each vertex has in the file, which files of landmarks and of vertex positions use.

References: Wavefront Technologies (1992), Advanced Visualizer, appendix B1, Object Files.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.mtl import Library
from facerender.loading.source import References, color_bytes, no_faces, text_of
from facerender.material import MAPS
from facerender.mesh.repair import Piece, check_count

_INDENT, _COMMENT = re.compile(r"^ +", re.MULTILINE), re.compile(rb"#[^\n]*")
_MAX_GROUPS = 256  # maximum number of parts: each part needs a draw call
_SPACE, _NEWLINE = b" \n"
_Keys = tuple[str, str, str]  # names of object, group and material


def read_obj(data: bytes, references: References, albedo_given: bool) -> list[Piece]:
    """Return a piece for each combination of object, group and material that has faces. Its
    vertices are the different corners of its faces, in the order of the vertices of the file. Raise
    ValueError if a vertex is not three numbers, or no face has valid references."""
    name = references.name
    lines = _Lines(data, name)
    vertices, counts = lines.table(b"v", 7)
    has_faces = len(lines.numbers(b"f")) > 0
    if not len(vertices) or not has_faces:
        raise no_faces(name, points=len(vertices) > 0 and not has_faces)
    if counts.min() < 3:
        raise ValueError("its vertices do not have three coordinates")
    colors = _colors(vertices, counts, name)
    uv, normals = lines.table(b"vt", 2)[0], lines.table(b"vn", 3)[0]
    libraries, owners, owner_lines = _owners(lines)
    corners, faces, dropped = _faces(lines, (len(vertices), len(uv), len(normals)))
    if not len(faces):
        raise ValueError(f"none of its {dropped} faces has valid references")
    parts, numbers = _parts(owners, np.searchsorted(owner_lines, faces[:, 0]) - 1, name)
    library = Library(libraries, references, albedo_given)
    material_uv = cache(library.material_uv)  # parts share materials
    materials = library.matched([material for *_, material in parts])
    pieces, lacking = [], 0
    for index, (part_name, material_name) in enumerate(zip(_names(parts), materials, strict=True)):
        material, first_map = material_uv(material_name, colors is not None)
        triangles = triangles_of(*faces[numbers == index, 1:].T)
        part_corners, triangles = vertices_of(corners, triangles)
        sources, of_uv, of_normals = part_corners.T
        part_uv = None
        if (of_uv >= 0).any():
            lacking += int((of_uv < 0).sum())
            part_uv = np.where((of_uv < 0)[:, None], 0.0, uv[of_uv])
            library.warn_of_tiles(material_name, part_uv[triangles])
            part_uv = part_uv * first_map.scale + first_map.offset
        elif any(getattr(material, key) for key in MAPS):
            warn(f"{name} has no texture coordinates: its texture is ignored")
        part_colors = None
        if colors is not None and material.albedo_map is None:
            part_colors = srgb_to_linear(colors[sources] / 255.0)
        piece = Piece(
            positions=vertices[sources, :3],
            faces=triangles,
            normals=normals[of_normals] if of_normals.min() >= 0 else None,
            uv=part_uv,
            colors=part_colors,
            material=material,
            name=part_name,
            material_name=material_name,
            sources=sources,
            source_count=len(vertices),
            ks_ignored=library.ignores_ks(material_name),
        )
        pieces.append(piece)
    if lacking:
        warn(f"{name} has {lacking} vertices without texture coordinates: set to 0")
    pieces[0].out_of_range = dropped
    return pieces


class _Lines:
    """The bytes (N,) of an OBJ file without tabs, continuation lines and indentation, and the first
    byte and the newline (L,) of each line."""

    def __init__(self, data: bytes, name: str) -> None:
        if any(half and not half.strip(b"\0") for half in (data[:128:2], data[1:128:2])):
            raise InputError(f"{name} is UTF-16 without a byte order mark: save it as UTF-8")
        if b"#MRGB" in data:
            problem = "has colours of ZBrush (#MRGB), which are not read"
            warn(f"{name} {problem}: export it as .ply or .glb")
        text = _INDENT.sub("", text_of(data).replace("\t", " ").replace("\\\n", ""))
        self.characters = np.frombuffer(text.encode() + b"\n", dtype=np.uint8)
        self.ends = np.flatnonzero(self.characters == _NEWLINE)
        self.starts = np.concatenate([[0], self.ends[:-1] + 1])

    def numbers(self, key: bytes) -> NDArray[np.int64]:
        """Return the indices of the lines whose first word is ``key``."""
        lines = np.flatnonzero(self.ends - self.starts > len(key))
        for offset, character in enumerate(key + b" "):
            lines = lines[self.characters[self.starts[lines] + offset] == character]
        return lines

    def content(self, key: bytes) -> bytes:
        """Return the lines whose first word is ``key``, with spaces instead of this word and
        without comments."""
        lines, lengths = self.numbers(key), self.ends - self.starts + 1
        mask = np.zeros(len(lengths), dtype=bool)
        mask[lines] = True
        content = self.characters[np.repeat(mask, lengths)]
        starts = np.cumsum(lengths[lines]) - lengths[lines]
        for offset in range(len(key)):
            content[starts + offset] = _SPACE
        text = content.tobytes()
        return _COMMENT.sub(b"", text) if b"#" in text else text

    def table(self, key: bytes, width: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the first ``width`` numbers of the lines whose first word is ``key``, (N, width),
        and the count of numbers in each line, (N,). Missing numbers are 0."""
        content = self.content(key)
        characters = np.frombuffer(content, dtype=np.uint8)
        begins = _word_starts(characters)
        rows = np.cumsum(characters == _NEWLINE, dtype=np.int32)[begins]
        values = _numbers(content, np.float64)
        if len(values) != len(begins):
            values = np.array(content.split(), dtype=np.float64)  # names the invalid number
        counts = np.bincount(rows, minlength=content.count(b"\n"))
        columns = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        table = np.zeros((len(counts), width))
        used = columns < width
        table[rows[used], columns[used]] = values[used]
        return table, counts


def _word_starts(characters: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the indices of the first characters of words; the text begins with a space."""
    solid = characters > _SPACE
    return np.flatnonzero(solid[1:] & ~solid[:-1]) + 1


def _numbers(text: bytes, dtype: type[np.number[Any]]) -> NDArray[Any]:
    """Return the numbers of a text up to the first invalid one."""
    try:
        return np.fromstring(text, dtype, sep=" ")
    except (ValueError, DeprecationWarning):
        return np.empty(0, dtype)


def _colors(
    vertices: NDArray[np.float64], counts: NDArray[np.int64], name: str
) -> NDArray[np.uint8] | None:
    """Return the sRGB colour (N, 3) of each vertex, which follows its position and, in some files,
    its weight; None without colours."""
    missing = (counts != 6) & (counts != 7)
    if missing.all():
        return None
    columns = np.where((counts == 7)[:, None], vertices[:, 4:7], vertices[:, 3:6])
    colors = color_bytes(np.where(missing[:, None], np.nan, columns))
    if missing.any():
        warn(f"{name} has vertices without colour ({missing.sum()}): drawn white")
        colors[missing] = 255
    return colors


def _owners(lines: _Lines) -> tuple[list[str], list[_Keys], list[int]]:
    """Return the names of the MTL files, the names of object, group and material after each line
    that changes one of them, and the indices of these lines. The first names are empty."""
    libraries: list[str] = []
    names = {"o": "", "g": "", "usemtl": ""}
    owners, numbers = [("", "", "")], [-1]
    for index in np.flatnonzero(np.isin(lines.characters[lines.starts], [*b"ogum"])).tolist():
        line = lines.characters[lines.starts[index] : lines.ends[index]].tobytes().decode()
        key, _, value = line.partition(" ")
        if key == "mtllib":
            libraries.append(value.strip())
        elif key in names:
            names[key] = " ".join(value.split()) if key == "usemtl" else value.strip()
            owners.append((names["o"], names["g"], names["usemtl"]))
            numbers.append(index)
    return libraries, owners, numbers


def _parts(
    owners: Sequence[_Keys], spans: NDArray[np.int64], name: str
) -> tuple[list[_Keys], NDArray[np.int64]]:
    """Return the names of the parts in file order, and the part of each face, from the index in
    ``owners`` of each face's names."""
    used, inverse = np.unique(spans, return_inverse=True)
    keys = [owners[i] for i in used]
    parts = [*dict.fromkeys(keys)]
    if len(parts) > _MAX_GROUPS:
        joined = [("", "", material) for *_, material in keys]
        if len({*joined}) < len(parts):
            warn(
                f"{name} has {len(parts)} groups with faces, but the limit is {_MAX_GROUPS} "
                "parts: groups of the same material are joined"
            )
        keys, parts = joined, [*dict.fromkeys(joined)]
    check_count(len(parts), name)
    numbers = {key: number for number, key in enumerate(parts)}
    return parts, np.array([numbers[key] for key in keys])[inverse]


def _names(parts: Sequence[_Keys]) -> list[str]:
    """Return the names of parts: of the group, or else of the object, or else of the material.
    Equal names become group.material or, if these are equal, too, object.group.material."""
    names = [group or owner or material for owner, group, material in parts]
    for start in (1, 0):
        counts = Counter(names)
        longer = (".".join(filter(None, key[start:])) for key in parts)
        names = [a if counts[a] == 1 else b for a, b in zip(names, longer, strict=True)]
    return names


def _faces(
    lines: _Lines, totals: Sequence[int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Return the corners of the faces, (C, 3): indices of vertex, texture coordinate and normal, -1
    if missing; the faces, (F, 3): index of the line, index of the first corner, number of corners;
    and the number of dropped faces, which have fewer than three corners or an invalid reference.

    totals : numbers of vertices, texture coordinates and normals of the file
    """
    characters = np.frombuffer(lines.content(b"f"), dtype=np.uint8).copy()
    is_digit = (characters >= ord("0")) & (characters <= ord("9"))
    is_slash = characters == ord("/")
    is_sign = (characters == ord("-")) | (characters == ord("+"))
    is_sign[1:] &= (characters[:-1] <= _SPACE) | is_slash[:-1]
    is_sign[:-1] &= is_digit[1:]
    rows = np.cumsum(characters == _NEWLINE, dtype=np.int32)  # index of the face
    bad = (characters > _SPACE) & ~(is_digit | is_slash | is_sign)
    if bad.any():  # an empty face is dropped
        characters[np.isin(rows, rows[bad]) & (characters != _NEWLINE)] = _SPACE
        is_slash = characters == ord("/")
    begins = _word_starts(characters)
    slashes = np.cumsum(is_slash, dtype=np.int32)
    first_slashes = slashes[begins] - is_slash[begins]  # number of slashes before each corner
    characters[is_slash] = _SPACE
    number_begins = _word_starts(characters)
    values = _numbers(characters.tobytes(), np.int64)
    corner_of = np.searchsorted(begins, number_begins, side="right") - 1
    field = slashes[number_begins] - first_slashes[corner_of]
    face_of = rows[begins]
    numbers = lines.numbers(b"f")
    corners = np.full((len(begins), 3), -1)
    invalid = np.zeros(len(begins), dtype=bool)
    for column, (key, total) in enumerate(zip((b"v", b"vt", b"vn"), totals, strict=True)):
        used = field == column
        of, references = corner_of[used], values[used]
        # A negative reference counts back from the last element before the face.
        defined = np.searchsorted(lines.numbers(key), numbers)[face_of[of]]
        indices = np.where(references < 0, references + defined, references - 1)
        corners[of, column] = indices
        invalid[of] |= (references == 0) | (indices < 0) | (indices >= total)
    invalid |= corners[:, 0] < 0
    counts = np.bincount(face_of, minlength=len(numbers))
    good = (counts >= 3) & (np.bincount(face_of, invalid, len(numbers)) == 0)
    faces = np.stack([numbers, np.cumsum(counts) - counts, counts], axis=1)[good]
    return corners, faces, int((~good).sum())


def triangles_of(first: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the corners (T, 3) of the triangles of polygons, as fans around the first corner.

    first, counts : (F,), index of the first corner and number of corners
    """
    steps = counts - 2
    start = np.repeat(first, steps)
    step = np.arange(len(start)) - np.repeat(np.cumsum(steps) - steps, steps)
    triangles = np.stack([start, start + step + 1, start + step + 2], axis=1)
    # The order of corners and triangles sets the last bits of computed normals. These are the
    # orders of trimesh, with which earlier versions read OBJ files.
    second = (np.repeat(counts, steps) == 4) & (step == 1)
    triangles[second] = np.roll(triangles[second], -1, axis=1)
    if (counts == 4).all():
        triangles = np.concatenate([triangles[0::2], triangles[1::2]])
    return triangles


def vertices_of(
    corners: NDArray[np.int64], triangles: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the different corners (N, 3) that triangles use, in the order of their vertices, and
    the triangles as indices into them."""
    used = corners[triangles.reshape(-1)]
    keys = used[:, 0]
    for column in used[:, 1:].T:
        size = int(column.max()) + 2
        if int(keys.max()) * size > 1 << 62:
            keys = np.unique(keys, return_inverse=True)[1]
        keys = keys * size + column + 1
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return used[first], inverse.reshape(-1, 3)
