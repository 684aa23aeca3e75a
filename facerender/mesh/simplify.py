"""Simplified meshes, whose edges collapse by quadric errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_type, warn
from facerender.mesh.geometry import Geometry
from facerender.mesh.mesh import TRIANGLES, Mesh, moved
from facerender.mesh.part import Float, Part
from facerender.mesh.repair import VERTEX_ARRAYS, double_areas
from facerender.system import meshoptimizer

# Weights of errors in normal, texture coordinates (scaled to lengths on the surface in mesh radii),
# linear colour and occlusion, and second texture coordinates. Errors in position, in extents of the
# mesh, have weight 1. Comparisons of images, as in docs/measurements/levels.md, determined these.
_WEIGHTS = [1.0] * 3 + [20.0] * 2 + [1.0] * 4 + [20.0] * 2


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
    triangles : triangle limit of the whole mesh, at least 1; a smaller mesh is returned unchanged

    Raises
    ------
    InputError : triangles is below 1, or the package meshoptimizer is not installed

    Warns
    -----
    FacerenderWarning : the mesh still has more triangles than the limit, because of seams or parts
    """
    check_type("mesh", mesh, Mesh, "a facerender.Mesh")
    TRIANGLES.check("triangles", triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    geometry, remaining = mesh.geometry.derived.of(
        f"level {triangles}", None, lambda: _simplify(mesh.geometry, triangles)
    )
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


def _simplify(mesh: Geometry, triangles: int) -> tuple[Geometry, list[NDArray[np.int64]]]:
    """Simplify all parts together, so that borders between parts stay closed and the errors of
    different parts are comparable. Also return the indices of each part's remaining vertices."""
    try:
        meshoptimizer.library()
    except ImportError:
        need = "levels of detail need the package meshoptimizer"
        raise InputError(f"{need}; pip install 'facerender[lod]'") from None
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    rows = np.concatenate([_vertices(mesh, number) for number in range(len(mesh.parts))])
    # In some files, triangles do not share vertices, so equal vertices are merged.
    rows, first_indices, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = numbers.reshape(-1)[np.concatenate(faces)]
    attributes = rows.astype(np.float32)
    weights = np.array(_WEIGHTS[: rows.shape[1] - 4], dtype=np.float32)
    collapsed = meshoptimizer.collapsed(
        corners.astype(np.uint32), attributes[:, 1:4], attributes[:, 4:], weights, triangles
    )
    parts, remaining = [], []
    for number, part in enumerate(mesh.parts):
        chosen = collapsed[rows[collapsed[:, 0], 0] == number]
        if not len(chosen):
            all_faces = corners[rows[corners[:, 0], 0] == number]
            chosen = all_faces[[np.argmax(double_areas(rows[all_faces, 1:4]))]]
        vertices, inverse = np.unique(chosen, return_inverse=True)
        kept = first_indices[vertices] - starts[number]
        columns = ((name, getattr(part, name)) for name in (*VERTEX_ARRAYS, "occlusion"))
        arrays = {name: values[kept] for name, values in columns if values is not None}
        corners_of_part = inverse.reshape(chosen.shape).astype(np.uint32)
        ordered = meshoptimizer.in_cache_order(corners_of_part, len(vertices))
        parts.append(Part(**arrays, faces=ordered, name=part.name, skin=part.skin))
        remaining.append(kept)
    return replace(mesh, parts=tuple(parts), known_framing=mesh.framing), remaining


def _vertices(mesh: Geometry, index: int) -> Float:
    """Return the attributes of a part's vertices, one row per vertex: part index, position, normal,
    scaled texture coordinates and colour, 12 columns; occlusion, if any part has occlusion or
    second texture coordinates; and scaled second texture coordinates, if any part has them."""
    part = mesh.parts[index]
    count = len(part.positions)
    columns = [
        np.full((count, 1), index),
        mesh.space.normalised(part.positions),
        part.normals,
        _on_surface(mesh, part, part.uv),
        np.ones((count, 3)) if part.colors is None else part.colors,
    ]
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
