"""Read mesh files as pieces: this package reads glTF, trimesh reads the other formats."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import PurePath
from threading import get_ident
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.from_trimesh import piece_of
from facerender.loading.gltf import read_gltf
from facerender.loading.gltf_document import damaged
from facerender.loading.obj import read_obj
from facerender.loading.source import (
    GLTF,
    TEXTURE_FILE,
    References,
    Source,
    check_format,
    color_bytes,
    image_of,
    missing_image,
    no_faces,
    text_of,
    unreadable,
)
from facerender.scenes.material import Material
from facerender.scenes.repair import Piece, check_count, subset, with_face_colors
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
_COLORS = ("red", "green", "blue")
_OTHER_COLORS = (
    *(("r", "g", "b"), ("Red", "Green", "Blue")),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)


def checked_ply(data: bytes, name: str) -> tuple[bytes, list[str]]:
    """Check a PLY file. Return the content and the names of its textures. Properties of colours get
    the names that trimesh reads, and edges another name, because trimesh would load a file with
    edges as a 2D drawing.

    Raises
    ------
    ValueError : the header is damaged, or declares more elements than the bytes can hold
    InputError : the file has triangle strips
    """
    end = data.find(b"end_header", 0, _MOST_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no PLY header")
    stripped = (" ".join(line.split()) for line in text_of(data[:end]).splitlines())
    lines = [*filter(None, stripped)]
    is_text = any(line.startswith("format ascii") for line in lines)
    body = text_of(data[end:]).encode() if is_text and b"\r" in data[end:] else data[end:]
    textures = []
    count = rows = needed = 0
    for line in lines:
        if _LINES.fullmatch(line) is None:
            raise ValueError(f"its header has the invalid line {clipped(line, 60)!r}")
        words = line.split()
        if words[0] == "element":
            count = int(words[2])
            rows += count
            if words[1] == "tristrips" and count:
                raise InputError(
                    f"{name} has triangle strips, which are not supported; export it with triangles"
                )
        elif words[0] == "property":
            needed += count * _least_bytes(words, is_text)
        elif (comment := TEXTURE_FILE.fullmatch(line.encode())) is not None:
            textures.append(comment[1].decode())
    if needed > len(body):
        raise ValueError(f"its header declares at least {needed} bytes, but it has {len(body)}")
    if is_text and body.count(b"\n") > rows + 16:  # allows for blank lines at the end
        raise ValueError(f"its header declares {rows} lines, but it has more")
    elements = "".join(f"{line}\n" for line in lines).split("element ")
    header = "element ".join(map(_with_known_names, elements))
    return header.replace("element edge ", "element line ").encode() + body, textures


def _with_known_names(element: str) -> str:
    """Return the header of a PLY element with names of colours that trimesh reads."""
    for names in _OTHER_COLORS:
        if " red\n" not in element and all(f" {name}\n" in element for name in names):
            for name, known in zip(names, _COLORS, strict=True):
                element = element.replace(f" {name}\n", f" {known}\n")
    return element


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
    for name in _columns(faces):
        column = faces[name]
        if isinstance(column, np.ndarray) and column.dtype.names:
            if (column["f0"] != column["f0"][:1]).any():
                raise ValueError(f"its faces have different numbers of {clipped(name, 40)}")
            column = column["f1"]
        if name not in _INDICES or column.dtype == object or not column.size:
            continue
        has_uv = any(key in elements["vertex"]["properties"] for key in ("s", "u", "texture_u"))
        has_uv = has_uv or "texcoord" in elements["face"]["properties"]
        if has_uv and column.min() < 0:
            raise ValueError(f"a face uses vertex {column.min()}")


def _columns(data: Any) -> tuple[str, ...]:
    """Return the names of the properties of an element of a PLY file, or of none."""
    return (data.dtype.names or ()) if isinstance(data, np.ndarray) else (*(data or ()),)


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
    try:
        if suffix in GLTF:
            if not (pieces := read_gltf(data, references, albedo_given)):
                raise no_faces(name, points=False)
            return pieces, references
        if suffix == ".obj":
            pieces = read_obj(data, references, albedo_given)
        else:
            pieces = _read_ply_or_stl(data, name, suffix, references, albedo_given)
        for missing in () if albedo_given else references.missing():
            missing_image(references, missing)
    except InputError:
        raise
    except (ValueError, LookupError, ArithmeticError) as error:
        raise damaged(name, reason(error)) from None
    except Exception as error:  # not a fault of the file, such as a missing package
        error.add_note(f"while reading {name}")
        raise
    return pieces, references


def _read_ply_or_stl(
    data: bytes, name: str, suffix: str, references: References, albedo_given: bool
) -> list[Piece]:
    if suffix == ".ply":
        data, names = checked_ply(data, name)
        (geometry,) = _geometries(data, suffix, name).values()
        pieces = _ply_pieces(geometry, names, references, albedo_given)
        _clear(geometry)
    else:
        check_count(len(_SOLIDS.findall(data)), name)
        geometries = _geometries(_checked_stl(data, name), suffix, name).values()
        pieces = [piece_of(geometry, name, {}, False) for geometry in geometries]
        _clear(*geometries)
    check_count(len(pieces), name)
    return pieces


def _ply_pieces(
    geometry: trimesh.Trimesh, names: Sequence[str], references: References, albedo_given: bool
) -> list[Piece]:
    """Return a piece for each texture of a PLY file, or one piece without textures.

    names : names of the textures. The face property texnumber is an index into them
    """
    file, visual = references.name, geometry.visual
    colors = {of: _ply_values(geometry, of, _COLORS) for of in ("vertex", "face")}
    if all(colors.values()):
        warn(f"{file} has colours of vertices and of faces: the vertex colours are drawn")
    for of, values in colors.items():
        if values and visual.kind == of:
            setattr(visual, f"{of}_colors", color_bytes(np.stack(values, axis=1)))
    materials = [_ply_material(name, references, not albedo_given) for name in names]
    numbers = _ply_values(geometry, "face", ("texnumber",)) if len(names) > 1 else None
    if numbers:
        geometry.face_attributes["texnumber"] = numbers[0]
    sources = _ply_sources(geometry)
    piece = piece_of(geometry, file, {}, bool(references.missing()))
    if sources is not None:
        piece.sources = sources
        piece.source_count = geometry.metadata["_ply_raw"]["vertex"]["length"]
    if not any(materials):
        # trimesh drops the colours of a file with texture coordinates, whose vertices it may split.
        of, values = next(((of, values) for of, values in colors.items() if values), ("", None))
        if sources is None or piece.out_of_range or not values:
            return [piece]
        levels = srgb_to_linear(color_bytes(np.stack(values, axis=1)) / 255.0)
        piece.material = Material(albedo=(1.0, 1.0, 1.0))
        if of == "face":
            return [with_face_colors(piece, levels)]
        piece.colors = levels[sources]
        return [piece]
    if piece.uv is None:
        warn(f"{file} has no texture coordinates: its texture is ignored")
        return [piece]
    if not numbers:
        if len(names) > 1:
            warn(
                f"{file} names {len(names)} textures, but its faces have no texnumber: all get "
                f"{clipped(names[0], 60)}"
            )
        return [replace(piece, material=materials[0] or piece.material)]
    number = geometry.face_attributes["texnumber"]
    pieces = []
    for value in np.unique(number).astype(np.int64).tolist():
        part = subset(piece, number == value)
        if 0 <= value < len(names):
            part.name = PurePath(names[value]).stem
            part.material = materials[value] or part.material
        else:
            part.name = ""
            warn(f"{file} has {len(part.faces)} faces whose texnumber {value} names no texture")
        pieces.append(part)
    pieces[0].out_of_range = piece.out_of_range
    return pieces


def _ply_values(
    geometry: trimesh.Trimesh, element: str, names: Sequence[str]
) -> list[NDArray[Any]] | None:
    """Return properties of a PLY file's vertices, or for each triangle, properties of its face;
    None if the file lacks one of them."""
    data = geometry.metadata["_ply_raw"].get(element, {}).get("data")
    if not {*names} <= {*_columns(data)}:
        return None
    columns = [np.asarray(data[name]).reshape(-1) for name in names]
    if element == "vertex":
        return columns
    counts = np.array([len(face) for face in _ply_corners(geometry)])
    triangles, quads, others = (np.flatnonzero(m) for m in (counts == 3, counts == 4, counts > 4))
    # The order of trimesh.geometry.triangulate_quads, which also makes fans of polygons.
    owners = [triangles, quads, quads, np.repeat(others, counts[others] - 2)]
    return [column[np.concatenate(owners)] for column in columns]


def _ply_corners(geometry: trimesh.Trimesh) -> NDArray[Any]:
    """Return the vertices of each face of a PLY file, (F, K), or objects for different K."""
    data = geometry.metadata["_ply_raw"]["face"]["data"]
    corners = next(np.asarray(data[name]) for name in _INDICES if name in _columns(data))
    return np.asarray(corners["f1"]) if corners.dtype.names else corners


def _ply_sources(geometry: trimesh.Trimesh) -> NDArray[np.int64] | None:
    """Return the index of each vertex in the PLY file, if trimesh has split the vertices at seams
    of the texture."""
    from trimesh.geometry import triangulate_quads

    if getattr(geometry.visual, "uv", None) is None:
        return None
    corners = triangulate_quads(_ply_corners(geometry))
    count = geometry.metadata["_ply_raw"]["vertex"]["length"]
    if corners.shape != geometry.faces.shape or not 0 <= corners.min() <= corners.max() < count:
        return None
    sources = np.zeros(len(geometry.vertices), dtype=np.int64)
    sources[geometry.faces] = corners
    return sources


def _ply_material(name: str, references: References, fatal: bool) -> Material | None:
    """Return a material with a texture of a PLY file, or None if the texture is missing.

    fatal : whether a texture that is not an image raises InputError instead of a warning
    """
    try:
        content = references.read(name, "an image file")
    except FileNotFoundError:
        return None
    try:
        image_of(content)
    except ValueError as error:
        unreadable(f"{clipped(name, 80)} (named by {references.name})", "albedo", error, fatal)
        return None
    return Material(albedo=(1.0, 1.0, 1.0), albedo_map=Texture.of(content, clipped(name, 80)))


def _clear(*loaded: object) -> None:
    """Clear trimesh objects. They form reference cycles, which would keep vertices and maps in
    memory until the garbage collector runs."""
    for trimesh_object in loaded:
        vars(trimesh_object).clear()


def _geometries(
    data: bytes, suffix: str, name: str, library: Library | None = None
) -> dict[str, trimesh.Trimesh]:
    """Return the geometries with faces, keyed by trimesh's names; InputError if there are none."""
    import trimesh

    try:
        scene = trimesh.load_scene(
            trimesh.util.wrap_as_stream(data),
            file_type=suffix[1:],
            resolver=library,
            process=False,
            **_OPTIONS.get(suffix, {}),
        )
    except (ImportError, MemoryError):
        raise
    except Exception as error:  # trimesh's readers raise many exceptions for damaged files
        if "unexpected length" in str(error):
            raise InputError(
                f"{name} has faces with different numbers of corners, or lacks bytes: export it "
                "with triangles only, or as text"
            ) from None
        raise ValueError(reason(error)) from None
    names = (scene.graph[node][1] for node in scene.graph.nodes_geometry)
    geometries = {
        name: geometry
        for name in names
        if isinstance(geometry := scene.geometry[name], trimesh.Trimesh) and len(geometry.faces)
    }
    if not geometries:
        points = any(len(getattr(geometry, "vertices", ())) for geometry in scene.geometry.values())
        raise no_faces(name, points)
    _clear(scene)
    for geometry in geometries.values():
        check_faces(geometry.metadata)
    return geometries


def _checked_stl(data: bytes, name: str) -> bytes:
    """Return the content of an STL file: text in UTF-8, or binary data without the bytes after
    the last triangle. Raise ValueError if a binary file is too short."""
    if len(data) < 84 or (data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1024]):
        return text_of(data).encode()
    (count,) = struct.unpack_from("<I", data, 80)
    needed = 84 + _TRIANGLE * count
    if needed > len(data):
        raise ValueError(f"{count} triangles need {needed} bytes, but it has {len(data)}")
    if needed < len(data):
        warn(f"{name} has {len(data) - needed} bytes after its {count} triangles: ignored")
    # VisCAM sets bit 15 of a coloured triangle's last word. Magics writes COLOR= in the header.
    words = np.frombuffer(data, "<u2", count * (_TRIANGLE // 2), 84).reshape(count, -1)
    if b"COLOR=" in data[:80] or (words[:, -1:] >> 15).any():
        warn(f"{name} has colours of triangles, which are not read: export it as .ply or .glb")
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
