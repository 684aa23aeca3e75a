"""Read the data that trimesh decodes: PLY and STL files, and meshes and scenes of user programs."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason, warn
from facerender.images.image import srgb_to_linear
from facerender.loading.obj import Indices, triangles_of, vertices_of
from facerender.loading.source import TEXTURE_FILE, References, color_bytes, no_faces, text_of
from facerender.material import MAPS, Material
from facerender.mesh.repair import Piece, check_count, placed, with_face_colors, with_faces
from facerender.texture.texture import Texture, profile_of

if TYPE_CHECKING:
    import trimesh

_TYPE = r"(?:u?(?:char|short|int|int8|int16|int32|int64)|float|float16|float32|float64|double)"
_LINES = re.compile(
    r"ply|format (?:ascii|binary_little_endian|binary_big_endian) \S+|(?:comment|obj_info)\b.*|"
    rf"element \S+ \d{{1,18}}|property {_TYPE} \S+|property list {_TYPE} {_TYPE} \S+"
)
_COLORS = (
    *(("red", "green", "blue"), ("r", "g", "b"), ("Red", "Green", "Blue")),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
_POSITION, _NORMAL = (("x", "y", "z"),), (("nx", "ny", "nz"),)
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_TRIANGLE = 50  # bytes per triangle of a binary STL file, after a header of 84 bytes
_Columns = Mapping[str, NDArray[Any]]  # keyed by property


def read_ply(data: bytes, references: References, albedo_given: bool) -> list[Piece]:
    """Return a piece for each texture of a PLY file, or one; raise ValueError if it is damaged."""
    name = references.name
    data, textures = _checked_ply(data, name)
    vertex, face = _decoded_ply(data, name)
    if not len(face) or not len(vertex):
        raise no_faces(name, points=len(vertex) > 0)
    arrays = [_stacked(vertex, names) for names in (_POSITION, _NORMAL, _UV)]
    positions, normals, uv = (None if a is None else a.astype(np.float64) for a in arrays)
    if positions is None:
        raise ValueError("its vertices do not have three coordinates")
    # Some exporters give the only property of faces another name.
    known = [key for key in ("vertex_index", "vertex_indices") if key in face]
    indices = face[known[0] if len(face) > 1 else next(iter(face))]
    sizes = np.array([len(polygon) for polygon in indices])
    starts = np.cumsum(sizes) - sizes
    # The order of trimesh.geometry.triangulate_quads sets the last bits of computed normals.
    groups = [sizes == 3, sizes == 4, sizes > 4]
    corners = np.concatenate([triangles_of(starts[group], sizes[group]) for group in groups])
    vertices = _flat(indices).astype(np.int64)
    valid = ((vertices >= 0) & (vertices < len(positions)))[corners].all(axis=1)
    corners = corners[valid]
    owners = np.searchsorted(starts, corners[:, 0], side="right") - 1
    dropped = int((sizes < 3).sum() + (~valid).sum())
    piece = Piece(positions, vertices[corners], normals, uv, out_of_range=dropped)
    if "texcoord" in face:
        uv = _flat(face["texcoord"]).astype(np.float64).reshape(-1, 2)
        _, first, numbers = np.unique(uv, axis=0, return_index=True, return_inverse=True)
        used, faces = vertices_of(np.stack([vertices, numbers.reshape(-1)], axis=1), corners)
        piece = with_faces(piece, faces, used[:, 0])
        piece.uv = uv[first][used[:, 1]]
    materials: list[Material | None] = []
    for texture in textures:
        content = references.image(texture, "albedo", not albedo_given)
        image = content and Texture.of(content, clipped(texture, 80))
        materials.append(Material(albedo=(1.0, 1.0, 1.0), albedo_map=image) if image else None)
    if not any(materials) or piece.uv is None:
        if any(materials):
            warn(f"{name} has no texture coordinates: its texture is ignored")
        return [_colored(piece, vertex, face, owners, name)]
    if len(textures) == 1 or "texnumber" not in face:
        if len(textures) > 1:
            problem = f"names {len(textures)} textures, but its faces have no texnumber"
            warn(f"{name} {problem}: all get {clipped(textures[0], 60)}")
        return [replace(piece, material=materials[0] or piece.material)]
    numbers = face["texnumber"].reshape(-1)[owners].astype(np.int64)
    pieces = []
    for number in np.unique(numbers).tolist():
        used, faces = np.unique(piece.faces[numbers == number], return_inverse=True)
        part = replace(with_faces(piece, faces.reshape(-1, 3), used), out_of_range=0)
        if 0 <= number < len(textures):
            part.name = PurePath(textures[number]).stem
            part.material = materials[number] or part.material
        else:
            warn(f"{name} has {len(part.faces)} faces whose texnumber {number} names no texture")
        pieces.append(part)
    pieces[0].out_of_range = dropped
    return pieces


def _colored(piece: Piece, vertex: _Columns, face: _Columns, owners: Indices, name: str) -> Piece:
    """Return a piece with the colours of the vertices or, without these, of the faces, with the
    index of the polygon in the file (F,) of each triangle."""
    of_vertices, of_faces = (_stacked(columns, _COLORS) for columns in (vertex, face))
    if of_vertices is not None and of_faces is not None:
        warn(f"{name} has colours of vertices and of faces: the vertex colours are drawn")
    colors = of_faces if of_vertices is None else of_vertices
    if colors is None:
        return piece
    levels = srgb_to_linear(color_bytes(colors) / 255.0)
    piece.material = Material(albedo=(1.0, 1.0, 1.0))
    if of_vertices is None:
        return with_face_colors(piece, levels[owners])
    piece.colors = levels if piece.sources is None else levels[piece.sources]
    return piece


def _checked_ply(data: bytes, name: str) -> tuple[bytes, list[str]]:
    """Check the header of a PLY file, which trimesh trusts. Return the content and the names of its
    textures. Edges get another name, because trimesh would load a file with edges as a drawing."""
    end = data.find(b"end_header", 0, 1 << 16)  # a longer header is refused
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("it has no PLY header")
    stripped = (" ".join(line.split()) for line in text_of(data[:end]).splitlines())
    lines = [*filter(None, stripped)]
    is_text = any(line.startswith("format ascii") for line in lines)
    body = text_of(data[end:]).encode() if is_text and b"\r" in data[end:] else data[end:]
    textures, declared = [], 0
    for line in lines:
        if _LINES.fullmatch(line) is None:
            raise ValueError(f"its header has the invalid line {clipped(line, 60)!r}")
        words = line.split()
        if words[0] == "element":
            declared += int(words[2])
            if words[1] == "tristrips" and int(words[2]):
                remedy = "export it with triangles"
                raise InputError(f"{name} has triangle strips, which are not supported; {remedy}")
        elif (comment := TEXTURE_FILE.fullmatch(line)) is not None:
            textures.append(comment[1])
    # trimesh checks the number of bytes of a binary file, but not the number of lines of a text.
    rows = len(re.findall(rb"\S[^\n]*", body)) - 1 if is_text else declared
    if not declared <= rows <= declared + 16:
        raise ValueError(f"its header declares {declared} lines, but it has {rows}")
    header = "".join(f"{line}\n" for line in lines)
    return header.replace("\nelement edge ", "\nelement line ").encode() + body, textures


def _decoded_ply(data: bytes, name: str) -> list[_Columns]:
    """Return the properties of vertices and faces; lists of one length are arrays (N, K)."""
    from trimesh.exchange.ply import load_ply

    try:
        # Only this entry, which is private to trimesh, has all properties and the polygons.
        content = load_ply(BytesIO(data), skip_materials=True, fix_texture=False)
        elements = content["metadata"]["_ply_raw"]
    except MemoryError:
        raise
    except Exception as error:  # trimesh raises many exceptions for damaged files
        if "unexpected length" in str(error):
            problem = f"{name} has faces with different numbers of corners, or lacks bytes"
            raise InputError(f"{problem}: export it with triangles only, or as text") from None
        raise ValueError(reason(error)) from None
    tables: list[_Columns] = []
    for element in ("vertex", "face"):
        rows = elements.get(element, {}).get("data")
        names = (rows.dtype.names or ()) if isinstance(rows, np.ndarray) else (rows or ())
        columns = {key: np.asarray(rows[key]) for key in names if len(rows[key])}
        for key, column in columns.items():
            if column.dtype.names:  # a list of a binary file: counts and values
                if (column["f0"] != column["f0"][0]).any():
                    raise ValueError(f"its faces have different numbers of {clipped(key, 40)}")
                columns[key] = column["f1"].reshape(len(column), -1)
        tables.append(columns)
    return tables


def _flat(lists: NDArray[Any]) -> NDArray[Any]:
    """Return the values of all lists of a property in one array."""
    return np.concatenate(lists) if lists.dtype == object else lists.reshape(-1)


def _stacked(columns: _Columns, alternatives: Sequence[tuple[str, ...]]) -> NDArray[Any] | None:
    """Return the first alternative whose properties all exist, (N, K); None without one."""
    for names in alternatives:
        if all(name in columns for name in names):
            return np.stack([columns[name].reshape(-1) for name in names], axis=1)
    return None


def read_stl(data: bytes, references: References, albedo_given: bool) -> list[Piece]:
    """Return a piece for each solid of an STL file: binary, or text in any encoding. Bytes after
    the last triangle of a binary file are ignored with a warning. An STL file has no maps."""
    from trimesh.exchange.stl import load_stl

    name = references.name
    if len(data) < 84 or (data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:1024]):
        data = text_of(data).encode()
        check_count(data.lower().count(b"endsolid"), name)
    else:
        (count,) = struct.unpack_from("<I", data, 80)
        needed = 84 + _TRIANGLE * count
        if needed > len(data):
            raise ValueError(f"{count} triangles need {needed} bytes, but it has {len(data)}")
        if needed < len(data):
            warn(f"{name} has {len(data) - needed} bytes after its {count} triangles: ignored")
        # VisCAM sets bit 15 of a coloured triangle's last word. Magics writes COLOR= in the header.
        words = np.frombuffer(data, "<u2", count * (_TRIANGLE // 2), 84).reshape(count, -1)
        if b"COLOR=" in data[:80] or (words[:, -1:] >> 15).any():
            warn(f"{name} has colours of triangles, which are not read: export it as .ply or .glb")
        data = data[:needed]
    try:
        content = load_stl(BytesIO(data))
    except MemoryError:
        raise
    except Exception as error:  # trimesh raises many exceptions for damaged files
        raise ValueError(reason(error)) from None
    solids = content.get("geometry", {"": content}).values()
    return [Piece(solid["vertices"].astype(np.float64), solid["faces"]) for solid in solids]


# --- meshes and scenes of user programs -----------------------------------------------------------


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
    """Return a copy of every mesh instance that has faces, in the ``axes`` of
    :func:`facerender.values.vectors.axes_of`."""
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

    def texture(field: str, name: str) -> Texture | None:
        if (image := getattr(source, field)) is None:
            return None
        new_texture = Texture.from_image(image, f"the {name} map of {file}")
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
