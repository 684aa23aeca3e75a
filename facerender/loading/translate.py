"""trimesh's geometries and materials as ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facerender.errors import InputError, clipped, warn
from facerender.image import srgb_to_linear
from facerender.loading.repair import Piece
from facerender.scenes.material import SKIN_ALBEDO, Material
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh


def piece_of(
    geometry: trimesh.Trimesh,
    source: Path,
    textures: dict[int, Texture],
    lost_images: bool,
) -> Piece:
    """Return a geometry of an OBJ, PLY or STL file; textures by image, for Pillow decodes an image
    in one thread only."""
    name = clipped(source.name, 80)
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if vertices.shape[1:] != (3,):
        raise ValueError("vertices without three coordinates")
    faces = np.asarray(geometry.faces, dtype=np.int64)
    known = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    if not known.all():  # colours of faces are brought to vertices
        geometry.update_faces(known)
        faces = np.asarray(geometry.faces, dtype=np.int64)
    normals = None
    # vertex_normals computes them when there are none; only the cache tells the file's own.
    if "vertex_normals" in geometry._cache.cache:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float64)
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and len(uv) == len(geometry.vertices):
        uv = np.array(uv, dtype=np.float64)[:, :2]
    else:
        uv = None
    colors = None
    if visual.kind in ("vertex", "face"):
        colors = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255.0)
    own = getattr(visual, "material", None)
    material = _material(own, colors is not None, name, textures)
    if lost_images and material.albedo_map is None and min(material.albedo) > 0.99:
        material = replace(material, albedo=SKIN_ALBEDO)  # white was meant to multiply the image
    if uv is None and material.albedo_map is not None:
        warn(f"{name} has no texture coordinates: its texture is ignored")
    return Piece(
        positions=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        colors=colors,
        material=material,
        strangers=int((~known).sum()),
    )


def _material(source: Any, has_colors: bool, file: str, textures: dict[int, Texture]) -> Material:
    """Translate a trimesh material, of an MTL; None where there is none."""
    if source is None:
        return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)
    image = source.image
    if image is not None and image.size == (2, 2) and not getattr(image, "format", None):
        # What trimesh puts where the MTL is missing: no texture, and no colour to go by.
        return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)
    if image is None and not has_colors:
        return Material(albedo=tuple(srgb_to_linear(np.asarray(source.diffuse)[:3] / 255.0)))
    if image is None:
        return Material(albedo=(1.0, 1.0, 1.0))
    name = clipped(image.info.get("file_path", f"the albedo map of {file}"), 80)
    texture = textures.setdefault(id(image), Texture(lambda: image, name))
    return Material(albedo=(1.0, 1.0, 1.0), albedo_map=texture)


def override(pieces: Sequence[Piece], maps: dict[str, Texture], name: str) -> None:
    """Give every piece with texture coordinates the maps that the caller named."""
    if all(piece.uv is None for piece in pieces):
        raise InputError(
            f"{name} has no texture coordinates, which {next(iter(maps.values())).name} "
            "needs; unwrap the mesh, or render it without maps"
        )
    for piece in pieces:
        if piece.uv is None:
            warn(f"a part of {name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = dict(maps)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            piece.colors = None
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        piece.material = replace(piece.material, **changes)
