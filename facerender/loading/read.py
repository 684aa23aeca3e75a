"""Read mesh files as pieces: this package reads glTF, trimesh reads the other formats."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from threading import get_ident
from typing import TYPE_CHECKING, Any

import numpy as np

from facerender.errors import InputError, clipped, reason, warn
from facerender.loading.from_trimesh import has_normals, piece_of
from facerender.loading.gltf import read_gltf
from facerender.loading.gltf_document import damaged
from facerender.loading.materials import image_of, missing_image, unreadable
from facerender.loading.obj import has_relative, number_vertices, with_absolute, with_parts
from facerender.loading.references import TEXTURE_FILE, References, text_of
from facerender.loading.source import GLTF, Source, check_format
from facerender.scenes.repair import Piece, check_count
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh

    from facerender.loading.mtl import Library


_MOST_HEADER = 1 << 16  # longest header of a PLY file in bytes
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
_INDICES = ("vertex_index", "vertex_indices")
_SLACK = 16  # blank lines allowed at the end


def checked_ply(data: bytes) -> tuple[bytes, str | None]:
    """Check a PLY file. Return the content and the name of the texture or None. Edges are renamed
    in the content, because trimesh would load a file with edges as a 2D drawing.

    Raises
    ------
    ValueError : the header is damaged, or declares more elements than the bytes can hold
    """
    end = data.find(b"end_header", 0, _MOST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no PLY header")
    lines = [" ".join(line.split()) for line in text_of(data[:end]).splitlines()]
    lines = [line for line in lines if line]
    body = data[end:]
    is_text = any(line.startswith("format ascii") for line in lines)
    texture = None
    count = rows = needed = 0
    for line in lines:
        if _LINES.fullmatch(line) is None:
            raise ValueError(f"its header has the invalid line {clipped(line, 60)!r}")
        words = line.split()
        if words[0] == "element":
            count = int(words[2])
            rows += count
        elif words[0] == "property":
            needed += count * _least_bytes(words, is_text)
        elif (comment := TEXTURE_FILE.fullmatch(line.encode())) is not None:
            texture = comment[1].decode()
    if needed > len(body):
        raise ValueError(f"its header declares at least {needed} bytes, but it has {len(body)}")
    if is_text and body.count(b"\n") > rows + _SLACK:
        raise ValueError(f"its header declares {rows} lines, but it has more")
    renamed = [line.replace("element edge ", "element line ") for line in lines]
    return "\n".join([*renamed, ""]).encode() + body, texture


def _least_bytes(words: list[str], is_text: bool) -> int:
    """Return the minimum size of a property's value in bytes; the vertex list of a face has at
    least 3 entries."""
    if words[1] != "list":
        return 2 if is_text else _BYTES[words[1]]
    entries = 3 if words[4] in _INDICES else 0
    return 2 * (1 + entries) if is_text else _BYTES[words[2]] + entries * _BYTES[words[3]]


def check_faces(metadata: Mapping[str, Any]) -> None:
    """Check the faces of a PLY file, which trimesh stores before it splits faces into triangles.

    Raises
    ------
    ValueError : faces have different numbers of corners, or a face has texture coordinates and a
        negative vertex index
    """
    # "_ply_raw" is private to trimesh, but only this entry stores the faces before the split.
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
    has_uv = any(key in elements["vertex"]["properties"] for key in ("s", "u", "texture_u"))
    has_uv = has_uv or "texcoord" in elements["face"]["properties"]
    if has_uv and column.dtype != object and column.size and column.min() < 0:
        raise ValueError(f"a face uses vertex {column.min()}")


_SOLIDS = re.compile(rb"endsolid", re.IGNORECASE)
_OPTIONS = {".ply": {"skip_materials": True}, ".obj": {"split_objects": True}}  # trimesh options
_TRIANGLE = 50  # bytes per triangle of a binary STL file, after a header of 84 bytes


def read(source: Source, albedo_given: bool, allow_outside: bool) -> tuple[list[Piece], References]:
    """Return a piece for every geometry with faces, and the files to which the source refers.

    albedo_given : whether the caller replaces albedo maps, which may then be missing or unreadable

    Raises
    ------
    InputError : the file, or a required referenced file, cannot be used
    """
    data = source.read()
    suffix, name = source.suffix, source.name
    if not data:
        raise InputError(f"{name} is an empty file; give a mesh file")
    check_format(data, suffix, name)
    references = References(name, source.folder, allow_outside)
    if suffix in GLTF:
        pieces = read_gltf(data, references, albedo_given)
        if not pieces:
            raise _no_faces(name, points=False)
        return pieces, references
    try:
        import trimesh  # noqa: F401  # creates the loggers that _quiet filters

        with _quiet():
            if suffix == ".obj":
                pieces = _read_obj(data, name, references, albedo_given)
            else:
                pieces = _read_ply_or_stl(data, name, suffix, references, albedo_given)
    except InputError:
        raise
    except Exception as error:  # trimesh's readers raise many exceptions for damaged files
        raise damaged(name, reason(error)) from None
    return pieces, references


def _no_faces(name: str, points: bool) -> InputError:
    content = "only points and no faces" if points else "no geometry"
    return InputError(f"{name} has {content}; give a triangle mesh")


def _read_ply_or_stl(
    data: bytes, name: str, suffix: str, references: References, albedo_given: bool
) -> list[Piece]:
    texture = None
    if suffix == ".ply":
        data, texture = checked_ply(data)
    else:
        check_count(len(_SOLIDS.findall(data)), name)
        data = _checked_stl(data, name)
    geometries = [*_geometries(data, suffix, name).values()]
    if texture is not None:
        _give_texture(geometries, texture, references, not albedo_given)
    textures: dict[int, Texture] = {}
    lost = bool(references.missing())
    pieces = [piece_of(geometry, name, textures, lost) for geometry in geometries]
    _clear(*geometries)
    check_count(len(pieces), name)
    _warn_of_missing(references, albedo_given)
    return pieces


def _read_obj(data: bytes, name: str, references: References, albedo_given: bool) -> list[Piece]:
    from facerender.loading.mtl import Library

    data = text_of(data).encode()
    library = Library(data, references, name, albedo_given)
    data, names = with_parts(data, name)
    check_count(len(names), name)
    out_of_range = 0
    if has_relative(data):
        data, out_of_range = with_absolute(data)
    try:
        geometries = _geometries(data, ".obj", name, library)
        lost = _lost_references(data, [*geometries.values()])
    except InputError:
        raise
    except Exception:  # trimesh raises several exceptions for an invalid reference
        lost = True
    if lost:
        data, dropped = with_absolute(data)
        out_of_range += dropped
        if out_of_range and re.search(rb"^f[ \t]", data, re.MULTILINE) is None:
            raise ValueError(f"none of its {out_of_range} faces has valid references")
        geometries = _geometries(data, ".obj", name, library)
    pieces: list[tuple[int, Piece]] = []
    for key, geometry in geometries.items():
        number = int(key.partition("_")[0]) if len(names) > 1 else 0
        pieces.append((number, piece_of(geometry, name, {}, False, library)))
        pieces[-1][1].name = names[number]
    pieces[0][1].out_of_range += out_of_range
    _clear(*geometries.values())
    pieces.sort(key=lambda pair: pair[0])
    number_vertices(data, [piece for _, piece in pieces])
    parts = [
        part for _, piece in pieces for part in _with_tiles(piece, piece.material_name, library)
    ]
    check_count(len(parts), name)
    _warn_of_missing(references, albedo_given)
    return parts


def _warn_of_missing(references: References, albedo_given: bool) -> None:
    if not albedo_given:
        for missing in references.missing():
            missing_image(references, missing)


def _clear(*loaded: object) -> None:
    """Clear trimesh objects. They form reference cycles, which would keep vertices and maps in
    memory until the garbage collector runs."""
    for trimesh_object in loaded:
        vars(trimesh_object).clear()


def _with_tiles(piece: Piece, material: str, library: Library) -> Sequence[Piece]:
    """Return the part of a piece on each UDIM tile; the piece itself if it has no UDIM maps."""
    tiles = library.tiles(material, piece)
    return [*library.split(piece, material, tiles)] if tiles else [piece]


def _geometries(
    data: bytes, suffix: str, name: str, library: Library | None = None
) -> dict[str, trimesh.Trimesh]:
    """Return the geometries with faces, keyed by trimesh's names; InputError if there are none."""
    import trimesh

    scene = trimesh.load_scene(
        trimesh.util.wrap_as_stream(data),
        file_type=suffix[1:],
        resolver=None if library is None else _MaterialNames(library, name),
        process=False,
        **_OPTIONS.get(suffix, {}),
    )
    names = (scene.graph[node][1] for node in scene.graph.nodes_geometry)
    instances = {key: scene.geometry[key] for key in names}
    geometries = {
        key: geometry
        for key, geometry in instances.items()
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces)
    }
    if not geometries:
        points = any(len(getattr(geometry, "vertices", ())) for geometry in scene.geometry.values())
        raise _no_faces(name, points)
    _clear(scene)
    for geometry in geometries.values():
        check_faces(geometry.metadata)
    return geometries


def _lost_references(data: bytes, geometries: list[trimesh.Trimesh]) -> bool:
    """Return whether an OBJ file has texture coordinates or normals that trimesh lost."""
    uv, normals = (
        re.search(pattern, data, re.MULTILINE) is not None
        for pattern in (rb"^f[ \t]+\d+/\d", rb"^f[ \t]+\d+/\d*/\d")
    )
    return any(
        (uv and getattr(geometry.visual, "uv", None) is None)
        or (normals and not has_normals(geometry))
        for geometry in geometries
    )


class _MaterialNames:
    """A resolver that gives trimesh only material names; this package reads the MTL files."""

    def __init__(self, library: Library, name: str) -> None:
        self.library, self.file_name = library, name

    def get(self, name: str) -> bytes:
        return self.library.text

    __getitem__ = get


def _give_texture(
    geometries: Sequence[trimesh.Trimesh], texture: str, references: References, fatal: bool
) -> None:
    """Assign the texture of a PLY file to its geometries.

    fatal : whether a texture that is not an image raises InputError instead of a warning
    """
    try:
        content = references.read(texture, "an image file")
    except FileNotFoundError:
        return
    try:
        image = image_of(content)
    except ValueError as error:
        unreadable(f"{clipped(texture, 80)} (named by {references.name})", "albedo", error, fatal)
        return
    image.info["file_path"] = texture
    for geometry in geometries:
        if geometry.visual.kind == "texture":
            geometry.visual.material.image = image


def _checked_stl(data: bytes, name: str) -> bytes:
    """Return the content of an STL file: text in UTF-8, or binary data without the bytes after
    the last triangle.

    Raises
    ------
    ValueError : a binary file is too short
    """
    if len(data) < 84 or (data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1024]):
        return text_of(data).encode()
    (count,) = struct.unpack_from("<I", data, 80)
    needed = 84 + _TRIANGLE * count
    if needed > len(data):
        raise ValueError(f"{count} triangles need {needed} bytes, but it has {len(data)}")
    if needed < len(data):
        warn(f"{name} has {len(data) - needed} bytes after its {count} triangles: ignored")
    return data[:needed]


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress trimesh's log messages in this thread: this package emits its own warnings."""
    me = get_ident()

    def is_of_another(record: logging.LogRecord) -> bool:
        return record.thread != me

    loggers = [
        logger
        for name, logger in logging.root.manager.loggerDict.items()
        if name.partition(".")[0] == "trimesh" and isinstance(logger, logging.Logger)
    ]
    for logger in loggers:
        logger.addFilter(is_of_another)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(is_of_another)
