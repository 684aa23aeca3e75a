"""Simplified meshes, whose edges collapse by quadric errors. The functions of meshoptimizer
(Kapoulkine, 2016-2026), from the extra ``lod``, are called through ctypes."""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace
from functools import cache, partial
from importlib.machinery import PathFinder
from importlib.util import find_spec
from typing import Any

import numpy as np

from facerender.errors import InputError, warn
from facerender.mesh.geometry import Geometry
from facerender.mesh.mesh import TRIANGLES, Mesh, moved
from facerender.mesh.part import Part
from facerender.mesh.repair import VERTEX_ARRAYS, double_areas
from facerender.values.vectors import Float, Integers

# Weights of errors in normal, texture coordinates (scaled to lengths on the surface in mesh radii),
# linear colour and occlusion, and second texture coordinates. Errors in position, in extents of the
# mesh, have weight 1. Comparisons of images, as in docs/measurements/levels.md, determined these.
_WEIGHTS = [1.0] * 3 + [20.0] * 2 + [1.0] * 4 + [20.0] * 2

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
_LEVELS = "levels of detail need the package meshoptimizer; pip install 'facerender[lod]'"


@cache
def library(missing: str = _LEVELS) -> ctypes.CDLL:
    """Return the compiled library of the Python package meshoptimizer, with declared types. Raise
    InputError with the text ``missing`` if the package is not installed.

    The package's wrappers are not imported: they declare no types for simplify_with_attributes and
    the filters, pass 64-bit sizes as 32-bit integers, and therefore crash."""
    package = find_spec("meshoptimizer")
    folders = package.submodule_search_locations if package else None
    spec = PathFinder.find_spec("_meshoptimizer", folders) if folders else None
    if spec is None or spec.origin is None:
        raise InputError(missing)
    functions = ctypes.CDLL(spec.origin)
    for name, (result, arguments) in _TYPES.items():
        function = getattr(functions, f"meshopt_{name}")
        function.restype, function.argtypes = result, arguments
    return functions


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return a simplified mesh with at most the given number of triangles, if possible.

    Edges collapse in increasing order of quadric error (Garland and Heckbert 1997), which includes
    normals, texture coordinates, colours and occlusion (Hoppe 1999). Remaining vertices do not
    move. Edges on mesh borders, seams and borders between parts collapse only along these lines, on
    both sides together, so that no cracks open. Materials, number of parts, bounds, radius,
    profile, head and face do not change, so that cameras frame the simplified mesh like the
    original. Triangles are ordered for the GPU's vertex cache. In all poses of a mesh, the
    reference pose determines which triangles remain.

    Reference: Kapoulkine (2016-2026), meshoptimizer: meshopt_simplifyWithAttributes.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    triangles : triangle limit of the whole mesh, at least 1; a smaller mesh is returned unchanged.
        Seams and parts may prevent the limit from being reached, with a FacerenderWarning
    """
    TRIANGLES.check("triangles", triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    make = partial(_simplify, mesh.geometry, triangles)
    geometry, remaining = mesh.geometry.derived.of(f"level {triangles}", None, make)
    if (count := sum(len(part.faces) for part in geometry.parts)) > triangles:
        warn(f"{mesh.name} cannot be simplified to {triangles} triangles: {count} remain")
    level = Mesh(geometry, mesh.materials)
    if mesh.pose is None:
        return level
    if triangles not in mesh.pose.levels:
        level = replace(level, pose=replace(mesh.pose, geometry=geometry, parts=geometry.parts))
        pairs = [*zip(mesh.parts, remaining, strict=True)]
        columns = ([getattr(p, n)[rows] for p, rows in pairs] for n in ("positions", "normals"))
        mesh.pose.levels[triangles] = moved(level, *columns).pose
    return replace(level, pose=mesh.pose.levels[triangles])


def _simplify(mesh: Geometry, triangles: int) -> tuple[Geometry, list[Integers]]:
    """Simplify all parts together, so that borders between parts stay closed and the errors of
    different parts are comparable. Also return the indices of each part's remaining vertices."""
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    parts_faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    rows = np.concatenate([_vertices(mesh, index) for index in range(len(mesh.parts))])
    # In some files, triangles do not share vertices, so equal vertices are merged.
    rows, first_indices, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = numbers.reshape(-1)[np.concatenate(parts_faces)]
    attributes = rows.astype(np.float32)
    weights = np.array(_WEIGHTS[: rows.shape[1] - 4], dtype=np.float32)
    faces, remaining_faces = corners.astype(np.uint32), np.empty(corners.shape, dtype=np.uint32)
    positions, others = (np.ascontiguousarray(a) for a in (attributes[:, 1:4], attributes[:, 4:]))
    count = library().meshopt_simplifyWithAttributes(
        *(remaining_faces.ctypes.data, faces.ctypes.data, faces.size),
        *(positions.ctypes.data, len(positions), positions.strides[0]),
        *(others.ctypes.data, others.strides[0], weights.ctypes.data, len(weights)),
        *(None, 3 * triangles, np.finfo(np.float32).max, 0, None),  # no locked vertices, no options
    )
    collapsed = remaining_faces[: count // 3]
    parts, remaining = [], []
    for index, part in enumerate(mesh.parts):
        part_faces = collapsed[rows[collapsed[:, 0], 0] == index]
        if not len(part_faces):
            all_faces = corners[rows[corners[:, 0], 0] == index]
            part_faces = all_faces[[np.argmax(double_areas(rows[all_faces, 1:4]))]]
        vertices, inverse = np.unique(part_faces, return_inverse=True)
        kept = first_indices[vertices] - starts[index]
        columns = ((name, getattr(part, name)) for name in (*VERTEX_ARRAYS, "occlusion"))
        arrays = {name: values[kept] for name, values in columns if values is not None}
        corners_of_part = inverse.reshape(part_faces.shape).astype(np.uint32)
        ordered = np.empty_like(corners_of_part)  # for the vertex cache (Sander et al. 2007)
        pointers = ordered.ctypes.data, corners_of_part.ctypes.data
        library().meshopt_optimizeVertexCache(*pointers, ordered.size, len(vertices))
        parts.append(Part(**arrays, faces=ordered, name=part.name, skin=part.skin))
        remaining.append(kept)
    return replace(mesh, parts=tuple(parts), known_framing=mesh.framing), remaining


def _vertices(mesh: Geometry, index: int) -> Float:
    """Return the attributes of a part's vertices, one row per vertex: part index, position, normal,
    scaled texture coordinates and colour, 12 columns; occlusion, if any part has occlusion or
    second texture coordinates; and scaled second texture coordinates, if any part has them."""
    part = mesh.parts[index]
    count = len(part.positions)
    colors = np.ones((count, 3)) if part.colors is None else part.colors
    columns = [np.full((count, 1), index), mesh.space.normalised(part.positions), part.normals]
    columns += [_on_surface(mesh, part, part.uv), colors]
    second = any(mesh_part.uv2 is not None for mesh_part in mesh.parts)
    if second or any(mesh_part.occlusion is not None for mesh_part in mesh.parts):
        columns.append((np.ones(count) if part.occlusion is None else part.occlusion)[:, None])
    if second:
        columns.append(_on_surface(mesh, part, part.uv2))
    return np.concatenate(columns, axis=1)


def _on_surface(mesh: Geometry, part: Part, uv: Float | None) -> Float:
    """Return texture coordinates (N, 2), scaled to lengths on the surface in mesh radii."""
    if uv is None:
        return np.zeros((len(part.positions), 2))
    on_map = float(double_areas(np.pad(uv, ((0, 0), (0, 1)))[part.faces]).sum())
    on_surface = float(double_areas(part.positions[part.faces]).sum())
    return uv * ((math.sqrt(on_surface / on_map) if on_map > 0.0 else 1.0) / mesh.radius)
