"""trimesh's geometries and materials as ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from facerender.errors import InputError, clipped, warn
from facerender.images.srgb import srgb_to_linear
from facerender.scenes.material import MAPS, SKIN_ALBEDO, Material
from facerender.scenes.repair import Piece
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh

    from facerender.loading.mtl import Library


def piece_of(
    geometry: trimesh.Trimesh,
    name: str,
    textures: dict[int, Texture],
    lost_images: bool,
    library: Library | None = None,
) -> Piece:
    """Return a geometry of a file of this name; textures by image, for Pillow decodes an image in
    one thread only; library of an OBJ file."""
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
    uv2 = None
    if library is None:
        material = _material(own, colors is not None, name, textures)
    else:
        look = library.look(getattr(own, "name", ""), colors is not None)
        material = look.material
        if uv is not None:
            uv2 = None if look.second is None else look.second.moved(uv)
            uv = look.first.moved(uv)
    if lost_images and material.albedo_map is None and min(material.albedo) > 0.99:
        material = replace(material, albedo=SKIN_ALBEDO)  # white was meant to multiply the image
    if uv is None and any(getattr(material, key) for key in MAPS):
        warn(f"{name} has no texture coordinates: its texture is ignored")
    return Piece(
        positions=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        colors=colors,
        material=material,
        strangers=int((~known).sum()),
        uv2=uv2,
    )


def _material(source: Any, has_colors: bool, file: str, textures: dict[int, Texture]) -> Material:
    """Translate a trimesh material, of a PLY or STL file; None where there is none."""
    if source is None:
        return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)
    if hasattr(source, "baseColorFactor"):
        return _of_gltf(source, file, textures)
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


def _of_gltf(source: Any, file: str, textures: dict[int, Texture]) -> Material:
    """Translate trimesh's material of a glTF file; factors are those of glTF, colours in bytes."""

    def texture(name: str, what: str) -> Texture | None:
        if (image := getattr(source, name)) is None:
            return None
        own = Texture.from_image(image, f"the {what} map of {file}")
        return textures.setdefault(id(image), own)

    color = source.baseColorFactor
    factors = np.ones(4) if color is None else np.append(np.asarray(color) / 255.0, 1.0)[:4]
    albedo_map = texture("baseColorTexture", "albedo")
    properties = texture("metallicRoughnessTexture", "roughness")
    occlusion = texture("occlusionTexture", "occlusion")
    alpha = str(source.alphaMode or "OPAQUE").lower()
    opacity_map = None
    if alpha != "opaque" and albedo_map and "A" in source.baseColorTexture.getbands():
        band = source.baseColorTexture.getchannel("A")
        opacity_map = Texture.from_image(band, f"the opacity map of {file}")
    if source.metallicFactor:
        warn(f"{file} has metallic materials: drawn as dielectrics, which skin is")
    emissive = np.zeros(3) if source.emissiveFactor is None else np.asarray(source.emissiveFactor)
    roughness, cutoff = source.roughnessFactor, source.alphaCutoff
    return Material(
        albedo=tuple(factors[:3].tolist()),
        roughness_factor=1.0 if roughness is None else float(roughness),
        albedo_map=albedo_map,
        normal_map=texture("normalTexture", "normal"),
        roughness_map=properties and properties.channel(1, properties.name),
        occlusion_map=occlusion and occlusion.channel(0, occlusion.name),
        alpha=alpha,  # type: ignore[arg-type]  # others are told
        opacity=float(factors[3]),
        alpha_cutoff=0.5 if cutoff is None else float(cutoff),
        opacity_map=opacity_map,
        emissive=tuple(emissive.tolist()),
        emissive_map=texture("emissiveTexture", "emission"),
    )


def override(pieces: Sequence[Piece], maps: Mapping[str, Texture], name: str) -> None:
    """Give every piece with texture coordinates the maps that the caller named; they are sampled as
    those in whose place they are, or else as its albedo map."""
    if all(piece.uv is None for piece in pieces):
        raise InputError(
            f"{name} has no texture coordinates, which {next(iter(maps.values())).name} "
            "needs; unwrap the mesh, or render it without maps"
        )
    for piece in pieces:
        if piece.uv is None:
            warn(f"a part of {name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = {}
        for field, texture in maps.items():
            like = getattr(piece.material, field) or piece.material.albedo_map or texture
            same = like.sampling == texture.sampling
            changes[field] = texture if same else texture.sampled(*like.sampling)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            piece.colors = None
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        piece.material = replace(piece.material, **changes)
