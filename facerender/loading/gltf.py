"""glTF files, text or binary: every instance of a triangle mesh, its materials and their images."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason, warn
from facerender.loading.gltf_schema import COMPONENTS, TYPES, damaged, document_of
from facerender.loading.images import image_of, missing_image, unreadable
from facerender.loading.referred import Referred, inline
from facerender.loading.repair import Piece, check_count, placed
from facerender.scenes.material import SKIN_ALBEDO, Material
from facerender.scenes.texture import Texture

# Extensions that may be required: handled, or without effect on what is drawn here.
_EXTENSIONS = {
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_unlit",
    "EXT_texture_webp",
}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_TIMES, _MOST_REPEATED = 8, 1 << 20  # vertices and faces are drawn, and so many more at most
_MOST_ZEROS = 1 << 26  # bytes that a sparse accessor need not hold
_TRANSFORMS = ("matrix", "translation", "rotation", "scale")
_DRACO = "KHR_draco_mesh_compression"

Doc = dict[str, Any]


def read_gltf(data: bytes, referred: Referred, without_albedo: bool) -> list[Piece]:
    """Return every instance of a primitive with triangles.

    referred : reads buffers and images
    without_albedo : the albedo of the file is not wanted

    Raises
    ------
    InputError : it is damaged, requires what is not understood, or draws no triangles
    """
    name = clipped(referred.source.name, 80)
    text, binary = _chunks(data, name)
    document = document_of(text, name)
    if unknown := sorted(set(document.get("extensionsRequired", ())) - _EXTENSIONS):
        raise InputError(
            f"{name} requires the extension {clipped(unknown[0], 60)}; export it without"
        )
    try:
        return _File(name, document, binary, referred, without_albedo).pieces()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise damaged(name, reason(error)) from None


def _chunks(data: bytes, name: str) -> tuple[bytes, memoryview | None]:
    """Return the JSON and the binary chunk of a file; without the latter, a text is all JSON."""
    if data[:4] != b"glTF":
        return data, None
    declared = struct.unpack_from("<I", data, 8)[0] if len(data) >= 20 else 20
    if declared > len(data):
        said = declared if len(data) >= 20 else "at least 20"
        raise InputError(
            f"{name} is truncated: its header says {said} bytes, the file has {len(data)}"
        )
    if (version := struct.unpack_from("<I", data, 4)[0]) != 2:
        raise InputError(f"{name} is glTF of version {version}: export it as version 2")
    chunks: dict[int, memoryview] = {}
    start = 12
    while start + 8 <= declared:
        length, kind = struct.unpack_from("<II", data, start)
        if start + 8 + length > declared:
            raise damaged(name, f"a chunk of {length} bytes in a file of {declared}")
        chunks.setdefault(kind, memoryview(data)[start + 8 : start + 8 + length])
        start += 8 + length
    if _JSON not in chunks:
        raise damaged(name, "it has no chunk of JSON")
    return bytes(chunks[_JSON]), chunks.get(_BINARY)


class _File:
    """A document whose properties are sound, but not yet what they say of buffers. Methods raise
    ValueError for what is damaged."""

    def __init__(
        self,
        name: str,
        document: Doc,
        binary: memoryview | None,
        referred: Referred,
        without_albedo: bool,
    ) -> None:
        self.name = name
        self.document = document
        self.binary = binary
        self.referred = referred
        self.without_albedo = without_albedo
        self.buffers: dict[int, memoryview] = {}
        self.images: dict[int, Texture | None] = {}
        self.materials: dict[int | None, Material] = {}
        self.own: dict[int, int] = {}  # elements of accessors that faces are made of
        self.drawn = 0  # vertices and faces
        self.lost_images = False

    def pieces(self) -> list[Piece]:
        instances = []
        count = 0
        for index, world in self._instances():
            count += len(self.document["meshes"][index]["primitives"])
            check_count(count, self.name)
            instances.append((index, world))
        meshes: dict[int, list[Piece]] = {}
        pieces = []
        for index, world in instances:
            if index not in meshes:
                meshes[index] = [
                    piece
                    for i, primitive in enumerate(self.document["meshes"][index]["primitives"])
                    if (piece := self._piece(primitive, f"meshes[{index}].primitives[{i}]"))
                ]
            for piece in meshes[index]:
                self._count_drawn(piece)
                pieces.append(placed(piece, world))
        return pieces

    def _count_drawn(self, piece: Piece) -> None:
        self.drawn += len(piece.positions) + len(piece.faces)
        if self.drawn > _TIMES * sum(self.own.values()) + _MOST_REPEATED:
            raise InputError(
                f"{self.name} draws what it holds more than {_TIMES} times over: export fewer "
                "instances"
            )

    def _instances(self) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Every node with a mesh below the scene's roots, and its transform; without scenes, below
        all roots."""
        nodes = self.document["nodes"]
        if scenes := self.document["scenes"]:
            roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        else:
            roots = sorted(
                set(range(len(nodes))) - {i for node in nodes for i in node.get("children", ())}
            )
        seen: set[int] = set()
        origin = np.eye(4)
        queue = [(index, origin) for index in reversed(roots)]
        while queue:
            index, world = queue.pop()
            if index in seen:
                raise ValueError(f"nodes[{index}] has two parents, or is below itself")
            seen.add(index)
            node = nodes[index]
            if not node.keys().isdisjoint(_TRANSFORMS):
                world = world @ _transform(node)
            if "mesh" in node:
                yield node["mesh"], world
            queue += [(child, world) for child in reversed(node.get("children", []))]

    # --- bytes -----------------------------------------------------------------------------------

    def _buffer(self, index: int) -> memoryview:
        if index not in self.buffers:
            declared = self.document["buffers"][index]
            content = self._buffer_content(index, declared.get("uri"))
            if len(content) < declared["byteLength"]:
                raise ValueError(
                    f"buffers[{index}] should have {declared['byteLength']} bytes, and has "
                    f"{len(content)}"
                )
            self.buffers[index] = content[: declared["byteLength"]]
        return self.buffers[index]

    def _buffer_content(self, index: int, uri: str | None) -> memoryview:
        if uri is None:
            if index or self.binary is None:
                raise ValueError(f"buffers[{index}] has no uri")
            return self.binary
        content = inline(uri)
        if content is None:
            try:
                content = self.referred.read(uri, "a buffer of a glTF file")
            except FileNotFoundError as error:
                raise InputError(f"{clipped(uri, 80)} (named by {self.name}) {error}") from None
        return memoryview(content)

    def _view(self, index: int) -> memoryview:
        view = self.document["bufferViews"][index]
        buffer = self._buffer(view["buffer"])
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if start + length > len(buffer):
            raise ValueError(
                f"bufferViews[{index}] ends at byte {start + length} of buffers[{view['buffer']}], "
                f"which has {len(buffer)}"
            )
        return buffer[start : start + length]

    def _elements(
        self, where: str, view: int, start: int, kind: str, shape: tuple[int, int]
    ) -> NDArray[Any]:
        """Return elements (count, components) in a view."""
        content = self._view(view)
        item = np.dtype(kind).itemsize
        row = item * shape[1]
        stride = self.document["bufferViews"][view].get("byteStride") or row
        if stride < row:
            raise ValueError(f"bufferViews[{view}].byteStride = {stride} is less than {row}")
        needed = start + stride * (shape[0] - 1) + row if shape[0] else 0
        if needed > len(content):
            raise ValueError(
                f"{where} needs {needed} bytes of bufferViews[{view}], which has {len(content)}"
            )
        if not shape[0]:
            return np.empty(shape, dtype=kind)
        return np.ndarray(shape, kind, content, start, (stride, item))

    def _accessor(self, index: int) -> NDArray[Any]:
        """Return the values of an accessor, (count, components)."""
        accessor = self.document["accessors"][index]
        where = f"accessors[{index}]"
        kind = COMPONENTS[accessor["componentType"]]
        shape = accessor["count"], TYPES[accessor["type"]]
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            start = accessor.get("byteOffset", 0)
            values = self._elements(where, accessor["bufferView"], start, kind, shape)
        elif sparse is None:
            raise ValueError(f"{where} has no bufferView")
        elif shape[0] * shape[1] * np.dtype(kind).itemsize > _MOST_ZEROS:
            raise ValueError(f"{where}.count = {shape[0]} without a bufferView")
        else:
            values = np.zeros(shape, dtype=kind)
        if sparse is not None:
            values = self._with_sparse(values, sparse, where)
        if accessor.get("normalized") and kind != "<f4":
            values = np.maximum(values / np.float32(np.iinfo(kind).max), np.float32(-1.0))
        return values

    def _with_sparse(self, values: NDArray[Any], sparse: Doc, where: str) -> NDArray[Any]:
        """Return values, some of which are replaced."""
        count = sparse["count"]
        parts = [
            self._elements(
                f"{where}.sparse", part["bufferView"], part.get("byteOffset", 0), kind, (count, n)
            )
            for part, kind, n in (
                (
                    sparse["indices"],
                    COMPONENTS[sparse["indices"].get("componentType", 5125)],
                    1,
                ),
                (sparse["values"], values.dtype.str, values.shape[1]),
            )
        ]
        indices = parts[0][:, 0]
        if indices.dtype.kind != "u" or (indices >= len(values)).any():
            raise ValueError(f"{where}.sparse replaces entries that are not there")
        values = values.copy()
        values[indices] = parts[1]
        return values

    # --- triangles -------------------------------------------------------------------------------

    def _piece(self, primitive: Doc, where: str) -> Piece | None:
        """Return a primitive in its own space; None where it is none of triangles."""
        mode = primitive.get("mode", _TRIANGLES)
        numbers = primitive["attributes"]
        if mode < _TRIANGLES or "POSITION" not in numbers:
            return None
        draco = primitive.get("extensions", {}).get(_DRACO)
        known = {} if draco is None else self._draco(draco, where)

        def attribute(key: str, widths: tuple[int, ...]) -> NDArray[Any] | None:
            if key not in numbers:
                return None
            values = known[key] if key in known else self._accessor(numbers[key])
            if values.ndim != 2 or values.shape[1] not in widths:
                raise ValueError(f"{where}: {key} has the wrong type")
            return values

        positions = attribute("POSITION", (3,))
        assert positions is not None
        if "faces" in known:
            flat = known["faces"].reshape(-1)
        elif "indices" in primitive:
            indices = self._accessor(primitive["indices"])
            if indices.shape[1] != 1 or indices.dtype.kind != "u":
                raise ValueError(f"{where}: its indices have the wrong type")
            flat = indices.reshape(-1)
        else:
            flat = np.arange(len(positions))
        faces, kept, strangers = _compact(_triangles(flat, mode, where), len(positions))
        self.own[numbers["POSITION"]] = len(positions)
        self.own[primitive.get("indices", -1)] = len(flat)
        columns: dict[str, NDArray[Any] | None] = {"POSITION": positions}
        for key, widths in (("NORMAL", (3,)), ("TEXCOORD_0", (2,)), ("COLOR_0", (3, 4))):
            values = columns[key] = attribute(key, widths)
            if values is not None and len(values) != len(positions):
                raise ValueError(
                    f"{where}: {key} has {len(values)} entries, POSITION {len(positions)}"
                )
        columns = {key: each if each is None else each[kept] for key, each in columns.items()}
        uv = columns["TEXCOORD_0"]
        if uv is not None:
            uv = np.array(uv, dtype=np.result_type(uv, np.float32))
            uv[:, 1] = 1.0 - uv[:, 1]  # upwards
        number = primitive.get("material")
        colors = columns["COLOR_0"] if number is None else None
        if number not in self.materials:
            self.materials[number] = self._material(number, colors is not None)
        material = self.materials[number]
        if uv is None and material.albedo_map is not None:
            warn(f"{self.name} has no texture coordinates: its texture is ignored")
        return Piece(
            positions=np.asarray(columns["POSITION"], dtype=np.float64),
            faces=faces,
            normals=columns["NORMAL"],
            uv=None if uv is None else uv.astype(np.float64),
            colors=None if colors is None else _unit_colors(colors),
            material=material,
            strangers=strangers,
        )

    def _draco(self, draco: Doc, where: str) -> dict[str, NDArray[Any]]:
        """Return what is compressed of a primitive: attributes by name, and faces."""
        try:
            import DracoPy
        except ImportError:
            raise InputError(f"{self.name} is compressed with Draco: pip install DracoPy") from None
        content = bytes(self._view(draco["bufferView"]))
        try:
            decoded = DracoPy.decode(content)
            found = {each["unique_id"]: np.asarray(each["data"]) for each in decoded.attributes}
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # its decoder fails in several ways
            raise ValueError(f"{where}: Draco says {reason(error)}") from None
        values = {key: found[i] for key, i in draco["attributes"].items() if i in found}
        return values if faces is None else values | {"faces": np.asarray(faces)}

    # --- materials -------------------------------------------------------------------------------

    def _material(self, index: int | None, has_colors: bool) -> Material:
        if index is None:
            return Material(albedo=(1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO)
        source = self.document["materials"][index]
        metallic = source.get("pbrMetallicRoughness", {})
        glossy = source.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
        factor = glossy.get("diffuseFactor", metallic.get("baseColorFactor", [1.0] * 4))
        albedo_map = None
        if not self.without_albedo:
            use = glossy.get("diffuseTexture", metallic.get("baseColorTexture"))
            albedo_map = self._map(use, "albedo")
        properties = self._map(metallic.get("metallicRoughnessTexture"), "roughness")
        occlusion = self._map(source.get("occlusionTexture"), "occlusion")
        normal_map = self._map(source.get("normalTexture"), "normal")
        red, green, blue = (self._factor("albedo", each) for each in factor[:3])
        albedo = (red, green, blue)
        if self.lost_images and albedo_map is None and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # white was meant to multiply the image
        return Material(
            albedo=albedo,
            # Without a map it does not count: exporters write 1 or 0.5 by default.
            roughness_factor=self._factor("roughness", metallic.get("roughnessFactor", 1.0)),
            albedo_map=albedo_map,
            normal_map=normal_map,
            roughness_map=properties and properties.channel(1, properties.name),
            occlusion_map=occlusion and occlusion.channel(0, occlusion.name),
        )

    def _factor(self, what: str, value: float) -> float:
        if not 0.0 <= value <= 1.0:
            warn(f"the {what} factor {value:.6g} of {self.name} is outside [0, 1]: brought there")
        return float(min(max(value, 0.0), 1.0))

    def _map(self, use: Doc | None, kind: str) -> Texture | None:
        """Return the texture of a material's map; one of those that are wanted must be an image."""
        if use is None:
            return None
        texture = self.document["textures"][use["index"]]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        source = webp.get("source", texture.get("source"))
        if source is None:
            warn(f"the {kind} map of {self.name} has no image that is understood: left out")
            self.lost_images = True
            return None
        if use.get("texCoord", 0):
            warn(
                f"the {kind} map of {self.name} has texture coordinates of its own: "
                "the first ones are used"
            )
        if source not in self.images:
            self.images[source] = self._image(source, kind)
        return self.images[source]

    def _image(self, index: int, kind: str) -> Texture | None:
        entry = self.document["images"][index]
        shown = f"the {kind} map of {self.name}"
        try:
            if "bufferView" in entry:
                content = bytes(self._view(entry["bufferView"]))
            elif "uri" not in entry:
                raise ValueError(f"images[{index}] has neither uri nor bufferView")
            elif (found := inline(entry["uri"])) is not None:
                content = found
            else:
                shown = f"{clipped(entry['uri'], 80)} (named by {self.name})"
                content = self.referred.read(entry["uri"], "an image file")
        except FileNotFoundError:
            missing_image(self.referred, entry["uri"])
            self.lost_images = True
            return None
        try:
            image = image_of(content)
        except ValueError:
            unreadable(shown, kind, fatal=not self.without_albedo)
            self.lost_images = True
            return None
        return Texture(lambda: image, f"the {kind} map of {self.name}")


def _transform(node: Doc) -> NDArray[np.float64]:
    """Return a node's matrix (4, 4), for columns."""
    matrix = np.eye(4)
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    local = np.eye(4)
    if "rotation" in node:
        local[:3, :3] = _rotation(np.array(node["rotation"], dtype=np.float64))
    if "scale" in node:
        local[:3, :3] *= np.array(node["scale"], dtype=np.float64)
    if "translation" in node:
        local[:3, 3] = node["translation"]
    return matrix @ local


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of a quaternion x, y, z, w of any length."""
    length = float(np.linalg.norm(quaternion))
    if not 1e-12 < length < np.inf:
        return np.eye(3)
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _triangles(flat: NDArray[Any], mode: int, where: str) -> NDArray[np.int64]:
    """Return the faces (F, 3) of a list, strip or fan of vertices."""
    flat = flat.astype(np.int64)
    if mode == _TRIANGLES:
        if len(flat) % 3:
            raise ValueError(f"{where}: {len(flat)} corners are no triangles")
        return flat.reshape(-1, 3)
    if mode == _FAN:
        first = np.full_like(flat[2:], flat[0] if len(flat) else 0)
        return np.stack([first, flat[1:-1], flat[2:]], axis=1)
    strip = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
    strip[1::2] = strip[1::2, ::-1]
    return strip


def _compact(
    faces: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64] | slice, int]:
    """Return the faces of the vertices that are there, which vertices to keep, and how many faces
    are of others. Where primitives share vertices, most of them are another's."""
    known = (faces < count).all(axis=1)
    strangers = len(faces) - int(known.sum())
    if strangers:
        faces = faces[known]
    if count <= 3 * len(faces):
        return faces, slice(None), strangers
    kept, inverse = np.unique(faces, return_inverse=True)
    return inverse.reshape(-1, 3), kept, strangers


def _unit_colors(colors: NDArray[Any]) -> NDArray[np.float64]:
    """Return linear RGB in [0, 1]."""
    if colors.dtype.kind != "f":  # not said to be normalised, and meant so
        colors = colors / np.iinfo(colors.dtype).max
    return np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)
