"""Mesh files: read by trimesh, checked, mended where that is safe, and placed by their scene graph.
Materials and maps come along as ``scene.Material``. No OpenGL here."""

from __future__ import annotations

import json
import os
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import FacerenderWarning, InputError, reason
from facerender.glsl import data_dir
from facerender.image import srgb_to_linear
from facerender.scene import SKIN_ALBEDO, Material
from facerender.texture import Kind, Texture

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".tga")
# glTF extensions that may be required: handled, or without effect on what is drawn here.
_GLTF_EXTENSIONS = {
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_unlit",
}

_HUGE = 1e100  # coordinates beyond it overflow when they are squared

Path_ = str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in the mesh's space.

    Attributes
    ----------
    positions : (N, 3) float64
    normals : (N, 3) float64, unit vectors
    faces : (F, 3) uint32, counter-clockwise seen from outside
    uv : (N, 2) float64 with v upwards, or None
    colors : (N, 3) linear RGB, or None
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float64] | None = None
    colors: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    """What a mesh file holds.

    Attributes
    ----------
    name : the file's name, for messages
    parts : at least one
    materials : one for each part
    bounds : (2, 3) float64, the lowest and the highest corner of what the faces use
    radius : the largest distance of a vertex from the centre of the bounds
    profile : (K, 2) float64, the outline that the mesh has when it turns about the vertical axis
        through its centre: distance from the axis and height, in the renderer's space
    """

    name: str
    parts: tuple[Part, ...]
    materials: tuple[Material, ...]
    bounds: NDArray[np.float64]
    radius: float
    profile: NDArray[np.float64]

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) float64: the middle of the bounds."""
        return np.asarray(self.bounds.mean(axis=0))

    def normalised(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points, (..., 3), to the renderer's space: centre at the origin, radius 1.

        In float64, so that millimetres, micrometres and large offsets survive the step to float32.
        """
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) / self.radius)

    def denormalised(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points, (..., 3), of the renderer's space back to the mesh's."""
        return np.asarray(np.asarray(points, dtype=np.float64) * self.radius + self.center)

    def with_material(self, **changes: Any) -> Mesh:
        """Return the mesh with fields of every material replaced; geometry and maps are shared.

        A new ``m`` takes the place of a roughness map.

        Raises
        ------
        InputError : a value outside its domain
        """
        if "m" in changes:
            changes = {"roughness_map": None, **changes}
        return replace(self, materials=tuple(replace(each, **changes) for each in self.materials))


def part_maps(part: Part, material: Material, albedo: Kind) -> list[tuple[str, Texture, Kind]]:
    """Return the maps that a part is drawn with: name, texture, kind of mip chain.

    albedo is the kind for the albedo map: "color" or "linear-color".
    """
    if part.uv is None:
        return []
    candidates: list[tuple[str, Texture | None, Kind]] = [
        ("albedo_map", material.albedo_map, albedo),
        ("normal_map", material.normal_map, "data"),
        ("property_map", material.property_map, "data"),
    ]
    return [(name, texture, kind) for name, texture, kind in candidates if texture is not None]


def start_maps(mesh: Mesh, albedo: Kind = "color") -> None:
    """Start decoding the maps of a mesh in threads, ahead of the renderer that waits for them."""
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        for _, texture, kind in part_maps(part, material, albedo):
            texture.levels(kind)


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
    geometries, lost_images = _read(source, skip_images="albedo_map" in overrides)
    textures: dict[int, Texture] = {}  # by image: Pillow decodes an image in one thread only
    pieces = [
        _piece(geometry, transform, source, textures, lost_images)
        for geometry, transform in geometries
    ]
    if flip_v:
        for piece in pieces:
            if piece.uv is not None:
                piece.uv[:, 1] = 1.0 - piece.uv[:, 1]
    if overrides:
        _override(pieces, overrides, source)
    return _assemble(_clean(pieces, source.name), source.name)


# --- reading -------------------------------------------------------------------------------------


def _warn(message: str) -> None:
    warnings.warn(message, FacerenderWarning, stacklevel=2)


def _read(
    path: Path, skip_images: bool
) -> tuple[list[tuple[trimesh.Trimesh, NDArray[np.float64]]], bool]:
    """Return every instance of a geometry with faces and its transform, and whether files that it
    names were not found."""
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InputError(f"{path} is a directory; give a mesh file in it")
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown mesh format {suffix!r}; give {', '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    if not data:
        raise InputError(f"{path.name} is an empty file: there is no geometry in it")
    if suffix in (".glb", ".gltf"):
        _check_gltf(data, path.name, skip_images)

    import trimesh
    from trimesh.resolvers import FilePathResolver

    class Resolver(FilePathResolver):  # type: ignore[misc]
        """Remembers what could not be found or is no image, which trimesh passes over."""

        def __init__(self) -> None:
            super().__init__(str(path), allow_anywhere=True)
            self.missing: list[str] = []
            self.broken: list[str] = []

        def get(self, name: str) -> bytes:
            try:
                content: bytes = super().get(name.replace("\\", "/"))
            except OSError:
                self.missing.append(name)
                raise
            if name.lower().endswith(_IMAGE_SUFFIXES) and not _is_image(content):
                self.broken.append(name)
            return content

    resolver = Resolver()
    try:
        scene = trimesh.load_scene(
            trimesh.util.wrap_as_stream(data),
            file_type=suffix[1:],
            resolver=resolver,
            process=False,
        )
    except Exception as error:  # each reader of trimesh fails in its own way on a damaged file
        if resolver.missing:
            raise InputError(
                f"{resolver.missing[0]} (named by {path.name}) not found in {path.parent}"
            ) from None
        raise InputError(f"{path.name} is damaged ({error}); export it again") from None
    instances = [
        (geometry, np.asarray(transform))
        for transform, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
        if isinstance(geometry := scene.geometry[name], trimesh.Trimesh) and len(geometry.faces)
    ]
    if not instances:
        points = any(len(getattr(g, "vertices", ())) for g in scene.geometry.values())
        what = "are only points and no faces" if points else "is no geometry"
        raise InputError(f"there {what} in {path.name}; give a triangle mesh")
    if not skip_images:
        if resolver.broken:
            raise InputError(
                f"{resolver.broken[0]} (named by {path.name}) is not an image that can "
                "be read; replace it, or pass --albedo FILE"
            )
        _warn_missing(resolver.missing, path)
    return instances, bool(resolver.missing)


def _is_image(content: bytes) -> bool:
    from io import BytesIO

    from PIL import Image

    try:
        Image.open(BytesIO(content))
    except (OSError, Image.DecompressionBombError):
        return False
    return True


def _warn_missing(missing: Sequence[str], path: Path) -> None:
    beside = [each.name for each in path.parent.iterdir() if each.suffix in _IMAGE_SUFFIXES]
    for name in dict.fromkeys(missing):
        hint = f"pass --albedo {beside[0] if len(beside) == 1 else 'FILE'}"
        _warn(
            f"{name} (named by {path.name}) not found in {path.parent}: "
            f"rendering without it; {hint}"
        )


def _check_gltf(data: bytes, name: str, skip_images: bool) -> None:
    """Find what trimesh would pass over: truncation, no mesh, extensions without a decoder, and
    textures in a GLB that are no images."""
    text, binary = data, len(data)
    if data[:4] == b"glTF":
        if len(data) < 20 or (declared := struct.unpack_from("<I", data, 8)[0]) > len(data):
            said = declared if len(data) >= 20 else "at least 20"
            raise InputError(
                f"{name} is truncated: its header says {said} bytes, the file has {len(data)}"
            )
        text = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
        binary = 20 + len(text) + 8
    try:
        document = json.loads(text)
        primitives = [p for mesh in document.get("meshes", ()) for p in mesh["primitives"]]
        embedded = [image for image in document.get("images", ()) if "bufferView" in image]
        views = [document["bufferViews"][image["bufferView"]] for image in embedded]
        required = set(document.get("extensionsRequired", ()))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{name} is not glTF: its JSON cannot be read") from None
    if not primitives:
        raise InputError(f"there is no mesh in {name}; give a file with a triangle mesh")
    for view in [] if skip_images or text is data else views:
        start = binary + view.get("byteOffset", 0)
        if not _is_image(data[start : start + view.get("byteLength", 0)]):
            raise InputError(
                f"a texture in {name} is not an image that can be read; pass --albedo FILE"
            )
    if unknown := sorted(required - _GLTF_EXTENSIONS):
        raise InputError(f"{name} requires the extension {unknown[0]}; export it without")
    if any("KHR_draco_mesh_compression" in p.get("extensions", ()) for p in primitives):
        try:
            import DracoPy  # noqa: F401
        except ImportError:
            raise InputError(f"{name} is compressed with Draco: pip install DracoPy") from None


# --- one geometry --------------------------------------------------------------------------------


@dataclass
class _Piece:
    """A part on its way: normals may be absent, faces may be bad."""

    positions: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64] | None
    uv: NDArray[np.float64] | None
    colors: NDArray[np.float64] | None
    material: Material


def _piece(
    geometry: trimesh.Trimesh,
    transform: NDArray[np.float64],
    source: Path,
    textures: dict[int, Texture],
    lost_images: bool,
) -> _Piece:
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
        _warn(f"{source.name} has no texture coordinates: its texture is ignored")
    with np.errstate(invalid="ignore"):  # such vertices are dropped later
        positions = vertices @ linear.T + transform[:3, 3]
    return _Piece(
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


def _override(pieces: Sequence[_Piece], maps: dict[str, Texture], source: Path) -> None:
    """Give every piece with texture coordinates the maps that the caller named."""
    if all(piece.uv is None for piece in pieces):
        raise InputError(
            f"{source.name} has no texture coordinates, which {next(iter(maps.values())).name} "
            "needs; unwrap the mesh, or render it without maps"
        )
    for piece in pieces:
        if piece.uv is None:
            _warn(f"a part of {source.name} has no texture coordinates: it is drawn without maps")
            continue
        changes: dict[str, Any] = dict(maps)
        if "albedo_map" in maps:
            changes["albedo"] = (1.0, 1.0, 1.0)
            piece.colors = None
        if "roughness_map" in maps:
            changes["roughness_factor"] = 1.0
        piece.material = replace(piece.material, **changes)


# --- all geometries together ---------------------------------------------------------------------


def _clean(pieces: Sequence[_Piece], name: str) -> Sequence[_Piece]:
    """Drop what cannot be drawn, complete the normals, and turn the faces outwards."""
    _drop_bad_faces(pieces, name)
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise InputError(f"no face of {name} has a finite, non-zero area; export the mesh again")
    _complete_normals(pieces, name)

    corners = np.concatenate([piece.positions[piece.faces] for piece in pieces])
    if _outwardness(corners) < -0.5:
        _warn(f"the faces of {name} are inside out: turned")
        for piece in pieces:
            piece.faces = piece.faces[:, ::-1]
            piece.normals = -_present(piece.normals)
    return pieces


def _assemble(pieces: Sequence[_Piece], name: str) -> Mesh:
    used = np.concatenate([piece.positions[np.unique(piece.faces)] for piece in pieces])
    bounds = np.array([used.min(axis=0), used.max(axis=0)])
    offsets = used - bounds.mean(axis=0)
    radius = float(np.linalg.norm(offsets, axis=1).max())
    return Mesh(
        name,
        tuple(
            Part(
                piece.positions,
                _present(piece.normals),
                np.ascontiguousarray(piece.faces, dtype=np.uint32),
                piece.uv,
                piece.colors,
            )
            for piece in pieces
        ),
        tuple(piece.material for piece in pieces),
        bounds,
        radius,
        _profile(offsets / radius),
    )


def _profile(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The widest vertex in each of 512 slices of the height."""
    widths, heights = np.hypot(positions[:, 0], positions[:, 2]), positions[:, 1]
    slices = np.round(heights * 255.0).astype(np.int64)
    order = np.lexsort((widths, slices))
    widest = order[np.diff(slices[order], append=slices.max() + 1) > 0]
    return np.stack([widths[widest], heights[widest]], axis=1)


def _present(normals: NDArray[np.float64] | None) -> NDArray[np.float64]:
    assert normals is not None
    return normals


def _face_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the area times the unit normal of triangles (F, 3, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _outwardness(corners: NDArray[np.float64]) -> float:
    """Mean cosine between the faces' normals and the directions from the centre, by area: near 1
    for a closed head or an open mask, near -1 when they are inside out."""
    normals = _face_normals(corners)
    areas = np.linalg.norm(normals, axis=1)
    middles = corners.mean(axis=1)
    outward = middles - np.average(middles, axis=0, weights=areas)
    return float((normals * outward).sum() / (areas * np.linalg.norm(outward, axis=1)).sum())


def _drop_bad_faces(pieces: Sequence[_Piece], name: str) -> None:
    bad_vertices = bad_faces = flat_faces = 0
    for piece in pieces:
        finite = np.asarray((np.abs(piece.positions) < _HUGE).all(axis=1))
        if not finite.all():
            keep = finite[piece.faces].all(axis=1)
            bad_vertices += int((~finite).sum())
            bad_faces += int((~keep).sum())
            piece.faces = piece.faces[keep]
        keep = _face_normals(piece.positions[piece.faces]).any(axis=1)
        flat_faces += int((~keep).sum())
        piece.faces = piece.faces[keep]
    if bad_vertices:
        _warn(f"{name} has {bad_vertices} non-finite vertices: {bad_faces} faces dropped")
    if flat_faces:
        _warn(f"{name} has {flat_faces} degenerate faces: dropped")


def _complete_normals(pieces: Sequence[_Piece], name: str) -> None:
    """Unit normals for every piece: the file's own where they are good, computed otherwise."""
    without = []
    for piece in pieces:
        if piece.normals is not None:
            length = np.linalg.norm(piece.normals, axis=1)
            good: NDArray[np.bool_] = np.isfinite(length) & (length > 0.0)
            if good[piece.faces].all():
                piece.normals = piece.normals / np.where(good, length, 1.0)[:, None]
                _wind_by_normals(piece)
                continue
            _warn(f"{name} has {int((~good).sum())} normals of zero length: all computed anew")
        without.append(piece)
    if without:
        _compute_normals(without, name)


def _wind_by_normals(piece: _Piece) -> None:
    """Turn the faces whose winding contradicts their vertices' normals."""
    normals = _present(piece.normals)
    face_normals = _face_normals(piece.positions[piece.faces])
    agreement = (face_normals * normals[piece.faces].sum(axis=1)).sum(axis=1)
    piece.faces = np.where((agreement < 0.0)[:, None], piece.faces[:, ::-1], piece.faces)


def _compute_normals(pieces: Sequence[_Piece], name: str) -> None:
    """Smooth normals over vertices welded by position, across seams and materials.

    Face normals are weighted by the angle at the vertex (Thuermer and Wuethrich, 1998), so that
    the result does not depend on how flat polygons are cut into triangles.
    """
    starts = np.cumsum([0] + [len(piece.positions) for piece in pieces])
    positions = np.concatenate([piece.positions for piece in pieces])
    faces = np.concatenate(
        [piece.faces + start for piece, start in zip(pieces, starts, strict=False)]
    )
    used = np.zeros(len(positions), dtype=bool)
    used[faces] = True
    welded = np.zeros(len(positions), dtype=np.int64)
    welded[used] = _weld(positions[used])
    faces = _wind_consistently(faces, welded[faces], positions, name)

    corners = positions[faces]
    unit = _face_normals(corners)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    normals = np.zeros((welded.max() + 1, 3))
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        for axis in range(3):
            normals[:, axis] += np.bincount(
                welded[faces[:, corner]], angle * unit[:, axis], len(normals)
            )
    length = np.linalg.norm(normals, axis=1)
    # Where opposite faces cancel out any direction is as good, as long as it is a unit vector.
    normals = np.where((length > 0.0)[:, None], normals, (0.0, 0.0, 1.0))
    normals /= np.linalg.norm(normals, axis=1)[:, None]

    ends = np.cumsum([len(piece.faces) for piece in pieces])
    for piece, start, each in zip(pieces, starts, np.split(faces, ends[:-1]), strict=False):
        piece.faces = each - start
        piece.normals = normals[welded[start : start + len(piece.positions)]]


def _weld(positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number the positions so that equal ones, to 2^-21 of the extent, share a number."""
    low = positions.min(axis=0)
    extent = float((positions.max(axis=0) - low).max()) or 1.0
    # An even number of cells: the plane of symmetry lies inside one, not between two.
    cells = np.round((positions - low) * ((2**21 - 2) / extent)).astype(np.int64)
    keys = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]
    return np.unique(keys, return_inverse=True)[1].reshape(-1)


def _wind_consistently(
    faces: NDArray[np.int64],
    welded: NDArray[np.int64],
    positions: NDArray[np.float64],
    name: str,
) -> NDArray[np.int64]:
    """Return the faces wound alike within each connected surface, and outwards.

    Consistent neighbours run along their common edge in opposite directions, so a directed edge
    that occurs twice reveals a contradiction. Then each face gets two nodes, kept and turned;
    neighbours join the nodes that agree, and a connected component is one choice for a surface.
    """
    first, second = welded[:, [0, 1, 2]].ravel(), welded[:, [1, 2, 0]].ravel()
    count = int(welded.max()) + 1
    directed = first * count + second
    if len(np.unique(directed)) == len(directed):
        return faces

    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edge = np.minimum(first, second) * count + np.maximum(first, second)
    order = np.argsort(edge, kind="stable")
    _, start, uses = np.unique(edge[order], return_index=True, return_counts=True)
    start = start[uses == 2]  # at an edge of three faces nothing can be told
    a, b = order[start], order[start + 1]
    disagree = (first[a] == first[b]).astype(np.int64)
    face_a, face_b, n = a // 3, b // 3, len(faces)
    rows = np.concatenate([face_a, face_a + n])
    columns = np.concatenate([face_b + n * disagree, face_b + n * (1 - disagree)])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    components, label = connected_components(graph, directed=False)

    corners = positions[faces]
    middle = corners.mean(axis=1)
    outward = (_face_normals(corners) * (middle - middle.mean(axis=0))).sum(axis=1)
    score = np.bincount(label, np.concatenate([outward, -outward]), components)
    turn = score[label[n:]] > score[label[:n]]
    if not turn.any():
        return faces
    _warn(f"{name} has faces wound both ways: {int(turn.sum())} of {n} turned")
    return np.where(turn[:, None], faces[:, ::-1], faces)
