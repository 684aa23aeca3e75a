"""Read OBJ files, and the materials and maps of their MTL files. Lines of an OBJ file are parsed as
arrays of bytes: an interpreted loop over the lines of a scan takes seconds. The reader keeps the
objects, groups and materials of the faces, and the number that each vertex has in the file, which
files of landmarks and of vertex positions use.

References: Wavefront Technologies (1992), Advanced Visualizer, appendix B1, Object Files.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.conventions import preset_for
from facerender.loading.source import References, color_bytes, no_faces, text_of
from facerender.material import MAPS, MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Material
from facerender.mesh.repair import Piece, check_count
from facerender.terms.lobe import MAX_SLOPE, MIN_SLOPE
from facerender.texture.texture import Texture
from facerender.values.vectors import MAX_RADIANCE, Vector

if TYPE_CHECKING:
    from PIL.Image import Image

_INDENT, _COMMENT = re.compile(r"^ +", re.MULTILINE), re.compile(rb"#[^\n]*")
_MAX_GROUPS = 256  # maximum number of parts: each part needs a draw call
_SPACE, _NEWLINE = b" \n"
Float = NDArray[np.float64]
Indices = NDArray[np.int64]
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

    def numbers(self, key: bytes) -> Indices:
        """Return the indices of the lines whose first word is ``key``."""
        lines = np.flatnonzero(self.ends - self.starts > len(key))
        for offset, character in enumerate(key + b" "):
            lines = lines[self.characters[self.starts[lines] + offset] == character]
        return lines

    def content(self, key: bytes) -> bytes:
        """Return the lines whose first word is ``key``, blanking this word, without comments."""
        lines, lengths = self.numbers(key), self.ends - self.starts + 1
        mask = np.zeros(len(lengths), dtype=bool)
        mask[lines] = True
        content = self.characters[np.repeat(mask, lengths)]
        starts = np.cumsum(lengths[lines]) - lengths[lines]
        for offset in range(len(key)):
            content[starts + offset] = _SPACE
        text = content.tobytes()
        return _COMMENT.sub(b"", text) if b"#" in text else text

    def table(self, key: bytes, width: int) -> tuple[Float, Indices]:
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


def _word_starts(characters: NDArray[np.uint8]) -> Indices:
    """Return the indices of the first characters of words; the text begins with a space."""
    solid = characters > _SPACE
    return np.flatnonzero(solid[1:] & ~solid[:-1]) + 1


def _numbers(text: bytes, dtype: type[np.number[Any]]) -> NDArray[Any]:
    """Return the numbers of a text up to the first invalid one."""
    try:
        return np.fromstring(text, dtype, sep=" ")
    except (ValueError, DeprecationWarning):
        return np.empty(0, dtype)


def _colors(vertices: Float, counts: Indices, name: str) -> NDArray[np.uint8] | None:
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


def _parts(owners: Sequence[_Keys], spans: Indices, name: str) -> tuple[list[_Keys], Indices]:
    """Return the parts' names in file order, and each face's part, from its index in ``owners``."""
    used, inverse = np.unique(spans, return_inverse=True)
    keys = [owners[i] for i in used]
    parts = [*dict.fromkeys(keys)]
    if len(parts) > _MAX_GROUPS:
        joined = [("", "", material) for *_, material in keys]
        if len({*joined}) < len(parts):
            problem = f"{len(parts)} groups with faces, but the limit is {_MAX_GROUPS} parts"
            warn(f"{name} has {problem}: groups of the same material are joined")
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


def _faces(lines: _Lines, totals: Sequence[int]) -> tuple[Indices, Indices, int]:
    """Return the corners of the faces, (C, 3): indices of vertex, texture coordinate and normal, -1
    if missing; the faces, (F, 3): index of the line, index of the first corner, number of corners;
    and the number of dropped faces, which have fewer than three corners or an invalid reference.
    The file has ``totals`` vertices, texture coordinates and normals."""
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


def triangles_of(first: Indices, counts: Indices) -> Indices:
    """Return the corners (T, 3) of the triangles of polygons, as fans around the first corner. A
    polygon is given by the index of its first corner and its number of corners, (F,)."""
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


def vertices_of(corners: Indices, triangles: Indices) -> tuple[Indices, Indices]:
    """Return the used corners (N, 3) in the order of their vertices, and triangles of these."""
    used = corners[triangles.reshape(-1)]
    keys = used[:, 0]
    for column in used[:, 1:].T:
        size = int(column.max()) + 2
        if int(keys.max()) * size > 1 << 62:
            keys = np.unique(keys, return_inverse=True)[1]
        keys = keys * size + column + 1
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return used[first], inverse.reshape(-1, 3)


# Height of white above black in a bump map, as a fraction of the map's width. The height is 2.5 mm
# for a map that wraps once around a head of 500 mm circumference. MTL defines no unit of height.
DEPTH = 0.005
_STRIP = 256  # rows of a bump map converted at a time


def _is_normal_map(image: Image) -> bool:
    """Return whether a bump map has normals, not heights: it is bluish, with unit vectors."""
    if image.mode not in ("RGB", "RGBA", "P"):
        return False
    levels = np.asarray(image.convert("RGB").resize((64, 64)), dtype=np.float64)
    if np.ptp(levels, axis=-1).mean() < 8.0:  # a grey image, with compression errors
        return False
    normals = levels / 127.5 - 1.0
    length = np.linalg.norm(normals, axis=-1)
    return bool((np.abs(length - 1.0) < 0.25).mean() > 0.9 and normals[..., 2].mean() > 0.5)


def _normals(image: Image) -> Image:
    """Convert heights in any image mode to a normal map with green up."""
    from PIL import Image as images

    deep = image.mode.startswith(("I", "F"))
    heights = np.asarray(image if deep else image.convert("L"))
    scale = 1.0 if image.mode == "F" else 65535.0 if deep else 255.0
    height, width = heights.shape
    normals = np.empty((height, width, 3), dtype=np.uint8)
    for top in range(0, height, _STRIP):
        start, end = max(top - 1, 0), min(top + _STRIP, height)
        rows = heights[start : end + 1].astype(np.float32) * np.float32(DEPTH / scale)
        rows = np.pad(rows, [(0, size < 2) for size in rows.shape], "edge")  # a slope of 0
        down, right = (slope[top - start : end - start, :width] for slope in np.gradient(rows))
        # A normal's x is minus the slope; y is plus the slope, because rows run down and y up.
        slopes = np.stack([-right * width, down * height], axis=-1)
        length = np.sqrt(1.0 + (slopes**2).sum(axis=-1, keepdims=True))
        unit = np.concatenate([slopes, np.ones_like(length)], axis=-1) / length
        normals[top:end] = np.round(unit * 127.5 + 127.5)
    result = images.fromarray(normals)
    result.info["heights"] = True  # its green points up, whatever the direction in normal maps
    return result


# Keyed by statement: field of the material, name in messages. If a material has several statements
# for a field, the first of them in this table is used.
_MAPS = {
    "map_kd": ("albedo_map", "albedo"),
    "map_d": ("opacity_map", "opacity"),
    "norm": ("normal_map", "normal"),
    "map_bump": ("normal_map", "bump"),
    "bump": ("normal_map", "bump"),
    "map_ks": ("specular_map", "specular"),
    "map_ke": ("emissive_map", "emission"),
    "map_pr": ("roughness_map", "roughness"),
}
# Keyed by option of a map: number of words after the option; the last of 2 or 3 may be missing.
_FLAGS = ("-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type")
_OPTIONS = {**dict.fromkeys(_FLAGS, 1), "-mm": 2, "-o": 3, "-s": 3, "-t": 3}
# Ignored options, each with the value that has no effect; other values cause a warning.
_UNREAD = {"-cc": "off", "-boost": "0", "-blendu": "on", "-blendv": "on"}
# Statements that are read, and statements without an effect except on ambient light.
_KNOWN = {"kd", "ks", "ns", "ke", "d", "tr", "tf", "pr", *_MAPS}
_KNOWN |= {"ka", "map_ka", "illum", "ni", "sharpness", "map_aat"}
_LAYERS = {"pm", "ps", "pc", "pcr", "aniso", "anisor"}  # not supported; no effect if 0


@dataclass
class MapStatement:
    """The statement of a map: file name and options."""

    name: str = ""
    scale: tuple[float, ...] = (1.0, 1.0)  # of texture coordinates; v points up
    offset: tuple[float, ...] = (0.0, 0.0)
    clamp: bool = False
    strength: float = 1.0
    channel: str = ""


class Library:
    """The materials of an OBJ file."""

    def __init__(self, names: Iterable[str], referred: References, albedo_given: bool) -> None:
        """Read the MTL files with the names after mtllib; errors as of :meth:`References.read`."""
        self.referred = referred
        self.name = referred.name
        self.albedo_given = albedo_given
        self.materials: dict[str, dict[str, str]] = {}
        self.textures: dict[tuple[Any, ...], Texture | None] = {}
        self.images: dict[str, Texture] = {}
        self.warn = cache(warn)  # emits each warning once
        for line in dict.fromkeys(names):
            if not self._parse(line) and True in [self._parse(word) for word in line.split()]:
                del referred.files[line]  # not one name, but several

    def _parse(self, name: str) -> bool:
        """Read the statements of an MTL file. Return whether the file was found."""
        try:
            text = text_of(self.referred.read(name, "an MTL file"))
        except FileNotFoundError:
            return False
        statements: dict[str, str] = {}
        for line in text.splitlines():
            key, _, arguments = line.strip().partition("#")[0].replace("\t", " ").partition(" ")
            key, arguments = key.lower(), arguments.strip()
            if key == "newmtl":
                statements = self.materials.setdefault(" ".join(arguments.split()), {})
            elif arguments:
                statements[key] = arguments.replace("-halo", "") if key == "d" else arguments
        return True

    def matched(self, names: Sequence[str]) -> list[str]:
        """Return a material for the name that each part of the OBJ file has, which is "" without
        usemtl. If all parts have one name, they get the only material of an MTL file. Warn of names
        that the MTL file lacks."""
        valid_names, missing = [*self.materials], sorted({*names} - self.materials.keys())
        if not valid_names or not missing:
            return [*names]
        listing = clipped(", ".join(valid_names), 120)
        if len(valid_names) == len({*names}) == 1:
            if names[0]:
                used = f"{self.name} uses the material {clipped(names[0], 60)}"
                self.warn(f"{used}, but its MTL has only {listing}: this is used")
            return valid_names * len(names)
        for name in missing:
            used = f"uses the material {clipped(name, 60)}" if name else "has faces without usemtl"
            result = "drawn without a material; correct usemtl in the OBJ file"
            self.warn(f"{self.name} {used}, and its MTL has the materials {listing}: {result}")
        return [*names]

    def material_uv(self, name: str, has_colors: bool) -> tuple[Material, MapStatement]:
        """Return a material and its first map, which transforms its texture coordinates, or the
        default material if the name is not defined."""
        white = (1.0, 1.0, 1.0)
        if (statements := self.materials.get(name)) is None:
            return Material(albedo=white if has_colors else SKIN_ALBEDO), MapStatement()
        for key in statements.keys() - _KNOWN:
            if key not in _LAYERS or any(self._numbers(statements, key)):
                self.warn(f"{self.name} has {clipped(key, 40)} in its MTL: ignored")
        maps: dict[str, MapStatement] = {}
        for key, (field, _) in _MAPS.items():
            if key in statements and field not in maps:
                statement = self._options(key, statements[key])
                if statement.name:
                    maps[field] = statement
        fields: dict[str, Any] = {field: self._texture(field, s) for field, s in maps.items()}
        first = next(iter(maps.values()), MapStatement())  # that of the albedo, if there is one
        for statement in maps.values():
            if (statement.scale, statement.offset) != (first.scale, first.offset):
                subject = f"{clipped(statement.name, 80)} (named by {self.name})"
                cause = "all maps of a material have one scale and offset"
                options = f"other options -s and -o than {clipped(first.name, 80)}"
                self.warn(f"{subject} has {options}: ignored, because {cause}")
        if "normal_map" in maps:
            fields["normal_strength"] = maps["normal_map"].strength
        has_albedo_map = fields.get("albedo_map") is not None
        albedo = self._color(statements, "kd", white)
        if "map_kd" in statements and not has_albedo_map and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # the file's white multiplies only the missing map
        # With an albedo map or vertex colours, Kd is ignored: exporters write an arbitrary grey.
        fields["albedo"] = white if has_albedo_map or has_colors else albedo
        emissive = self._color(statements, "ke", (0.0, 0.0, 0.0))
        fields["emissive"] = emissive if any(emissive) or "map_ke" not in statements else white
        fields |= self._opacity(name, statements) | self._highlight(name, statements)
        return Material(**fields), first

    def _numbers(self, statements: Mapping[str, str], key: str) -> list[float]:
        """Return the numbers of a statement; an empty list if a word is not a finite number."""
        words = statements.get(key, "").split()
        if key in statements and not (words and all(map(_is_number, words))):
            self.warn(f"{self.name} has {key} {clipped(statements[key], 40)} in its MTL: ignored")
            return []
        return [float(word) for word in words]

    def _clamped(self, key: str, value: float, high: float = 1.0) -> float:
        if not 0.0 <= value <= high:
            problem = f"is outside [0, {high:g}]: clamped"
            self.warn(f"{key} {value:.6g} in the MTL of {self.name} {problem}")
        return min(max(value, 0.0), high)

    def _color(self, statements: Mapping[str, str], key: str, default: Vector) -> Vector:
        """Return a colour as linear RGB; the file stores sRGB."""
        if not (numbers := self._numbers(statements, key)):
            return default
        rgb = numbers[:3] if len(numbers) >= 3 else numbers[:1] * 3
        high = MAX_RADIANCE if key == "ke" else 1.0
        srgb = np.array([self._clamped(key, channel, high) for channel in rgb])
        red, green, blue = np.minimum(srgb_to_linear(srgb), MAX_RADIANCE).tolist()
        return red, green, blue

    def _opacity(self, name: str, statements: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields alpha and opacity. Alpha is "blend" for an opacity below 1 or a map of
        fine hairs, else "mask" with an opacity map, else "opaque"."""
        opacity = self._clamped("d", (self._numbers(statements, "d") or [1.0])[0])
        if "d" not in statements and (tr := self._numbers(statements, "tr")):
            opacity = 1.0 - self._clamped("Tr", tr[0])
            if not opacity:  # exporters that write Tr 1 for all materials mean d 1
                self.warn(f"{self.name} has Tr 1 in its MTL, fully transparent: drawn opaque")
                opacity = 1.0
        tf = self._numbers(statements, "tf")
        if any(tf) and {*tf} != {1.0}:
            self.warn(f"{self.name} has Tf (transmission) in its MTL: ignored")
        alpha = "mask" if "map_d" in statements else "opaque"
        is_hair = preset_for(name) in ("lashes", "hair-card")  # a mask makes it black or jagged
        if opacity < 1.0 or (alpha == "mask" and is_hair):
            alpha = "blend"
        return {"alpha": alpha, "opacity": opacity}

    def _highlight(self, name: str, statements: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields ks and m. m is Pr^2 or, without Pr, sqrt(2 / (Ns + 2)) with the
        Blinn-Phong exponent Ns: Walter et al. (2007), Microfacet models for refraction, 5.2."""
        fields: dict[str, Any] = {}
        ks, ns, pr = (self._numbers(statements, key) for key in ("ks", "ns", "pr"))
        if self.ignores_ks(name):
            ns = []
        elif any(ks):
            fields["ks"] = self._clamped("Ks", sum(ks[:3]) / len(ks[:3]))
        if pr and (pr[0] or "map_pr" not in statements):
            fields["m"] = max(self._clamped("Pr", pr[0]) ** 2, MIN_SLOPE)
        elif ns and ns[0] > 0.0:
            fields["m"] = min(max(math.sqrt(2.0 / (ns[0] + 2.0)), MIN_SLOPE), MAX_SLOPE)
        return fields

    def ignores_ks(self, name: str) -> bool:
        """Return whether Ks of a material is 0 without a map. Many exporters write this by default,
        so that skin gets its highlights nevertheless; see :func:`facerender.mesh.hints.no_ks`."""
        statements = self.materials.get(name, {})
        ks = self._numbers(statements, "ks")
        return bool(ks) and not any(ks) and "map_ks" not in statements

    def warn_of_tiles(self, name: str, uv: Float) -> None:
        """Warn if a map is a UDIM tile, and the faces' uv, (F, 3, 2), are on several tiles."""
        maps = [text for key, text in self.materials.get(name, {}).items() if key in _MAPS]
        if not any(re.search(r"(?<!\d)1001(?!\d)", text) for text in maps):
            return
        if (tiles := len(np.unique(np.floor(uv.mean(axis=1)), axis=0))) > 1:
            result = f"drawn on all {tiles} tiles; export one map per part"
            self.warn(f"a map of {self.name} is UDIM tile 1001: {result}")

    def _options(self, key: str, text: str) -> MapStatement:
        """Parse the statement of a map."""
        statement = MapStatement(channel="normal" if key == "norm" else "")
        words = re.findall("[^ ]+ *", text)  # keeps the spaces of file names
        while words and (option := words[0].strip().lower()) in _OPTIONS:
            values = [word.strip() for word in words[1 : 1 + _OPTIONS[option]]]
            if _OPTIONS[option] > 1:
                values = [*takewhile(_is_number, values)]
            del words[: 1 + len(values)]
            numbers = [float(value) for value in values if _is_number(value)]
            if option == "-s":
                statement.scale = (*numbers[:2], *statement.scale[len(numbers) :])
            elif option == "-o":
                statement.offset = (*numbers[:2], *statement.offset[len(numbers) :])
            elif option == "-bm" and numbers:
                statement.strength = self._clamped("-bm", numbers[0], MAX_NORMAL_STRENGTH)
            elif option == "-clamp":
                statement.clamp = values == ["on"]
            elif option == "-imfchan" and values:
                statement.channel = values[0]
            elif (
                (option == "-t" and any(numbers))
                or (option == "-mm" and numbers != [0.0, 1.0])
                or (option in _UNREAD and values != [_UNREAD[option]])
            ):
                map_name = _MAPS[key][1]
                self.warn(f"the {map_name} map of {self.name} has the option {option}: ignored")
        statement.name = "".join(words).strip().strip('"')
        return statement

    def _texture(self, field: str, statement: MapStatement) -> Texture | None:
        """Return the texture of a map, or None if its image is missing or unreadable."""
        key = field, statement.name, statement.channel, statement.clamp
        if key in self.textures:
            return self.textures[key]
        self.textures[key] = None
        map_name, silent = field.removesuffix("_map"), field == "albedo_map"
        content = self.referred.image(statement.name, map_name, not self.albedo_given, silent)
        if content is None:
            return None
        name = clipped(statement.name, 80)
        uses_alpha = field == "opacity_map" and statement.channel in ("", "m")
        if field == "normal_map" and statement.channel != "normal":
            texture = Texture.of(content, name).changed(
                lambda image: image if _is_normal_map(image) else _normals(image)
            )
        elif uses_alpha and (alpha := Texture.alpha_of(content, name)) is not None:
            texture = alpha
        else:
            texture = self.images.get(name) or Texture.of(content, name)
            self.images[name] = texture
            if field in ("opacity_map", "roughness_map", "specular_map"):
                texture = texture.channel({"g": 1, "b": 2}.get(statement.channel, 0), name)
        texture = texture.sampled(("clamp", "clamp")) if statement.clamp else texture
        self.textures[key] = texture
        return texture


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
