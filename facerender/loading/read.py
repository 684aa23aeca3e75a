"""Mesh files as pieces: glTF read here, the other formats by trimesh, and what it would pass
over."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import get_ident
from typing import TYPE_CHECKING

from facerender.errors import InputError, clipped, reason, warn
from facerender.files import read_file
from facerender.loading.gltf import read_gltf
from facerender.loading.gltf_schema import damaged
from facerender.loading.images import SUFFIXES as IMAGES
from facerender.loading.images import image_of, missing_image, unreadable
from facerender.loading.kinds import check_kind
from facerender.loading.obj import has_relative, with_absolute
from facerender.loading.ply import check_faces, checked_ply
from facerender.loading.referred import Referred
from facerender.loading.repair import Piece, check_count
from facerender.loading.translate import piece_of
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh

GLTF = (".glb", ".gltf")
SUFFIXES = (*GLTF, ".obj", ".ply", ".stl")
_MATERIALS = re.compile(rb"^[ \t]*usemtl[ \t]+(.*)", re.MULTILINE)
_SOLIDS = re.compile(rb"endsolid", re.IGNORECASE)
_TRIANGLE = 50  # bytes in a binary STL file, behind a header of 84


def read(path: Path, without_albedo: bool, allow_outside: bool) -> tuple[list[Piece], Referred]:
    """Return every instance of a geometry with faces, and the files that were referred to.

    without_albedo : the albedo of the file is not wanted

    Raises
    ------
    InputError : the file, or one that it refers to and that is needed, cannot be used
    """
    suffix = path.suffix.lower()
    shown = clipped(str(path))
    if path.is_dir():
        raise InputError(f"{shown} is a directory; give a mesh file in it")
    if suffix not in SUFFIXES:
        raise InputError(
            f"{shown}: unknown mesh format {clipped(suffix, 40)!r}; give {', '.join(SUFFIXES)}"
        )
    data = read_file(path, "a mesh file")
    name = clipped(path.name, 80)
    if not data:
        raise InputError(f"{name} is an empty file: there is no geometry in it")
    check_kind(data, suffix, name)
    referred = Referred(path, allow_outside)
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
    if suffix == ".ply":
        data, texture = checked_ply(data)
    elif suffix == ".stl":
        check_count(len(_SOLIDS.findall(data)), name)
        data = _checked_stl(data, name)
    else:
        check_count(len(set(_MATERIALS.findall(data))), name)
        if has_relative(data):
            data, strangers = with_absolute(data)
    resolver = _Resolver(referred)
    try:
        geometries = _geometries(data, suffix, name, resolver)
        lost = suffix == ".obj" and _lost_references(data, geometries)
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
        _give_texture(geometries, resolver, texture)
    for each in dict.fromkeys(resolver.broken):
        unreadable(f"{clipped(each, 80)} (named by {name})", "albedo", not without_albedo)
    missing = referred.missing()
    if not without_albedo:
        for each in missing:
            missing_image(referred, each)
    textures: dict[int, Texture] = {}
    pieces = [piece_of(each, referred.source, textures, bool(missing)) for each in geometries]
    pieces[0].strangers += strangers
    return pieces


def _geometries(data: bytes, suffix: str, name: str, resolver: _Resolver) -> list[trimesh.Trimesh]:
    """Return what has faces in a file, at least one."""
    import trimesh

    scene = trimesh.load_scene(
        trimesh.util.wrap_as_stream(data),
        file_type=suffix[1:],
        resolver=resolver,
        process=False,
        **({"skip_materials": True} if suffix == ".ply" else {}),
    )
    instances = (scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    found = [each for each in instances if isinstance(each, trimesh.Trimesh) and len(each.faces)]
    if not found:
        points = any(len(getattr(each, "vertices", ())) for each in scene.geometry.values())
        raise _no_faces(name, points)
    for each in found:
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
    """Reads for trimesh what is referred to, and remembers what is no image, which it passes
    over."""

    def __init__(self, referred: Referred) -> None:
        self.referred = referred
        self.broken: list[str] = []
        self.file_name = referred.source.name

    def get(self, name: str) -> bytes:
        is_image = name.lower().endswith(IMAGES)
        content = self.referred.read(name, "an image file" if is_image else "an MTL file")
        if is_image:
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
