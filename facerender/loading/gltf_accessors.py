"""Read the binary data of a glTF file: buffers, views (possibly compressed), accessors (possibly
sparse), and from these the animations and morph targets of a rig. A damaged animation or target is
returned with a description of the damage, so that the stored pose can still be drawn."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.gltf_document import COMPONENTS, TYPES, Doc, check_conversion, checked
from facerender.loading.source import References, inline
from facerender.mesh.repair import unique
from facerender.mesh.rig import Clip, Interpolation, Path, Shape, Track
from facerender.mesh.simplify import library
from facerender.system.process import optional

TRIANGLES, _FAN = 4, 6  # primitive modes; mode 5 is a strip
# A decompressed view has at most _MAX_VALUES bytes. A decompressed view of more than _SMALL bytes
# has at most _DECODED_TIMES times the bytes of the compressed view.
_MAX_VALUES, _SMALL, _DECODED_TIMES = 1 << 30, 1 << 26, 256
# Keyed by compression mode: decoder, allowed bytes per element, divisor of the element count.
_MODES = {
    "ATTRIBUTES": ("decodeVertexBuffer", range(4, 257, 4), 1),
    "TRIANGLES": ("decodeIndexBuffer", (2, 4), 3),
    "INDICES": ("decodeIndexSequence", (2, 4), 1),
}
_FILTERS = {
    "NONE": ("", range(1, 257)),
    "OCTAHEDRAL": ("decodeFilterOct", (4, 8)),
    "QUATERNION": ("decodeFilterQuat", (8,)),
    "EXPONENTIAL": ("decodeFilterExp", range(4, 257, 4)),
    "COLOR": ("", (4, 8)),
}


def _decoded(content: bytes, view: Doc, name: str) -> memoryview:
    """Decompress a view, ``view`` as in EXT_meshopt_compression (Kapoulkine 2022)."""
    count, size, mode = view["count"], view["byteStride"], view["mode"]
    filter_ = view.get("filter", "NONE")
    label = f"a view compressed with meshopt ({mode}, {count} x {size} bytes)"
    function, sizes, multiple = _MODES.get(mode, ("", (), 1))
    filter_function, filter_sizes = _FILTERS.get(filter_, ("", ()))
    if size not in sizes or size not in filter_sizes or count % multiple:
        raise ValueError(f"{label} has an invalid mode, filter ({filter_}), count or size")
    if filter_ != "NONE" and mode != "ATTRIBUTES":
        raise ValueError(f"{label} must not have the filter {filter_}")
    if count * size > min(max(_DECODED_TIMES * len(content), _SMALL), _MAX_VALUES):
        raise ValueError(f"{label} is too large for its {len(content)} bytes")
    functions = library(f"{name} is compressed with meshopt: pip install 'facerender[lod]'")
    values = np.empty(count * size, dtype=np.uint8)
    decode = getattr(functions, f"meshopt_{function}")
    if decode(values.ctypes.data, count, size, content, len(content)):
        raise ValueError(f"{label} cannot be decoded")
    if filter_ == "COLOR":
        values = _rgba(values.view(f"u{size // 4}").reshape(-1, 4)).view(np.uint8).reshape(-1)
    elif filter_function:
        getattr(functions, f"meshopt_{filter_function}")(values.ctypes.data, count, size)
    return values.data


def _rgba(encoded: NDArray[Any]) -> NDArray[Any]:
    """Decode the filter COLOR, which meshoptimizer for Python lacks: convert Y, Co, Cg and alpha
    (N, 4) to RGBA. The highest set bit of alpha gives the number of bits per channel."""
    y, _, _, alpha = encoded.astype(np.int32).T
    _, orange, green, _ = encoded.view(encoded.dtype.str.replace("u", "i")).astype(np.int32).T
    full_scale = alpha.copy()
    for bits in (1, 2, 4, 8):
        full_scale |= full_scale >> bits
    alpha = ((alpha << 1) & full_scale) | (alpha & 1)
    rgba = np.stack([y + orange - green, y + green, y - orange - green, alpha], axis=1)
    with np.errstate(all="ignore"):  # alpha may be 0 in a damaged file
        scale = np.float32(np.iinfo(encoded.dtype).max) / full_scale.astype(np.float32)
        scaled = rgba.astype(np.float32) * scale[:, None] + np.float32(0.5)
        return np.asarray(scaled.astype(np.int64), dtype=encoded.dtype)


@dataclass
class Buffers:
    """The binary data of a checked glTF document. Methods raise ValueError for damaged data."""

    name: str
    document: Doc
    binary: memoryview | None
    referred: References
    buffers: dict[int, memoryview] = field(default_factory=dict)
    unpacked: dict[int, memoryview] = field(default_factory=dict)  # decompressed, keyed by view

    def _buffer(self, index: int) -> memoryview:
        if index in self.buffers:
            return self.buffers[index]
        size, uri = (self.document["buffers"][index].get(key) for key in ("byteLength", "uri"))
        content: bytes | memoryview | None = self.binary if uri is None else inline(uri)
        if uri is None and (index or content is None):
            raise ValueError(f"buffers[{index}] has no uri")
        if content is None:
            try:
                content = self.referred.read(uri, "a buffer of a glTF file")
            except FileNotFoundError as error:
                raise InputError(f"{clipped(uri, 80)} (named by {self.name}) {error}") from None
            check_conversion(clipped(uri, 80), content, size)
        if len(content) < size:
            raise ValueError(f"buffers[{index}] should have {size} bytes, but has {len(content)}")
        self.buffers[index] = memoryview(content)[:size]
        return self.buffers[index]

    def view(self, index: int) -> memoryview:
        """Return the decompressed bytes of a view."""
        view = self.document["bufferViews"][index]
        for packed in view.get("extensions", {}).values():
            if index not in self.unpacked:
                content = bytes(self._span(packed, "a view compressed with meshopt"))
                self.unpacked[index] = _decoded(content, packed, self.name)
            return self.unpacked[index][: view["byteLength"]]
        return self._span(view, f"bufferViews[{index}]")

    def _span(self, view: Doc, where: str) -> memoryview:
        buffer = self._buffer(view["buffer"])
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if start + length > len(buffer):
            end = f"byte {start + length} of buffers[{view['buffer']}], which has {len(buffer)}"
            raise ValueError(f"{where} ends at {end}")
        return buffer[start : start + length]

    def _elements(
        self, where: str, properties: Doc, component: str, shape: tuple[int, int]
    ) -> NDArray[Any]:
        """Return the elements of an accessor or of a part of a sparse accessor."""
        view, start = properties["bufferView"], properties.get("byteOffset", 0)
        content = self.view(view)
        component_size = np.dtype(component).itemsize
        row = component_size * shape[1]
        stride = self.document["bufferViews"][view].get("byteStride") or row
        if stride < row:
            raise ValueError(f"bufferViews[{view}].byteStride = {stride} is less than {row}")
        if not shape[0]:
            return np.empty(shape, dtype=component)
        needed = start + stride * (shape[0] - 1) + row
        if needed > len(content):
            problem = f"needs {needed} bytes of bufferViews[{view}], which has {len(content)}"
            raise ValueError(f"{where} {problem}")
        return np.ndarray(shape, component, content, start, (stride, component_size))

    def accessor(self, index: int, decoded: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return the values of an accessor, (count, components). ``decoded``: from DracoPy, which
        returns 16-bit unsigned integers in 32 bits, and signed integers as floats."""
        accessor, where = self.document["accessors"][index], f"accessors[{index}]"
        component, shape = _layout(accessor)
        if decoded is not None:
            converts = decoded.dtype.kind in "iu" or np.dtype(component).kind == "i"
            return _normalized(decoded.astype(component) if converts else decoded, accessor)
        if "bufferView" in accessor:
            values = self._elements(where, accessor, component, shape)
        elif "sparse" not in accessor:
            raise ValueError(f"{where} has no bufferView")
        elif shape[0] * shape[1] * np.dtype(component).itemsize > 1 << 26:
            raise ValueError(f"{where}.count = {shape[0]} is too large without a bufferView")
        else:
            values = np.zeros(shape, dtype=component)
        if "sparse" in accessor:
            indices, replacing = self._replacements(index)
            values = values.copy()
            values[indices] = replacing
        return _normalized(values, accessor)

    def rows(self, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the indices of an accessor's rows that are not 0, in increasing order, and these
        rows as float32. A sparse accessor without a view may have any length."""
        accessor = self.document["accessors"][index]
        if "bufferView" in accessor or "sparse" not in accessor:
            values = self.accessor(index)
            indices = np.arange(len(values))
        else:
            all_indices, replacing = self._replacements(index)
            indices, last = np.unique(all_indices[::-1], return_index=True)
            values = _normalized(replacing[::-1][last], accessor)
        moves = np.logical_or.reduce([column != 0 for column in values.T])
        return indices[moves].astype(np.uint32), values[moves].astype(np.float32)

    def _replacements(self, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the indices and values of the rows that a sparse accessor replaces."""
        accessor, where = self.document["accessors"][index], f"accessors[{index}].sparse"
        sparse, (component, (count, width)) = accessor["sparse"], _layout(accessor)
        of_indices = COMPONENTS[sparse["indices"].get("componentType", 5125)]
        indices = self._elements(where, sparse["indices"], of_indices, (sparse["count"], 1))[:, 0]
        replacing = self._elements(where, sparse["values"], component, (sparse["count"], width))
        if indices.dtype.kind != "u" or (indices >= count).any():
            raise ValueError(f"{where} replaces entries that do not exist")
        return indices, replacing


def _layout(accessor: Doc) -> tuple[str, tuple[int, int]]:
    """Return the type and the shape (count, components) of an accessor's values."""
    return COMPONENTS[accessor["componentType"]], (accessor["count"], TYPES[accessor["type"]])


def _normalized(values: NDArray[Any], accessor: Doc) -> NDArray[Any]:
    """Convert integers of a normalised accessor to floats in [-1, 1]."""
    if accessor.get("normalized") and values.dtype.kind != "f":
        largest = np.float32(np.iinfo(values.dtype).max)
        return np.asarray(np.maximum(values / largest, np.float32(-1.0)))
    return values


_WIDTHS: dict[Path, int] = {"translation": 3, "rotation": 4, "scale": 3}
# Limit of the values read for a rig, because accessors may overlap: _TIMES the bytes of the file's
# buffers plus _FEW, and at most _MAX_WORDS.
_TIMES, _FEW, _MAX_WORDS = 8, 1 << 22, 1 << 28


class Primitive:
    """The triangles of a glTF primitive. Methods raise ValueError if the data are damaged. In
    messages, ``where`` is the primitive's path in the document."""

    def __init__(self, buffers: Buffers, mesh: Doc, index: int, where: str) -> None:
        properties = mesh["primitives"][index]
        self.buffers, self.properties, self.where = buffers, properties, where
        self.attributes: dict[str, int] = properties["attributes"]
        self.extras = mesh.get("extras"), properties.get("extras")
        draco = properties.get("extensions", {}).get("KHR_draco_mesh_compression")
        self.decoded = {} if draco is None else self._draco(draco)
        # Accessors of the morph targets, keyed by POSITION and, with normals, NORMAL
        keys = [key for key in ("POSITION", "NORMAL") if key in self.attributes]
        self.targets: list[dict[str, int]] = [
            {key: target[key] for key in keys if key in target}
            for target in properties.get("targets", ())
        ]
        self.positions = self._attribute("POSITION", (3,))  # (N, 3), all vertices
        faces = self._all_faces(properties.get("mode", TRIANGLES))
        valid = (faces < len(self.positions)).all(axis=1)
        self.out_of_range = len(faces) - int(valid.sum())  # number of dropped faces
        # (F, 3), indices into ``positions[vertices]``
        self.faces = faces[valid] if self.out_of_range else faces
        self.vertices: NDArray[np.int64] | slice = slice(None)  # the vertices that the faces use
        # Primitives may share a vertex array, so most of its vertices may belong to others.
        if len(self.positions) > 3 * len(self.faces):
            self.vertices, inverse = np.unique(self.faces, return_inverse=True)
            self.faces = inverse.reshape(-1, 3)

    def _attribute(self, key: str, widths: tuple[int, ...]) -> NDArray[Any]:
        values = self.buffers.accessor(self.attributes[key], self.decoded.get(key))
        if values.ndim != 2 or values.shape[1] not in widths:
            raise ValueError(f"{self.where}: {key} has the wrong type")
        return values

    def _all_faces(self, mode: int) -> NDArray[np.int64]:
        """Return the faces (F, 3) of a triangle list, strip or fan, and set ``corner_count``."""
        if "faces" in self.decoded:
            corners = self.decoded["faces"]
        elif "indices" in self.properties:
            corners = self.buffers.accessor(self.properties["indices"])
            if corners.shape[1] != 1 or corners.dtype.kind != "u":
                raise ValueError(f"{self.where}: its indices have the wrong type")
        else:
            corners = np.arange(len(self.positions))
        corners = corners.reshape(-1).astype(np.int64)
        self.corner_count = len(corners)
        if mode == TRIANGLES:
            if len(corners) % 3:
                raise ValueError(f"{self.where}: {len(corners)} corners are not a multiple of 3")
            return corners.reshape(-1, 3)
        first = corners[:1].repeat(len(corners[2:])) if mode == _FAN else corners[:-2]
        faces = np.stack([first, corners[1:-1], corners[2:]], axis=1)
        if mode != _FAN:
            faces[1::2] = faces[1::2, ::-1]
        return faces

    def column(self, key: str, *widths: int) -> NDArray[Any] | None:
        """Return an attribute's values at ``vertices``, (N, K in ``widths``); None if missing."""
        if key not in self.attributes:
            return None
        values, count = self._attribute(key, widths), len(self.positions)
        if len(values) != count:
            raise ValueError(f"{self.where}: {key} has {len(values)} entries, POSITION has {count}")
        return values[self.vertices]

    def uv(self, transform: Doc | None) -> NDArray[np.float64] | None:
        """Return transformed texture coordinates with v upwards; None if they are missing."""
        if not transform or (uv := self.column(f"TEXCOORD_{transform['texCoord']}", 2)) is None:
            return None
        u, v = uv.T.astype(np.float64) * np.reshape(transform["scale"], (2, 1))
        if angle := transform["rotation"]:
            cos, sin = math.cos(angle), math.sin(angle)
            u, v = cos * u + sin * v, cos * v - sin * u
        return np.stack([u + transform["offset"][0], 1.0 - (v + transform["offset"][1])], axis=1)

    def influences(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return joint indices and weights, (N, 4 or 8), of ``vertices``; None without joints."""
        sets = [i for i in (0, 1) if {f"JOINTS_{i}", f"WEIGHTS_{i}"} <= self.attributes.keys()]
        if not sets:
            return None
        joints = np.concatenate([np.asarray(self.column(f"JOINTS_{i}", 4)) for i in sets], axis=1)
        weights = np.concatenate([np.asarray(self.column(f"WEIGHTS_{i}", 4)) for i in sets], axis=1)
        if joints.dtype.kind != "u":
            raise ValueError(f"{self.where}: its joints have the wrong type")
        return joints, weights

    def _draco(self, draco: Doc) -> dict[str, NDArray[Any]]:
        """Return the decompressed attributes, keyed by name. Any faces have the key "faces"."""
        missing = f"{self.buffers.name} is compressed with Draco: pip install DracoPy"
        decoder = optional("DracoPy", missing)
        content = bytes(self.buffers.view(draco["bufferView"]))
        try:
            decoded = decoder.decode(content)
            arrays = {item["unique_id"]: np.asarray(item["data"]) for item in decoded.attributes}
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # DracoPy raises several exceptions
            raise ValueError(f"{self.where}: DracoPy failed: {reason(error)}") from None
        attributes = {key: arrays[i] for key, i in draco["attributes"].items() if i in arrays}
        return attributes if faces is None else attributes | {"faces": np.asarray(faces)}


class RigReader:
    """Reads the clips and shapes of a checked glTF document."""

    def __init__(self, buffers: Buffers) -> None:
        self.buffers, self.document = buffers, buffers.document
        size = sum(buffer["byteLength"] for buffer in self.document["buffers"])
        self.left = min(_TIMES * size + _FEW, _MAX_WORDS)  # number of values that may still be read
        self.values: dict[tuple[int, bool], Any] = {}  # see _read()
        self.times: dict[int, NDArray[np.float64]] = {}  # keyed by the accessor's index

    def _read(self, index: int, moves: bool) -> Any:
        """Return the finite values of an accessor or, for ``moves``, the indices and values of its
        rows that are not 0. Several channels and targets may share the result."""
        if (index, moves) not in self.values:
            accessor = self.document["accessors"][index]
            rows = accessor["count"] if "bufferView" in accessor else 0
            rows += accessor.get("sparse", {"count": 0})["count"]
            needed = rows * TYPES[accessor["type"]]
            if needed > self.left:
                raise ValueError("the file has too many animated values")
            values = self.buffers.rows(index) if moves else np.array(self.buffers.accessor(index))
            self.left -= needed
            if not moves and not np.isfinite(values).all():
                raise ValueError(f"accessors[{index}] has a value that is not finite")
            self.values[index, moves] = values
        return self.values[index, moves]

    def clips(self) -> tuple[Clip, ...]:
        """Return the animations with unique names."""
        animations = self.document.get("animations")
        if not isinstance(animations, list):
            return ()
        stored_names = [clip.get("name") if type(clip) is dict else None for clip in animations]
        names = _named(stored_names, "clip", len(animations))
        return tuple(map(self._clip, range(len(animations)), animations, names))

    def _clip(self, index: int, animation: Any, name: str) -> Clip:
        try:
            animation = checked(animation, "animation", f"animations[{index}]", self.document)
            tracks: dict[tuple[int, str], Track] = {}
            ignored = ""
            for i, channel in enumerate(animation["channels"]):
                where = f"animations[{index}].channels[{i}]"
                node, path = channel["target"].get("node"), channel["target"]["path"]
                if path == "pointer":
                    ignored = "KHR_animation_pointer"
                elif node is not None:
                    if (node, path) in tracks:
                        raise ValueError(f"{where} has the same target as another channel")
                    width = self._width(node, path, where)
                    if channel["sampler"] >= len(animation["samplers"]):
                        raise ValueError(f"{where}.sampler = {channel['sampler']} does not exist")
                    keys = animation["samplers"][channel["sampler"]]
                    tracks[node, path] = self._track(node, path, width, keys, where)
            return Clip(name, tuple(tracks.values()), ignored=ignored)
        except ValueError as error:
            return Clip(name, fault=clipped(str(error)))

    def _width(self, index: int, path: str, where: str) -> int:
        """Return the number of values per key."""
        node = self.document["nodes"][index]
        if path in _WIDTHS:
            if "matrix" in node:
                raise ValueError(f"{where} moves nodes[{index}], which has a matrix")
            return _WIDTHS[path]
        if path != "weights":
            raise ValueError(f"{where}.target.path = {clipped(path, 40)!r} is unknown")
        mesh = self.document["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        targets = max((len(part.get("targets", ())) for part in mesh["primitives"]), default=0)
        if not targets:
            raise ValueError(f"{where} has weights for nodes[{index}], which has no morph targets")
        return targets

    def _track(self, node: int, path: Any, width: int, keys: Doc, where: str) -> Track:
        interpolation = keys.get("interpolation", "LINEAR")
        if interpolation not in get_args(Interpolation):
            raise ValueError(f"{where}: interpolation {clipped(interpolation, 40)!r} is unknown")
        times = self._times(keys["input"], where)
        values, count = self._read(keys["output"], moves=False), len(times)
        shape = (count, 3, width) if interpolation == "CUBICSPLINE" else (count, width)
        columns = 1 if path == "weights" else width
        if values.shape != (math.prod(shape) // columns, columns):
            raise ValueError(f"{where}: the values have the shape {values.shape} for {count} keys")
        return Track(node, path, times, values.reshape(shape), interpolation)

    def _times(self, index: int, where: str) -> NDArray[np.float64]:
        if index not in self.times:
            times = self._read(index, moves=False)
            if times.shape[1] != 1 or not len(times):
                raise ValueError(f"{where}: the times have the shape {times.shape}")
            if times[0, 0] < 0.0:
                raise ValueError(f"{where}: the first time is below 0")
            if (times[1:] < times[:-1]).any():
                raise ValueError(f"{where}: the times run backwards")
            self.times[index] = times[:, 0].astype(np.float64)
        return self.times[index]

    def joints(self, nodes: Iterable[int]) -> tuple[tuple[str, int], ...]:
        """Return a unique name and the index of each of the nodes that is a joint of a skin."""
        joints = {joint for skin in self.document["skins"] for joint in skin["joints"]}
        indices = [index for index in nodes if index in joints]
        stored_names = [self.document["nodes"][index].get("name") for index in indices]
        return tuple(zip(_named(stored_names, "joint", len(indices)), indices, strict=True))

    def shapes(self, primitive: Primitive) -> tuple[Shape, ...]:
        """Return the morph targets of a primitive. The first list targetNames in the extras of the
        mesh and of the primitive names them. Otherwise the accessors do, if their names differ."""
        targets, accessors = primitive.targets, self.document["accessors"]
        lists = [extras.get("targetNames") for extras in primitive.extras if type(extras) is dict]
        of_accessors = [accessors[t["POSITION"]].get("name") for t in targets if "POSITION" in t]
        if len({*of_accessors, ""}) > len(targets):  # exporters without targetNames write these
            lists.append(of_accessors)
        stored_names = next((names for names in lists if isinstance(names, list)), [])
        names = _named(stored_names, "shape", len(targets))
        return tuple(self._shape(primitive, i, name) for i, name in enumerate(names))

    def _shape(self, primitive: Primitive, index: int, name: str) -> Shape:
        rows: dict[str, tuple[Any, Any]] = dict.fromkeys(("POSITION", "NORMAL"), (None, None))
        try:
            for key, accessor in primitive.targets[index].items():
                _, shape = _layout(self.document["accessors"][accessor])
                if shape != (len(primitive.positions), 3):
                    where = f"{primitive.where}.targets[{index}]: {key}"
                    raise ValueError(f"{where} has the wrong number of entries")
                rows[key] = indices, moves = self._read(accessor, moves=True)
                if not isinstance(primitive.vertices, slice):  # the part keeps some vertices
                    kept = np.isin(indices, primitive.vertices)
                    indices = np.searchsorted(primitive.vertices, indices[kept])
                    rows[key] = indices.astype(np.uint32), moves[kept]
        except ValueError as error:
            return Shape(name, fault=clipped(str(error)))
        return Shape(name, *rows["POSITION"], *rows["NORMAL"])


def _named(names: list[Any], noun: str, count: int) -> Iterator[str]:
    """Yield ``count`` unique names of one line; the second, if empty or no text, is ``shape2``."""
    padded = enumerate([*names, *[None] * count][:count], 1)
    texts = ((i, clipped(name, 80) if isinstance(name, str) else "") for i, name in padded)
    return unique(text or f"{noun}{i}" for i, text in texts)
