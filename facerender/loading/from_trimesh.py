"""Convert trimesh meshes and scenes, which come from files or user programs, to pieces, and read
files of vertex positions, the frames of a moving mesh."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason, warn
from facerender.images.image import srgb_to_linear
from facerender.material import MAPS, Material
from facerender.mesh.repair import Piece, check_count, placed, with_face_colors
from facerender.texture.texture import Texture, profile_of

if TYPE_CHECKING:
    import trimesh


def is_object(source: Any) -> TypeGuard[trimesh.Trimesh | trimesh.Scene]:
    """Return whether a source is a trimesh mesh or scene, without importing trimesh."""
    library = sys.modules.get("trimesh")
    return library is not None and isinstance(source, library.Trimesh | library.Scene)


def name_of(source: trimesh.Trimesh | trimesh.Scene) -> str:
    """Return a name for messages: the name in the source's metadata, or else the source's type."""
    name = source.metadata.get("name") or source.metadata.get("file_name")
    return clipped(name, 80) if isinstance(name, str) else f"a trimesh.{type(source).__name__}"


def millimetres_of(source: trimesh.Trimesh | trimesh.Scene) -> float | None:
    """Return the length of the object's unit in mm; None if the object does not define a unit."""
    import trimesh

    try:
        return float(trimesh.units.unit_conversion(source.units, "millimeters"))
    except Exception:  # the units are missing, unknown, or differ within a scene
        return None


def pieces_of(
    source: trimesh.Trimesh | trimesh.Scene, name: str, axes: NDArray[np.float64] | None
) -> list[Piece]:
    """Return a copy of every mesh instance that has faces. Raise InputError if no mesh has
    faces, or the arrays do not form a mesh.

    axes : see :func:`facerender.values.vectors.axes_of`
    """
    textures: dict[int, Texture] = {}
    pieces: list[Piece] = []
    try:
        if hasattr(source, "faces"):
            instances = [(source.metadata.get("name") or "", source, np.eye(4))]
        else:
            nodes = ((node, *source.graph[node]) for node in source.graph.nodes_geometry)
            instances = [(node, source.geometry[key], world) for node, world, key in nodes]
        for part_name, mesh, world in instances:
            if not len(getattr(mesh, "faces", ())):  # not a mesh, such as a path
                continue
            matrix = np.asarray(world, dtype=np.float64)
            matrix = matrix if axes is None else axes @ matrix
            piece = placed(_piece(mesh, name, textures), matrix)
            pieces.append(replace(piece, name=str(part_name)))
            check_count(len(pieces), name)
    except InputError:
        raise
    except Exception as error:  # the caller's arrays may hold anything
        raise InputError(f"{name} is not a valid mesh: {reason(error)}") from None
    if not pieces:
        raise InputError(f"{name} has no faces; give a triangle mesh")
    return pieces


def _piece(geometry: trimesh.Trimesh, name: str, textures: dict[int, Texture]) -> Piece:
    """Return a trimesh geometry as a piece. Pieces share textures, keyed by the ``id`` of the
    image, because Pillow decodes an image in one thread only."""
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if vertices.shape[1:] != (3,):
        raise ValueError("its vertices do not have three coordinates")
    faces = np.asarray(geometry.faces, dtype=np.int64)
    valid = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    # Reading vertex_normals computes missing normals. No public function of trimesh
    # checks whether the object has stored normals.
    has_normals = "vertex_normals" in geometry._cache.cache
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and len(uv) == len(vertices):
        uv = np.array(uv, dtype=np.float64)[:, :2]
        uv = np.pad(uv, ((0, 0), (0, 2 - uv.shape[1])))  # v of a 1D coordinate is 0
    else:
        uv = None
    source = getattr(visual, "material", None)
    material = _material(source, visual.kind in ("vertex", "face"), name, textures)
    if uv is None and any(getattr(material, key) for key in MAPS):
        warn(f"{name} has no texture coordinates: its texture is ignored")
    normals = np.asarray(geometry.vertex_normals, np.float64) if has_normals else None
    piece = Piece(vertices, faces[valid], normals, uv, None, material, int((~valid).sum()))
    piece.material_name = str(getattr(source, "name", None) or "")
    # Colours before the conversion by trimesh, which needs SciPy and blurs face colours.
    if visual.kind == "vertex":
        piece.colors = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255.0)
    elif visual.kind == "face":
        colors = np.asarray(visual.face_colors)[valid, :3]
        piece = with_face_colors(piece, srgb_to_linear(colors / 255.0))
    return piece


def _material(source: Any, has_colors: bool, file: str, textures: dict[int, Texture]) -> Material:
    """Convert the trimesh material, if any, of a trimesh object."""
    if hasattr(source, "baseColorFactor"):
        return _of_gltf(source, file, textures)
    image = None if source is None else source.image
    # trimesh inserts a 2 x 2 image if the MTL file is missing: ignore it and the diffuse colour.
    stub = image is not None and image.size == (2, 2) and not getattr(image, "format", None)
    if image is not None and not stub:
        name = clipped(image.info.get("file_path", f"the albedo map of {file}"), 80)
        new_texture = Texture(lambda: image, name, profile=profile_of(image))
        texture = textures.setdefault(id(image), new_texture)
        return Material(albedo=(1.0, 1.0, 1.0), albedo_map=texture)
    if has_colors:
        return Material(albedo=(1.0, 1.0, 1.0))
    if source is None or stub:
        return Material()
    return Material(albedo=tuple(srgb_to_linear(np.asarray(source.diffuse)[:3] / 255.0)))


def _of_gltf(source: Any, file: str, textures: dict[int, Texture]) -> Material:
    """Convert a trimesh PBR material, which has glTF's factors and 8-bit colours."""

    def texture(name: str, kind: str) -> Texture | None:
        if (image := getattr(source, name)) is None:
            return None
        new_texture = Texture.from_image(image, f"the {kind} map of {file}")
        return textures.setdefault(id(image), new_texture)

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
        warn(f"{file} has metallic materials: drawn as dielectrics, like skin")
    emissive = np.zeros(3) if source.emissiveFactor is None else np.asarray(source.emissiveFactor)
    roughness, cutoff = source.roughnessFactor, source.alphaCutoff
    return Material(
        albedo=tuple(factors[:3].tolist()),
        roughness_factor=1.0 if roughness is None else float(roughness),
        albedo_map=albedo_map,
        normal_map=texture("normalTexture", "normal"),
        roughness_map=properties and properties.channel(1, properties.name),
        occlusion_map=occlusion and occlusion.channel(0, occlusion.name),
        alpha=alpha,  # type: ignore[arg-type]  # Material refuses other modes
        opacity=float(factors[3]),
        alpha_cutoff=0.5 if cutoff is None else float(cutoff),
        opacity_map=opacity_map,
        emissive=tuple(emissive.tolist()),
        emissive_map=texture("emissiveTexture", "emission"),
        double_sided=source.doubleSided,
    )
