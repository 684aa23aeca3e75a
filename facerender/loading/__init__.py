"""Load meshes with their materials and maps: read, check and repair files, and place mesh instances
with the transforms of the scene graph. This package does not use OpenGL."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import (
    InputError,
    check_known,
    check_path,
    check_switch,
    check_type,
    clipped,
    noting,
    reason,
    warn,
)
from facerender.loading import mesh_cache
from facerender.loading.conventions import give_presets, mark_skin
from facerender.loading.from_trimesh import is_object, millimetres_of, name_of, pieces_of
from facerender.loading.gltf_document import damaged
from facerender.loading.mesh_cache import LoadOptions
from facerender.loading.source import (
    BUILT_IN,
    GLTF,
    References,
    Source,
    check_format,
    check_normal_map_y,
    missing_image,
    no_faces,
    source_of,
)
from facerender.mesh.face import Face, Surface, find_faces
from facerender.mesh.framing import framing_of
from facerender.mesh.hints import gloss_of
from facerender.mesh.mesh import Mesh, names_of
from facerender.mesh.repair import Piece, clean, in_space_order, placed
from facerender.system.files import read_file
from facerender.texture.texture import LARGE, Texture, with_green_turned
from facerender.values.vectors import ROTATIONS, UP_NAMES, axes_of, upright_of

Path_ = str | os.PathLike[str]
if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

    MeshSource: TypeAlias = Path_ | bytes | IO[bytes] | trimesh.Trimesh | trimesh.Scene
    Map = Path_ | Texture | NDArray[Any] | Image
else:
    MeshSource = Map = Any
_Axes: TypeAlias = NDArray[np.float64] | None
# The result of the search, so that the first image of the built-in head need not wait for it.
_BUILT_IN_EYES = np.array([(-0.0308, 0.0007, 0.084), (0.0308, 0.0007, 0.084)])
_BUILT_IN_FACE = Face(_BUILT_IN_EYES, np.eye(3)[1], np.eye(3)[2], 0.0616, 1.06)
_MAPS = ("albedo_map", "normal_map", "specular_map", "roughness_map", "lobe_map")


def load_mesh(
    source: MeshSource | None = None,
    *,
    albedo: Map | None = None,
    normal_map: Map | None = None,
    specular_map: Map | None = None,
    roughness_map: Map | None = None,
    lobe_map: Map | None = None,
    flip_v: bool = False,
    millimetres: float | None = None,
    cache: bool | Literal["read"] = False,
    allow_outside: bool = False,
    kind: str | None = None,
    normal_map_y: str = "up",
    as_is: bool = False,
    parts: str | Iterable[str] = (),
    hide: str | Iterable[str] = (),
    double_sided: bool = False,
    up: str = "y",
    rotate: ArrayLike = (0.0, 0.0, 0.0),
) -> Mesh:
    """Load a mesh from a file or a trimesh object, or load the built-in head.

    Missing textures, dropped faces, repaired normals and presets that parts get by their names are
    reported as FacerenderWarning.

    Parameters
    ----------
    source : path of a .glb, .gltf, .obj (with .mtl), .ply or .stl file; its content as bytes, or
        an open binary file; a ``trimesh.Trimesh`` or ``trimesh.Scene``, which is copied; None for
        the built-in head. For arrays, use :meth:`facerender.Mesh.from_arrays`
    albedo, normal_map, specular_map, roughness_map, lobe_map : image files, textures, arrays or
        Pillow images that replace the file's own maps of the skin (:attr:`facerender.Mesh.skin`);
        see :class:`facerender.Material` and :meth:`facerender.Texture.from_array`
    flip_v : reverse the v axis of the texture coordinates
    millimetres : length of one unit of the file in mm, required for subsurface scattering. None:
        1000 for .glb and .gltf, the unit of a trimesh object, undefined for other formats
    cache : load the mesh with its decoded maps from ``~/.cache/facerender`` if no file has changed
        since the mesh was stored. Otherwise decode all maps, and store the mesh in the background;
        "read" does not store it. Trimesh objects, and meshes with maps that are not files, are not
        cached
    allow_outside : open referenced files at any path. By default, only files below the mesh file's
        folder are opened. A mesh given as bytes has no folder: no file that it references is opened
    kind : "glb", "gltf", "obj", "ply" or "stl"; required if neither the file name nor the bytes
        identify the format
    normal_map_y : direction of green in normal maps: "up" (OpenGL, glTF) or "down" (DirectX)
    as_is : keep the materials of the file. By default, a part with a known name gets a preset if
        it has no maps, vertex colours or transparency; see docs/formats.md. Names define the skin
        in both cases
    parts, hide : see :meth:`facerender.Mesh.select`; the skin is defined among the selected parts
    double_sided : draw the back faces of all parts. By default, the material of a glTF file decides
        (doubleSided); in other formats, the back faces of closed surfaces are not drawn
    up : axis of the file that points up: "y", "z", "x", "-y", "-z" or "-x". The shortest rotation
        turns it to y: for "z", a face that looks along -y then looks to +z. "auto" turns the face
        that :func:`facerender.find_face` finds upright, so that it looks to +z
    rotate : three angles in [-3600, 3600] degrees, by which the mesh is rotated about x, then y,
        then z after ``up``. Poses follow; ``Mesh.geometry.rotation`` is the whole rotation

    Raises
    ------
    InputError : the file or a map is missing, empty, damaged or of an unknown format; the mesh has
        no faces; no part has a name of ``parts`` or ``hide``; millimetres is outside [1e-6, 1e6];
        normal_map_y, up or rotate is invalid
    """
    maps = _maps(albedo, normal_map, specular_map, roughness_map, lobe_map)
    if not (isinstance(cache, str) and cache == "read"):
        check_switch("cache", cache)
    check_normal_map_y(normal_map_y)
    switches = {"flip_v": flip_v, "allow_outside": allow_outside, "as_is": as_is}
    for name, value in (switches | {"double_sided": double_sided}).items():
        check_switch(name, value)
    selected = names_of("parts", parts), names_of("hide", hide)
    check_known("up", up, UP_NAMES)
    angles = ROTATIONS.check("rotate", rotate)
    options = LoadOptions(flip_v, normal_map_y, allow_outside, as_is, *selected, up, angles)
    if is_object(source):
        name = name_of(source)
        read = partial(pieces_of, source, name)
        mesh = _assembled(read, name, millimetres_of(source), _opened(maps), options)
    else:
        mesh = _loaded(source_of(source, kind), maps, options, cache)
    if double_sided:
        mesh = mesh.with_material(double_sided=True)
    geometry = replace(mesh.geometry, gloss=tuple(map(gloss_of, mesh.materials)))
    if millimetres is not None:
        geometry = replace(geometry, millimetres=millimetres)
    return replace(mesh, geometry=geometry)


def _maps(*sources: Map | None) -> dict[str, Path | Texture]:
    """Return the image files and textures of the maps in _MAPS, keyed by their names there."""
    maps: dict[str, Path | Texture] = {}
    for name, source in zip(_MAPS, sources, strict=True):
        if source is None:
            continue
        if isinstance(source, Texture):
            maps[name] = source
        elif isinstance(source, np.ndarray):
            maps[name] = Texture.from_array(source, f"the array of {name}")
        elif isinstance(source, str | os.PathLike):
            check_path(name, source)
            maps[name] = Path(source)
        elif hasattr(source, "getbands"):  # a Pillow image: isinstance would import Pillow
            maps[name] = Texture.from_image(source, f"the image of {name}")
        else:
            check_type(name, source, (), "a path, a texture, an array or a Pillow image")
    return maps


def _loaded(
    source: Source,
    maps: Mapping[str, Path | Texture],
    options: LoadOptions,
    cache: bool | Literal["read"],
) -> Mesh:
    """Return the mesh of a mesh file, from the cache if possible."""
    if not cache or any(isinstance(file, Texture) for file in maps.values()):
        return _read(source, _opened(maps), options)[0]
    contents = {n: read_file(path, "an image file") for n, path in maps.items()}  # type: ignore[arg-type]
    entry = mesh_cache.entry_name(source, {n: (maps[n].name, contents[n]) for n in maps}, options)
    if (stored_mesh := mesh_cache.find(entry, source, options.allow_outside)) is not None:
        return stored_mesh
    with noting() as warnings:
        mesh, references = _read(source, _opened(maps, contents), options)
    if cache != "read":
        mesh = replace(mesh, geometry=replace(mesh.geometry, known_framing=mesh.geometry.framing))
        mesh_cache.store(entry, mesh, references.files, "albedo_map" in maps, warnings)
    return mesh


def _opened(
    maps: Mapping[str, Path | Texture], contents: Mapping[str, bytes] | None = None
) -> dict[str, Texture]:
    """Return the textures of maps. Their files are not read again if their ``contents`` are given,
    except large images, whose contents would take memory."""
    textures = {}
    for field, source in maps.items():
        if not isinstance(source, Texture):
            path, content = source, contents and contents[field]
            source = Texture.of(content, clipped(path.name)) if content else Texture.open(path)
            if content and math.prod(source.size) > LARGE:
                source = Texture.open(path)
        textures[field] = source
    return textures


def _read(
    source: Source, textures: Mapping[str, Texture], options: LoadOptions
) -> tuple[Mesh, References]:
    """Return the mesh of a mesh file, and the files to which the mesh file refers."""
    if not source.content:
        raise InputError(f"{source.name} is an empty file; give a mesh file")
    check_format(source.content, source.suffix, source.name)
    references = References(source.name, source.folder, options.allow_outside)
    read = partial(_pieces, source, references, "albedo_map" in textures)
    millimetres = 1000.0 if source.suffix in GLTF else None
    mesh = _assembled(read, source.name, millimetres, textures, options)
    geometry = mesh.geometry
    is_whole = not (options.parts or options.hide)
    if source.path == BUILT_IN and geometry.rotation is None and is_whole:
        framing = framing_of(geometry.parts, geometry.space, geometry.profile, _BUILT_IN_FACE)
        mesh = replace(mesh, geometry=replace(geometry, known_framing=framing))
    return mesh, references


def _turned(
    read: Callable[[_Axes], Sequence[Piece]], name: str, options: LoadOptions
) -> tuple[Sequence[Piece], _Axes]:
    """Return the pieces of a mesh in mesh space, and their axes; see :func:`axes_of`. With
    ``up="auto"``, ``read`` is called twice, because poses of a glTF file follow the axes."""
    upright = None
    if options.up == "auto":
        # Pieces are not cleaned yet: they may have invalid indices and positions.
        corners = np.concatenate(
            [np.take(piece.positions, piece.faces, axis=0, mode="clip") for piece in read(None)]
        )
        corners = corners[np.isfinite(corners).all(axis=(1, 2))]
        if len(corners) and (faces := find_faces(Surface(corners - corners.mean(axis=(0, 1))))):
            *_, upright = upright_of(faces[0].axes)
        else:
            upright = np.eye(3)
            warn(f"no face was found on {name}: it stays as it is; give its axis, as in --up z")
    axes = axes_of(options.up, options.rotate, upright)
    return read(axes), axes


def _pieces(
    source: Source, references: References, albedo_given: bool, axes: NDArray[np.float64] | None
) -> Sequence[Piece]:
    """Return a piece for every geometry with faces. The readers are imported here: a mesh from the
    cache does not need them. If ``albedo_given``, the caller replaces albedo maps, which may then
    be missing or unreadable."""
    read: Callable[[bytes, References, bool], Sequence[Piece]]
    suffix = source.suffix
    if suffix in GLTF:
        from facerender.loading.gltf import read_gltf

        read = partial(read_gltf, axes=axes)  # its joints define the height of a head
    elif suffix == ".obj":
        from facerender.loading.obj import read_obj as read
    elif suffix == ".ply":
        from facerender.loading.ply_stl import read_ply as read
    else:
        from facerender.loading.ply_stl import read_stl as read
    try:
        pieces = read(source.content, references, albedo_given)
        for file, content in references.files.items():
            if content is None and not albedo_given and suffix not in GLTF:
                missing_image(references, file)
    except InputError:
        raise
    except (ValueError, LookupError, ArithmeticError) as error:
        raise damaged(references.name, reason(error)) from None
    except Exception as error:  # not a fault of the file, such as a missing package
        error.add_note(f"while reading {references.name}")
        raise
    if not pieces:
        raise no_faces(references.name, points=False)
    if axes is None or suffix in GLTF:
        return pieces
    return [placed(piece, axes) for piece in pieces]


@np.errstate(all="ignore")  # clean() drops faces whose vertices overflow
def _assembled(
    read: Callable[[_Axes], Sequence[Piece]],
    name: str,
    millimetres: float | None,
    textures: Mapping[str, Texture],
    options: LoadOptions,
) -> Mesh:
    """Return the mesh of the pieces that ``read`` returns, see :func:`_turned`."""
    raw_pieces, axes = _turned(read, name, options)
    pieces = clean(raw_pieces, name)
    mark_skin(pieces)
    if not options.as_is:
        give_presets(pieces, name)
    for piece in pieces:
        piece.faces = in_space_order(piece.faces, piece.positions)
        for key in ("uv", "uv2"):
            if options.flip_v and (uv := getattr(piece, key)) is not None:
                setattr(piece, key, uv * (1.0, -1.0) + (0.0, 1.0))
    mesh = Mesh.assembled(pieces, name, millimetres).select(options.parts, options.hide)
    if axes is not None:
        mesh = replace(mesh, geometry=replace(mesh.geometry, rotation=axes[:3, :3]))
    return _mapped(mesh, textures, options.normal_map_y)


def _mapped(mesh: Mesh, maps: Mapping[str, Texture], normal_map_y: str) -> Mesh:
    """Return a mesh with new maps on the parts of the skin that have texture coordinates, and with
    green up in all normal maps. A new map takes the wrapping and filtering of the replaced map or,
    if there was no such map, of the albedo map."""
    parts, materials = [*mesh.parts], [*mesh.materials]
    if maps and all(parts[i].uv is None for i in mesh.skin):
        raise InputError(
            f"{mesh.name} has no texture coordinates, which {next(iter(maps.values())).name} "
            "needs; unwrap the mesh, or render it without maps"
        )
    for i in mesh.skin if maps else ():
        if parts[i].uv is None:
            warn(f"a part of {mesh.name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = {}
        for field, texture in maps.items():
            template = getattr(materials[i], field) or materials[i].albedo_map or texture
            matches = template.sampling == texture.sampling
            changes[field] = texture if matches else texture.sampled(*template.sampling)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            parts[i] = replace(parts[i], colors=None)
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        materials[i] = replace(materials[i], **changes)
    if normal_map_y == "down":
        turned: dict[Texture | None, Texture | None] = {None: None}
        turned |= {old: old.changed(with_green_turned) for m in materials if (old := m.normal_map)}
        materials = [replace(m, normal_map=turned[m.normal_map]) for m in materials]
    return Mesh(replace(mesh.geometry, parts=tuple(parts)), tuple(materials))
