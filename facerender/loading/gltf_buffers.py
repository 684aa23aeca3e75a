"""Read the binary data of a glTF file: buffers, views (possibly compressed), and accessors
(possibly sparse)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped
from facerender.loading.gltf_document import COMPONENTS, TYPES, Doc, conversion, converted
from facerender.loading.references import References, inline
from facerender.system.meshoptimizer import library

# A decompressed view has at most _MOST bytes. A decompressed view of more than _SMALL bytes has at
# most _TIMES times the bytes of the compressed view.
_MOST, _SMALL, _TIMES = 1 << 30, 1 << 26, 256
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


def decoded(content: bytes, view: Doc, name: str) -> memoryview:
    """Decompress a buffer view that uses EXT_meshopt_compression.

    view : the extension's JSON object
    name : name of the file, for messages

    Raises
    ------
    ValueError : the view is damaged
    InputError : the package meshoptimizer is not installed

    References: Kapoulkine (2022), EXT_meshopt_compression.
    """
    count, size = view["count"], view["byteStride"]
    mode, filter_ = view["mode"], view.get("filter", "NONE")
    shown = f"a view compressed with meshopt ({mode}, {count} x {size} bytes)"
    function, sizes, multiple = _MODES.get(mode, ("", (), 1))
    filter_function, filter_sizes = _FILTERS.get(filter_, ("", ()))
    if size not in sizes or size not in filter_sizes or count % multiple:
        raise ValueError(f"{shown} has an invalid mode, filter ({filter_}), count or size")
    if filter_ != "NONE" and mode != "ATTRIBUTES":
        raise ValueError(f"{shown} must not have the filter {filter_}")
    if count * size > min(max(_TIMES * len(content), _SMALL), _MOST):
        raise ValueError(f"{shown} is too large for its {len(content)} bytes")
    try:
        functions = library()
    except ImportError:
        raise InputError(
            f"{name} is compressed with meshopt: pip install 'facerender[lod]'"
        ) from None
    values = np.empty(count * size, dtype=np.uint8)
    decode = getattr(functions, f"meshopt_{function}")
    if decode(values.ctypes.data, count, size, content, len(content)):
        raise ValueError(f"{shown} cannot be decoded")
    if filter_ == "COLOR":
        values = _rgba(values.view(f"u{size // 4}").reshape(-1, 4)).view(np.uint8).reshape(-1)
    elif filter_function:
        getattr(functions, f"meshopt_{filter_function}")(values.ctypes.data, count, size)
    return values.data


def _rgba(encoded: NDArray[Any]) -> NDArray[Any]:
    """Decode the filter COLOR, which meshoptimizer for Python lacks: convert Y, Co, Cg and alpha
    (N, 4) to RGBA. The highest set bit of alpha gives the number of bits per channel."""
    signed = encoded.view(encoded.dtype.str.replace("u", "i")).astype(np.int32)
    y, alpha = encoded[:, 0].astype(np.int32), encoded[:, 3].astype(np.int32)
    orange, green = signed[:, 1], signed[:, 2]
    full_scale = alpha.copy()
    for bits in (1, 2, 4, 8):
        full_scale |= full_scale >> bits
    alpha = ((alpha << 1) & full_scale) | (alpha & 1)
    rgba = np.stack([y + orange - green, y + green, y - orange - green, alpha], axis=1)
    with np.errstate(all="ignore"):  # alpha may be 0 in a damaged file
        scale = np.float32(np.iinfo(encoded.dtype).max) / full_scale.astype(np.float32)
        scaled = rgba.astype(np.float32) * scale[:, None] + np.float32(0.5)
        return scaled.astype(np.int64).astype(encoded.dtype)


_MOST_ZEROS = 1 << 26  # largest sparse accessor without a view, in bytes


class Buffers:
    """The buffers, views and accessors of a checked glTF document. Methods raise ValueError if
    the data are damaged or missing."""

    def __init__(
        self, name: str, document: Doc, binary: memoryview | None, referred: References
    ) -> None:
        self.name = name
        self.document = document
        self.binary = binary
        self.referred = referred
        self.buffers: dict[int, memoryview] = {}
        self.unpacked: dict[int, memoryview] = {}  # decompressed bytes, keyed by the view's index

    def _buffer(self, index: int) -> memoryview:
        if index not in self.buffers:
            declared = self.document["buffers"][index]
            size = declared["byteLength"]
            content = self._buffer_content(index, declared.get("uri"), size)
            if len(content) < size:
                raise ValueError(
                    f"buffers[{index}] should have {size} bytes, but has {len(content)}"
                )
            self.buffers[index] = content[:size]
        return self.buffers[index]

    def _buffer_content(self, index: int, uri: str | None, size: int) -> memoryview:
        if uri is None:
            if index or self.binary is None:
                raise ValueError(f"buffers[{index}] has no uri")
            return self.binary
        if (content := inline(uri)) is None:
            try:
                content = self.referred.read(uri, "a buffer of a glTF file")
            except FileNotFoundError as error:
                raise InputError(f"{clipped(uri, 80)} (named by {self.name}) {error}") from None
            if how := conversion(content, size):
                raise converted(clipped(uri, 80), how)
        return memoryview(content)

    def view(self, index: int) -> memoryview:
        """Return the bytes of a view, after decompression if the view is compressed."""
        view = self.document["bufferViews"][index]
        for packed in view.get("extensions", {}).values():
            if index not in self.unpacked:
                content = bytes(self._span(packed, "a view compressed with meshopt"))
                self.unpacked[index] = decoded(content, packed, self.name)
            return self.unpacked[index][: view["byteLength"]]
        return self._span(view, f"bufferViews[{index}]")

    def _span(self, view: Doc, where: str) -> memoryview:
        buffer = self._buffer(view["buffer"])
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if start + length > len(buffer):
            raise ValueError(
                f"{where} ends at byte {start + length} of buffers[{view['buffer']}], "
                f"which has {len(buffer)}"
            )
        return buffer[start : start + length]

    def _elements(
        self, where: str, view: int, start: int, kind: str, shape: tuple[int, int]
    ) -> NDArray[Any]:
        """Return elements of a view; ``shape`` is (count, components)."""
        content = self.view(view)
        component_size = np.dtype(kind).itemsize
        row = component_size * shape[1]
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
        return np.ndarray(shape, kind, content, start, (stride, component_size))

    def accessor(self, index: int) -> NDArray[Any]:
        """Return the values of an accessor, (count, components)."""
        accessor, where = self.document["accessors"][index], f"accessors[{index}]"
        kind, shape = _layout(accessor)
        if "bufferView" in accessor:
            start = accessor.get("byteOffset", 0)
            values = self._elements(where, accessor["bufferView"], start, kind, shape)
        elif "sparse" not in accessor:
            raise ValueError(f"{where} has no bufferView")
        elif shape[0] * shape[1] * np.dtype(kind).itemsize > _MOST_ZEROS:
            raise ValueError(f"{where}.count = {shape[0]} is too large without a bufferView")
        else:
            values = np.zeros(shape, dtype=kind)
        if "sparse" in accessor:
            indices, replacing = self._replacements(index)
            values = values.copy()
            values[indices] = replacing
        return _normalized(values, accessor)

    def converted(self, values: NDArray[Any], index: int) -> NDArray[Any]:
        """Return Draco's values of an accessor, as the accessor without Draco would return them.

        DracoPy returns 16-bit unsigned integers in 32 bits, and signed integers as floats.
        """
        accessor = self.document["accessors"][index]
        stored = np.dtype(COMPONENTS[accessor["componentType"]])
        if values.dtype.kind in "iu" or stored.kind == "i":
            values = values.astype(stored)
        return _normalized(values, accessor)

    def rows(self, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the indices of an accessor's rows that are not 0, in increasing order, and these
        rows. A sparse accessor without a view may have any length."""
        accessor = self.document["accessors"][index]
        if "bufferView" in accessor or "sparse" not in accessor:
            values = self.accessor(index)
            indices = np.arange(len(values))
        else:
            all_indices, replacing = self._replacements(index)
            indices, last = np.unique(all_indices[::-1], return_index=True)
            values = _normalized(replacing[::-1][last], accessor)
        moves = np.logical_or.reduce([column != 0 for column in values.T])
        return indices[moves], values[moves]

    def _replacements(self, index: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the indices and values of the rows that a sparse accessor replaces."""
        accessor, where = self.document["accessors"][index], f"accessors[{index}].sparse"
        sparse, (kind, (count, width)) = accessor["sparse"], _layout(accessor)

        def part(properties: Doc, kind: str, width: int) -> NDArray[Any]:
            start, shape = properties.get("byteOffset", 0), (sparse["count"], width)
            return self._elements(where, properties["bufferView"], start, kind, shape)

        kind_of_index = COMPONENTS[sparse["indices"].get("componentType", 5125)]
        indices = part(sparse["indices"], kind_of_index, 1)[:, 0]
        replacing = part(sparse["values"], kind, width)
        if indices.dtype.kind != "u" or (indices >= count).any():
            raise ValueError(f"{where} replaces entries that do not exist")
        return indices, replacing


def _layout(accessor: Doc) -> tuple[str, tuple[int, int]]:
    """Return the type of an accessor's values, and their shape (count, components)."""
    return COMPONENTS[accessor["componentType"]], (accessor["count"], TYPES[accessor["type"]])


def _normalized(values: NDArray[Any], accessor: Doc) -> NDArray[Any]:
    """Return integers of a normalised accessor as floats in [-1, 1], other values unchanged."""
    if accessor.get("normalized") and values.dtype.kind != "f":
        largest = np.float32(np.iinfo(values.dtype).max)
        return np.asarray(np.maximum(values / largest, np.float32(-1.0)))
    return values
