"""Mesh files as pieces: glTF read here, the other formats by trimesh, and what it would pass
over."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from threading import get_ident
from typing import TYPE_CHECKING

import numpy as np

from facerender.errors import InputError, clipped, reason, warn
from facerender.loading.given import GLTF, Given
from facerender.loading.gltf import read_gltf
from facerender.loading.gltf_schema import damaged
from facerender.loading.images import image_of, missing_image, unreadable
from facerender.loading.kinds import check_kind
from facerender.loading.obj import has_relative, with_absolute, with_parts
from facerender.loading.ply import check_faces, checked_ply
from facerender.loading.referred import Referred
from facerender.loading.translate import piece_of
from facerender.scenes.repair import Piece, check_count
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh

    from facerender.loading.mtl import Library

_SOLIDS = re.compile(rb"endsolid", re.IGNORECASE)
_OPTIONS = {".ply": {"skip_materials": True}, ".obj": {"split_objects": True}}  # of trimesh
_TRIANGLE = 50  # bytes in a binary STL file, behind a header of 84


def read(source: Given, without_albedo: bool, allow_outside: bool) -> tuple[list[Piece], Referred]:
    """Return every instance of a geometry with faces, and the files that were referred to.

    without_albedo : the albedo of the file is not wanted

    Raises
    ------
    InputError : the file, or one that it refers to and that is needed, cannot be used
    """
    data = source.read()
    suffix, name = source.kind, source.name
    if not data:
        raise InputError(f"{name} is an empty file: there is no geometry in it")
    check_kind(data, suffix, name)
    referred = Referred(name, source.folder, allow_outside)
    if suffix in GLTF:
        pieces = read_gltf(data, referred, without_albedo)
        if not pieces:
            raise _no_faces(name, points=False)
        return pieces, referred
    try:
        import trimesh  # noqa: F401  # its loggers are there then

        with _quiet():
            pieces = _by_trimesh(data, name, suffix, referred, without_albedo)
    except InputError:
        raise
    except Exception as error:  # each reader of trimesh fails in its own way on a damaged file
        raise damaged(name, reason(error)) from None
    return pieces, referred


def _no_faces(name: str, points: bool) -> InputError:
    what = "are only points and no faces" if points else "is no geometry"
    return InputError(f"there {what} in {name}; give a triangle mesh")


def _by_trimesh(
    data: bytes, name: str, suffix: str, referred: Referred, without_albedo: bool
) -> list[Piece]:
    texture = None
    strangers = 0
    names = [""]
    library = None
    if suffix == ".ply":
        data, texture = checked_ply(data)
    elif suffix == ".stl":
        check_count(len(_SOLIDS.findall(data)), name)
        data = _checked_stl(data, name)
    else:
        from facerender.loading.mtl import Library

        library = Library(data, referred, name, without_albedo)
        data, names = with_parts(data, name)
        check_count(len(names), name)
        if has_relative(data):
            data, strangers = with_absolute(data)
    resolver = _Resolver(referred, library)
    try:
        geometries = _geometries(data, suffix, name, resolver)
        lost = suffix == ".obj" and _lost_references(data, [*geometries.values()])
    except InputError:
        raise
    except Exception:
        if suffix != ".obj":
            raise
        lost = True
    if lost:  # a reference to what is not there
        data, more = with_absolute(data)
        strangers += more
        if strangers and re.search(rb"^f[ \t]", data, re.MULTILINE) is None:
            raise ValueError(f"no vertex of its {strangers} faces is there")
        geometries = _geometries(data, suffix, name, resolver)
    if referred.refused:
        raise referred.refused[0]
    if texture is not None:
        _give_texture([*geometries.values()], resolver, texture)
    for each in dict.fromkeys(resolver.broken):
        unreadable(f"{clipped(each, 80)} (named by {name})", "albedo", not without_albedo)
    textures: dict[int, Texture] = {}
    lost = library is None and bool(referred.missing())
    pieces = [piece_of(each, name, textures, lost, library) for each in geometries.values()]
    pieces[0].strangers += strangers
    numbers = [0] * len(pieces)
    if len(names) > 1:
        numbers = [int(each.partition("_")[0]) for each in geometries]
    for piece, number in zip(pieces, numbers, strict=True):
        piece.name = names[number]
    materials = [_material_name(each) for each in geometries.values()]
    for each in geometries.values():
        _empty(each)
    found = [
        part
        for i in np.argsort(numbers, kind="stable")
        for part in _with_tiles(pieces[i], materials[i], library)
    ]
    check_count(len(found), name)
    if not without_albedo:
        for missing in referred.missing():
            missing_image(referred, missing)
    return found


def _empty(loaded: object) -> None:
    """Take all from what trimesh has loaded: it refers to itself, and would keep vertices and maps
    until the garbage collector comes."""
    vars(loaded).clear()


def _material_name(geometry: trimesh.Trimesh) -> str:
    return str(getattr(getattr(geometry.visual, "material", None), "name", ""))


def _with_tiles(piece: Piece, material: str, library: Library | None) -> Iterator[Piece]:
    """Yield a piece, or what of it lies on each tile of UDIM, where its maps have several."""
    tiles = {} if library is None else library.tiles(material, piece)
    if library is None or not tiles:
        yield piece
        return
    yield from library.split(piece, material, tiles)


def _geometries(
    data: bytes, suffix: str, name: str, resolver: _Resolver
) -> dict[str, trimesh.Trimesh]:
    """Return what has faces in a file, at least one, by trimesh's names."""
    import trimesh

    scene = trimesh.load_scene(
        trimesh.util.wrap_as_stream(data),
        file_type=suffix[1:],
        resolver=resolver,
        process=False,
        **_OPTIONS.get(suffix, {}),
    )
    names = (scene.graph[node][1] for node in scene.graph.nodes_geometry)
    instances = {each: scene.geometry[each] for each in names}
    found = {
        key: each
        for key, each in instances.items()
        if isinstance(each, trimesh.Trimesh) and len(each.faces)
    }
    if not found:
        points = any(len(getattr(each, "vertices", ())) for each in scene.geometry.values())
        raise _no_faces(name, points)
    _empty(scene)
    for each in found.values():
        check_faces(each.metadata)
    return found


def _lost_references(data: bytes, geometries: list[trimesh.Trimesh]) -> bool:
    """Whether faces of an OBJ file name texture coordinates or normals that have not come."""
    uv, normals = (
        re.search(pattern, data, re.MULTILINE) is not None
        for pattern in (rb"^f[ \t]+\d+/\d", rb"^f[ \t]+\d+/\d*/\d")
    )
    return any(
        (uv and getattr(each.visual, "uv", None) is None)
        or (normals and "vertex_normals" not in each._cache.cache)
        for each in geometries
    )


class _Resolver:
    """Reads for trimesh what is referred to, of an OBJ file the names of materials alone, and
    remembers what is no image, which it passes over."""

    def __init__(self, referred: Referred, library: Library | None) -> None:
        self.referred = referred
        self.library = library
        self.broken: list[str] = []
        self.file_name = referred.name

    def get(self, name: str) -> bytes:
        if self.library is not None:
            return self.library.text
        content = self.referred.read(name, "an image file")
        try:
            image_of(content)
        except ValueError:
            self.broken.append(name)
        return content

    __getitem__ = get


def _give_texture(geometries: list[trimesh.Trimesh], resolver: _Resolver, name: str) -> None:
    """Give the geometries of a PLY file its texture."""
    try:
        image = image_of(resolver.referred.read(name, "an image file"))
    except FileNotFoundError:
        return
    except InputError:
        raise
    except ValueError:
        resolver.broken.append(name)
        return
    image.info["file_path"] = name
    for geometry in geometries:
        if geometry.visual.kind == "texture":
            geometry.visual.material.image = image


def _checked_stl(data: bytes, name: str) -> bytes:
    """Return an STL file, without what lies behind the triangles of a binary one.

    Raises
    ------
    ValueError : it is binary and too short
    """
    if len(data) < 84 or (data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1024]):
        return data
    (count,) = struct.unpack_from("<I", data, 80)
    needed = 84 + _TRIANGLE * count
    if needed > len(data):
        raise ValueError(f"{count} triangles need {needed} bytes, it has {len(data)}")
    if needed < len(data):
        warn(f"{name} has {len(data) - needed} bytes behind its {count} triangles: left out")
    return data[:needed]


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what trimesh logs in this thread off standard error: whatever matters is told by us."""
    me = get_ident()

    def is_of_another(record: logging.LogRecord) -> bool:
        return record.thread != me

    loggers = [
        each
        for name, each in logging.root.manager.loggerDict.items()
        if name.partition(".")[0] == "trimesh" and isinstance(each, logging.Logger)
    ]
    for each in loggers:
        each.addFilter(is_of_another)
    try:
        yield
    finally:
        for each in loggers:
            each.removeFilter(is_of_another)
