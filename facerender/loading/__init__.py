"""Mesh files: read by trimesh, checked, mended where that is safe, and placed by their scene graph.
Materials and maps come along. No OpenGL here."""

from __future__ import annotations

import os
from pathlib import Path

from facerender.data import data_dir
from facerender.loading.read import read
from facerender.loading.repair import assemble, clean
from facerender.loading.translate import override, piece_of
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
    flip_v: bool = False,
) -> Mesh:
    """Read a mesh file, or the built-in head.

    Missing textures, dropped faces and mended normals are reported as FacerenderWarning.

    Parameters
    ----------
    path : .glb, .gltf, .obj (with .mtl), .ply or .stl; None for the built-in head
    albedo, normal_map, specular_map, roughness_map : image files that replace the file's own maps
    flip_v : turn the texture coordinates upside down, for files that store v the other way

    Raises
    ------
    InputError : the file or a map is missing, empty, damaged, of no known format, or has no faces
    """
    source = Path(path) if path is not None else data_dir("assets") / "head.glb"
    overrides = {
        name: Texture.open(file)
        for name, file in (
            ("albedo_map", albedo),
            ("normal_map", normal_map),
            ("specular_map", specular_map),
            ("roughness_map", roughness_map),
        )
        if file is not None
    }
    geometries, lost_images = read(source, skip_images="albedo_map" in overrides)
    textures: dict[int, Texture] = {}  # by image: Pillow decodes an image in one thread only
    pieces = [
        piece_of(geometry, transform, source, textures, lost_images)
        for geometry, transform in geometries
    ]
    if flip_v:
        for piece in pieces:
            if piece.uv is not None:
                piece.uv[:, 1] = 1.0 - piece.uv[:, 1]
    if overrides:
        override(pieces, overrides, source)
    return assemble(clean(pieces, source.name), source.name)
