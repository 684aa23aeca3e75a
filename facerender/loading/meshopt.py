"""Views of glTF files that are compressed with meshoptimizer (EXT_meshopt_compression and
KHR_meshopt_compression)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.system.meshoptimizer import library

_MOST, _SMALL, _TIMES = 1 << 30, 1 << 26, 256  # bytes, and of what is small as many times as many
# By the mode: the function, the bytes that an element may have, of how many the count is a multiple
_MODES = {
    "ATTRIBUTES": ("decodeVertexBuffer", range(4, 257, 4), 1),
    "TRIANGLES": ("decodeIndexBuffer", (2, 4), 3),
    "INDICES": ("decodeIndexSequence", (2, 4), 1),
}
_FILTERS = {
    "OCTAHEDRAL": ("decodeFilterOct", (4, 8)),
    "QUATERNION": ("decodeFilterQuat", (8,)),
    "EXPONENTIAL": ("decodeFilterExp", range(4, 257, 4)),
    "COLOR": ("", (4, 8)),
}


def decoded(content: bytes, view: Mapping[str, Any], name: str) -> memoryview:
    """Return the elements that are compressed in a view.

    view : the extension's object
    name : the file's

    Raises
    ------
    ValueError : it is damaged
    InputError : the package meshoptimizer is not installed

    References: Kapoulkine (2022), EXT_meshopt_compression.
    """
    count, size = view["count"], view["byteStride"]
    mode, filter_ = view["mode"], view.get("filter", "NONE")
    what = f"a view compressed with meshopt as {mode} of {count} x {size} bytes"
    function, sizes, multiple = _MODES.get(mode, ("", (), 1))
    own, filtered = _FILTERS.get(filter_, ("", (size,) if filter_ == "NONE" else ()))
    if size not in sizes or size not in filtered or count % multiple:
        raise ValueError(f"{what}, filter {filter_}, is none")
    if filter_ != "NONE" and mode != "ATTRIBUTES":
        raise ValueError(f"{what} has a filter")
    if count * size > min(max(_TIMES * len(content), _SMALL), _MOST):
        raise ValueError(f"{what} in {len(content)} bytes")
    try:
        functions = library()
    except ImportError:
        raise InputError(
            f"{name} is compressed with meshopt: pip install 'facerender[lod]'"
        ) from None
    values = np.empty(count * size, dtype=np.uint8)
    decode = getattr(functions, f"meshopt_{function}")
    if decode(values.ctypes.data, count, size, content, len(content)):
        raise ValueError(f"{what} is no such thing")
    if filter_ == "COLOR":
        values = _rgba(values.view(f"u{size // 4}").reshape(-1, 4)).view(np.uint8).reshape(-1)
    elif own:
        getattr(functions, f"meshopt_{own}")(values.ctypes.data, count, size)
    return values.data


def _rgba(encoded: NDArray[Any]) -> NDArray[Any]:
    """Return colours (N, 4) of Y, Co, Cg and alpha, whose highest bit tells how many bits they
    have: the filter COLOR, which the package does not have yet."""
    signed = encoded.view(encoded.dtype.str.replace("u", "i")).astype(np.int32)
    y, alpha = encoded[:, 0].astype(np.int32), encoded[:, 3].astype(np.int32)
    orange, green = signed[:, 1], signed[:, 2]
    most = alpha.copy()
    for bits in (1, 2, 4, 8):
        most |= most >> bits
    alpha = ((alpha << 1) & most) | (alpha & 1)
    whole = np.stack([y + orange - green, y + green, y - orange - green, alpha], axis=1)
    with np.errstate(all="ignore"):  # no bits at all, in a damaged file
        scale = np.float32(np.iinfo(encoded.dtype).max) / most.astype(np.float32)
        scaled = whole.astype(np.float32) * scale[:, None] + np.float32(0.5)
        return scaled.astype(np.int64).astype(encoded.dtype)
