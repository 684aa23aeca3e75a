"""Call functions of meshoptimizer (Kapoulkine, 2016-2026) through ctypes. This requires the extra
``lod``."""

from __future__ import annotations

import ctypes
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

_POINTER, _SIZE, _FLOAT = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_float
_DECODER = ctypes.c_int, [_POINTER, _SIZE, _SIZE, _POINTER, _SIZE]
_FILTER = None, [_POINTER, _SIZE, _SIZE]
# Types of result and arguments of each function, as in src/meshoptimizer.h of version 0.23.
_TYPES: dict[str, tuple[Any, list[Any]]] = {
    "simplifyWithAttributes": (
        _SIZE,
        [_POINTER, _POINTER, _SIZE, _POINTER, _SIZE, _SIZE, _POINTER, _SIZE, _POINTER, _SIZE]
        + [_POINTER, _SIZE, _FLOAT, ctypes.c_uint, _POINTER],
    ),
    "optimizeVertexCache": (None, [_POINTER, _POINTER, _SIZE, _SIZE]),
    **dict.fromkeys(("decodeVertexBuffer", "decodeIndexBuffer", "decodeIndexSequence"), _DECODER),
    **dict.fromkeys(("decodeFilterOct", "decodeFilterQuat", "decodeFilterExp"), _FILTER),
}


@cache
def library() -> ctypes.CDLL:
    """Return the compiled library of the Python package meshoptimizer, with declared types.

    The package's wrappers are not imported: they declare no types for simplify_with_attributes and
    the filters, pass 64-bit sizes as 32-bit integers, and therefore crash. Raise ImportError if
    the package is not installed."""
    package = find_spec("meshoptimizer")
    places = package.submodule_search_locations if package else None
    spec = PathFinder.find_spec("_meshoptimizer", places) if places else None
    if spec is None or spec.origin is None:
        raise ImportError("the package meshoptimizer is not installed")
    functions = ctypes.CDLL(spec.origin)
    for name, (result, arguments) in _TYPES.items():
        function = getattr(functions, f"meshopt_{name}")
        function.restype, function.argtypes = result, arguments
    return functions


def collapsed(
    faces: NDArray[np.uint32],
    positions: NDArray[np.float32],
    attributes: NDArray[np.float32],
    weights: NDArray[np.float32],
    triangles: int,
) -> NDArray[np.uint32]:
    """Collapse edges, without an error limit, until at most ``triangles`` faces remain if possible.
    Return these faces, as indices into ``positions``.

    faces : (F, 3), indices into positions
    positions : (N, 3)
    attributes : (N, K), values per vertex, for example the components of the normal
    weights : (K,); a difference of 1 in an attribute counts as this multiple of the mesh extent
    """
    faces, weights = np.ascontiguousarray(faces), np.ascontiguousarray(weights)
    positions, attributes = np.ascontiguousarray(positions), np.ascontiguousarray(attributes)
    remaining_faces = np.empty_like(faces)
    count = library().meshopt_simplifyWithAttributes(
        *(remaining_faces.ctypes.data, faces.ctypes.data, faces.size),
        *(positions.ctypes.data, len(positions), positions.strides[0]),
        *(attributes.ctypes.data, attributes.strides[0], weights.ctypes.data, len(weights)),
        *(None, 3 * triangles, np.finfo(np.float32).max, 0, None),  # no locked vertices, no options
    )
    return remaining_faces[: count // 3]


def in_cache_order(faces: NDArray[np.uint32], vertices: int) -> NDArray[np.uint32]:
    """Return faces (F, 3) in an order in which a GPU's vertex cache avoids transforming a vertex
    repeatedly (Sander et al. 2007). ``vertices`` is the number of vertices."""
    faces = np.ascontiguousarray(faces)
    ordered = np.empty_like(faces)
    optimize = library().meshopt_optimizeVertexCache
    optimize(ordered.ctypes.data, faces.ctypes.data, faces.size, vertices)
    return ordered
