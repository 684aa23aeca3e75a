"""trimesh's geometries and materials as ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, warn
from facerender.image import srgb_to_linear
from facerender.loading.repair import Piece
from facerender.scenes.material import SKIN_ALBEDO, Material
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh


def piece_of(
    geometry: trimesh.Trimesh,
    transform: NDArray[np.float64],
    source: Path,
    textures: dict[int, Texture],
    lost_images: bool,
) -> Piece:
    linear = transform[:3, :3]
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if vertices.shape[1:] != (3,):
        raise InputError(f"{source.name} is damaged (vertices without three coordinates)")
    faces = np.asarray(geometry.faces, dtype=np.int64)
    determinant = float(np.linalg.det(linear)) if np.isfinite(transform).all() else 0.0
    if determinant < 0.0:
        faces = faces[:, ::-1]
    normals = None
    # vertex_normals computes them when there are none; only the cache tells the file's own.
    if "vertex_normals" in geometry._cache.cache and determinant != 0.0:
        normals = np.asarray(geometry.vertex_normals, dtype=np.float64) @ np.linalg.inv(linear)
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and len(uv) == len(geometry.vertices):
        uv = np.array(uv, dtype=np.float64)[:, :2]
        uv[~np.isfinite(uv)] = 0.0
    else:
        uv = None
    colors = None
    if visual.kind in ("vertex", "face"):
        colors = np.asarray(visual.vertex_colors)[:, :3] / 255.0
        if source.suffix.lower() not in (".glb", ".gltf"):  # there they are linear
            colors = srgb_to_linear(colors)
    own = getattr(visual, "material", None)
    material = _material(own, colors is not None, source.name, textures)
    if lost_images and material.albedo_map is None and min(material.albedo) > 0.99:
        material = replace(material, albedo=SKIN_ALBEDO)  # white was meant to multiply the image
    if uv is None and material.albedo_map is not None:
        warn(f"{source.name} has no texture coordinates: its texture is ignored")
    with np.errstate(invalid="ignore"):  # such vertices are dropped later
        positions = vertices @ linear.T + transform[:3, 3]
    return Piece(
        positions=positions,
        faces=faces,
        normals=normals,
        uv=uv,
        colors=colors,
        material=material,
    )


def _material(source: Any, has_colors: bool, file: str, textures: dict[int, Texture]) -> Material:
    """Translate a trimesh material: PBR from glTF, simple from MTL, None where there is none."""
    if source is None:
        return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)

    def texture(image: Any, kind: str) -> Texture | None:
        if image is None:
            return None
        name = image.info.get("file_path", f"the {kind} map of {file}")
        return textures.setdefault(id(image), Texture(lambda: image, name))

    if type(source).__name__ == "PBRMaterial":
        factor = source.baseColorFactor
        albedo = np.ones(3) if factor is None else np.asarray(factor)[:3]
        if albedo.dtype == np.uint8:
            albedo = albedo / 255.0
        properties = texture(source.metallicRoughnessTexture, "roughness")
        roughness = source.roughnessFactor
        occlusion = texture(source.occlusionTexture, "occlusion")
        if source.occlusionTexture is source.metallicRoughnessTexture:
            occlusion = properties
        return Material(
            albedo=tuple(albedo),
            # Without a map it does not count: exporters write 1 or 0.5 by default.
            roughness_factor=1.0 if roughness is None else roughness,
            albedo_map=texture(source.baseColorTexture, "albedo"),
            normal_map=texture(source.normalTexture, "normal"),
            roughness_map=properties and properties.channel(1, properties.name),
            occlusion_map=occlusion and occlusion.channel(0, occlusion.name),
        )
    image = source.image
    if image is not None and image.size == (2, 2) and not getattr(image, "format", None):
        # What trimesh puts where the MTL is missing: no texture, and no colour to go by.
        return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)
    if image is None and not has_colors:
        return Material(albedo=tuple(srgb_to_linear(np.asarray(source.diffuse)[:3] / 255.0)))
    return Material(albedo=(1.0, 1.0, 1.0), albedo_map=texture(image, "albedo"))


def override(pieces: Sequence[Piece], maps: dict[str, Texture], source: Path) -> None:
    """Give every piece with texture coordinates the maps that the caller named."""
    if all(piece.uv is None for piece in pieces):
        raise InputError(
            f"{source.name} has no texture coordinates, which {next(iter(maps.values())).name} "
            "needs; unwrap the mesh, or render it without maps"
        )
    for piece in pieces:
        if piece.uv is None:
            warn(f"a part of {source.name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = dict(maps)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            piece.colors = None
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        piece.material = replace(piece.material, **changes)
