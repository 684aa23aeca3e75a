"""Mesh files: read, checked, mended where that is safe, and placed by their scene graph.
Materials and maps come along. No OpenGL here."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from facerender.data import data_dir
from facerender.errors import check_path, check_switch, clipped, noting
from facerender.loading.kept import Files
from facerender.loading.read import GLTF, read
from facerender.loading.referred import Referred
from facerender.loading.repair import assemble, clean
from facerender.loading.translate import override
from facerender.scenes.mesh import Mesh
from facerender.scenes.texture import Texture

Path_ = str | os.PathLike[str]


def load_mesh(
    path: Path_ | None = None,
    *,
    albedo: Path_ | None = None,
    normal_map: Path_ | None = None,
    specular_map: Path_ | None = None,
    roughness_map: Path_ | None = None,
    lobe_map: Path_ | None = None,
    flip_v: bool = False,
    millimetres: float | None = None,
    cache: bool = False,
    allow_outside: bool = False,
) -> Mesh:
    """Read a mesh file, or the built-in head.

    Missing textures, dropped faces and mended normals are reported as FacerenderWarning.

    Parameters
    ----------
    path : .glb, .gltf, .obj (with .mtl), .ply or .stl; None for the built-in head
    albedo, normal_map, specular_map, roughness_map, lobe_map : image files that replace the file's
        own maps; see :class:`facerender.Material`
    flip_v : turn the texture coordinates upside down, for files that store v the other way
    millimetres : that a unit of the file is, which scattering needs; None for what the format says:
        1000 in .glb and .gltf, nothing in others
    cache : take the mesh with its decoded maps from ``~/.cache/facerender`` if no file has changed
        since it was put there, or else decode all of its maps, and put it there in the background
    allow_outside : open what the file refers to wherever it says; else only what lies below its
        folder by name

    Raises
    ------
    InputError : the file or a map is missing, empty, damaged, of no known format, or has no faces;
        millimetres outside [1e-6, 1e6]
    """
    check_switch("flip_v", flip_v)
    check_switch("cache", cache)
    files = _files(
        path, albedo, normal_map, specular_map, roughness_map, flip_v, lobe_map, allow_outside
    )
    if not cache:
        return _scaled(_read(files)[0], millimetres)
    if (found := files.find()) is not None:
        return _scaled(found, millimetres)
    name = files.digest()
    with noting() as warnings:
        mesh, referred = _read(files)
    if name is not None:
        files.keep(name, mesh, referred.files, warnings)
    return _scaled(mesh, millimetres)


def kept_mesh(
    path: Path_ | None = None, millimetres: float | None = None, **files: Any
) -> Mesh | None:
    """Return the mesh that :func:`load_mesh` would take from the cache, if it is there."""
    mesh = _files(path, **files).find()
    return None if mesh is None else _scaled(mesh, millimetres)


def _scaled(mesh: Mesh, millimetres: float | None) -> Mesh:
    return mesh if millimetres is None else replace(mesh, millimetres=millimetres)


def _files(
    path: Path_ | None,
    albedo: Path_ | None,
    normal_map: Path_ | None,
    specular_map: Path_ | None,
    roughness_map: Path_ | None,
    flip_v: bool,
    lobe_map: Path_ | None,
    allow_outside: bool,
) -> Files:
    maps = {
        "albedo_map": albedo,
        "normal_map": normal_map,
        "specular_map": specular_map,
        "roughness_map": roughness_map,
        "lobe_map": lobe_map,
    }
    for name, file in {"mesh file": path, **maps}.items():
        if file is not None:
            check_path(name, file)
    return Files(
        Path(path) if path is not None else data_dir("assets") / "head.glb",
        {name: Path(file) for name, file in maps.items() if file is not None},
        flip_v,
        allow_outside,
    )


def _read(files: Files) -> tuple[Mesh, Referred]:
    """Return a mesh, and the files that its file refers to."""
    source = files.source
    name = clipped(source.name, 80)
    overrides = {name: Texture.open(file) for name, file in files.maps.items()}
    with np.errstate(all="ignore"):  # what overflows is found and dropped
        found, referred = read(source, "albedo_map" in overrides, files.allow_outside)
        pieces = clean(found, name)
        if files.flip_v:
            for piece in pieces:
                if piece.uv is not None:
                    piece.uv = piece.uv * (1.0, -1.0) + (0.0, 1.0)
        if overrides:
            override(pieces, overrides, name)
        millimetres = 1000.0 if source.suffix.lower() in GLTF else None
        return assemble(pieces, name, millimetres), referred
