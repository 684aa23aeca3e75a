"""Load meshes with their materials and maps: read, check and repair files, and place mesh instances
with the transforms of the scene graph. This package does not use OpenGL."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_path, check_switch, check_type, noting, warn
from facerender.loading.conventions import give_presets, mark_skin
from facerender.loading.from_trimesh import is_object, millimetres_of, name_of, pieces_of
from facerender.loading.mesh_cache import MeshFiles
from facerender.loading.references import References
from facerender.loading.source import GLTF, Orientation, source_of
from facerender.scenes.framing import find_regions
from facerender.scenes.hints import remember
from facerender.scenes.mesh import Mesh, names_of
from facerender.scenes.repair import Piece, clean, in_space_order
from facerender.scenes.sources import MeshSource
from facerender.scenes.texture import Texture

Path_ = str | os.PathLike[str]
if TYPE_CHECKING:
    from PIL.Image import Image

    Map = Path_ | Texture | NDArray[Any] | Image
else:
    Map = Any


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
    cache: bool = False,
    allow_outside: bool = False,
    kind: str | None = None,
    normal_map_y: str = "up",
    as_is: bool = False,
    parts: str | Iterable[str] = (),
    hide: str | Iterable[str] = (),
    double_sided: bool = False,
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
        since the mesh was stored. Otherwise decode all maps, and store the mesh in the background.
        Trimesh objects, and meshes with maps that are not files, are not cached
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

    Raises
    ------
    InputError : the file or a map is missing, empty, damaged or of an unknown format; the mesh has
        no faces; no part has a name of ``parts`` or ``hide``; millimetres is outside [1e-6, 1e6];
        normal_map_y is invalid
    """
    maps = _maps(
        albedo_map=albedo,
        normal_map=normal_map,
        specular_map=specular_map,
        roughness_map=roughness_map,
        lobe_map=lobe_map,
    )
    orientation = Orientation(flip_v, normal_map_y)
    selected = names_of("parts", parts), names_of("hide", hide)
    mesh = _loaded(source, kind, *maps, orientation, allow_outside, cache, as_is, selected)
    return _finished(mesh, millimetres, double_sided)


def cached_mesh(
    source: Path_ | None = None,
    *,
    millimetres: float | None = None,
    flip_v: bool = False,
    allow_outside: bool = False,
    normal_map_y: str = "up",
    as_is: bool = False,
    parts: str | Iterable[str] = (),
    hide: str | Iterable[str] = (),
    double_sided: bool = False,
    **maps: Path_ | None,
) -> Mesh | None:
    """Return the mesh from the cache, or None if the cache lacks it; see :func:`load_mesh`."""
    paths, _ = _maps(**{"albedo_map" if n == "albedo" else n: path for n, path in maps.items()})
    orientation = Orientation(flip_v, normal_map_y)
    selected = names_of("parts", parts), names_of("hide", hide)
    files = MeshFiles(source_of(source), paths, orientation, allow_outside, as_is, *selected)
    mesh = files.find()
    return None if mesh is None else _finished(mesh, millimetres, double_sided)


def _loaded(
    source: MeshSource | None,
    kind: str | None,
    paths: Mapping[str, Path],
    textures: Mapping[str, Texture],
    orientation: Orientation,
    allow_outside: bool,
    cache: bool,
    as_is: bool,
    selected: tuple[tuple[str, ...], tuple[str, ...]],
) -> Mesh:
    """Return the mesh of a source; ``paths`` and ``textures`` replace maps of the source.

    selected : arguments of :meth:`Mesh.select`
    """
    check_switch("cache", cache)
    check_switch("allow_outside", allow_outside)
    check_switch("as_is", as_is)
    if is_object(source):
        name = name_of(source)
        overrides = {key: Texture.open(path) for key, path in paths.items()} | {**textures}
        with np.errstate(all="ignore"):
            pieces = pieces_of(source, name)
            unit = millimetres_of(source)
            mesh = _assembled(pieces, name, orientation.flip_v, unit, as_is)
            return _mapped(mesh.select(*selected), overrides, orientation.normal_map_y)
    file = source_of(source, kind)
    files = MeshFiles(file, paths, orientation, allow_outside, as_is, *selected)
    if not cache or textures:
        return _read(files, textures)[0]
    if (stored_mesh := files.find()) is not None:
        return stored_mesh
    digest = files.digest()
    with noting() as warnings:
        mesh, references = _read(files, {})
    if digest is not None:
        mesh = replace(mesh, regions=find_regions(mesh))
        files.store(digest, mesh, references.files, warnings)
    return mesh


def _finished(mesh: Mesh, millimetres: float | None, double_sided: bool) -> Mesh:
    check_switch("double_sided", double_sided)
    if double_sided:
        mesh = mesh.with_material(double_sided=True)
    return remember(mesh if millimetres is None else replace(mesh, millimetres=millimetres))


def _maps(**sources: Map | None) -> tuple[dict[str, Path], dict[str, Texture]]:
    """Split maps into image files and textures, both keyed by the field of :class:`Material`."""
    paths: dict[str, Path] = {}
    textures: dict[str, Texture] = {}
    for name, source in sources.items():
        if source is None:
            continue
        if isinstance(source, Texture):
            textures[name] = source
        elif isinstance(source, np.ndarray):
            textures[name] = Texture.from_array(source, f"the array of {name}")
        elif isinstance(source, str | os.PathLike):
            check_path(name, source)
            paths[name] = Path(source)
        elif hasattr(source, "getbands"):  # a Pillow image: isinstance would import Pillow
            textures[name] = Texture.from_image(source, f"the image of {name}")
        else:
            check_type(name, source, (), "a path, a texture, an array or a Pillow image")
    return paths, textures


def _read(files: MeshFiles, textures: Mapping[str, Texture]) -> tuple[Mesh, References]:
    """Return the mesh of a mesh file, and the files to which the mesh file refers."""
    from facerender.loading.read import read  # a mesh from the cache does not need it

    source = files.source
    overrides = {name: Texture.open(file) for name, file in files.maps.items()} | {**textures}
    with np.errstate(all="ignore"):  # clean() drops faces whose vertices overflow
        pieces, references = read(source, "albedo_map" in overrides, files.allow_outside)
        millimetres = 1000.0 if source.suffix in GLTF else None
        options = files.orientation.flip_v, millimetres, files.as_is
        mesh = _assembled(pieces, source.name, *options).select(files.parts, files.hide)
        return _mapped(mesh, overrides, files.orientation.normal_map_y), references


def _assembled(
    raw_pieces: Sequence[Piece], name: str, flip_v: bool, millimetres: float | None, as_is: bool
) -> Mesh:
    pieces = clean(raw_pieces, name)
    mark_skin(pieces)
    if not as_is:
        give_presets(pieces, name)
    for piece in pieces:
        piece.faces = in_space_order(piece.faces, piece.positions)
        for key in ("uv", "uv2"):
            if flip_v and (uv := getattr(piece, key)) is not None:
                setattr(piece, key, uv * (1.0, -1.0) + (0.0, 1.0))
    return Mesh.assembled(pieces, name, millimetres)


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
        turned = {
            original: original and original.turned_green()
            for original in {material.normal_map for material in materials}
        }
        materials = [
            replace(material, normal_map=turned[material.normal_map]) for material in materials
        ]
    return replace(mesh, parts=tuple(parts), materials=tuple(materials))
