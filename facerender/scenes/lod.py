"""Levels of detail: a mesh with fewer triangles, for images that cannot show them all."""

from __future__ import annotations

import math
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_type, warn
from facerender.scenes.framing import find_regions
from facerender.scenes.mesh import TRIANGLES, Mesh, Part
from facerender.system import meshoptimizer

Float = NDArray[np.float64]

# What errors count beside a distance of the mesh's extent: of normals; of places on a map, measured
# on the surface in radii; of linear colours, of occlusion, and of places by second coordinates.
# Chosen by images such as those of docs/measurements/levels.md.
_NORMAL, _PLACE, _COLOR = 1.0, 20.0, 1.0
_WEIGHTS = [_NORMAL] * 3 + [_PLACE] * 2 + [_COLOR] * 4 + [_PLACE] * 2

_simplified: WeakKeyDictionary[Mesh, dict[int, Mesh]] = WeakKeyDictionary()


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return the mesh with at most so many triangles, where that can be.

    Edges collapse in the order of their quadric error (Garland and Heckbert 1997), which counts
    normals, texture coordinates, colours and occlusion beside distances (Hoppe 1999). The vertices
    that are left stay as they are. Open borders, seams of texture coordinates and normals, and
    borders between parts collapse along themselves, both sides at once: no crack opens. Materials,
    the number of parts, bounds, radius, profile, head and face stay, so that a camera sees both
    meshes alike. Triangles are in the order of the vertex cache.

    The result is the same in every process, and the same object for the same arguments. Kapoulkine
    (2016-2026), meshoptimizer: meshopt_simplifyWithAttributes.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    triangles : of all parts together, at least 1; the mesh itself where it has no more

    Raises
    ------
    InputError : triangles below 1; the package meshoptimizer is not installed

    Warns
    -----
    FacerenderWarning : seams and parts need more triangles
    """
    check_type("mesh", mesh, Mesh, "a facerender.Mesh")
    TRIANGLES.check("triangles", triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    known = _simplified.setdefault(mesh, {})
    if triangles not in known:
        known[triangles] = _simplify(mesh, triangles)
    if (left := sum(len(part.faces) for part in known[triangles].parts)) > triangles:
        warn(f"{mesh.name} cannot be simplified to {triangles} triangles: it keeps {left}")
    return known[triangles]


def _simplify(mesh: Mesh, triangles: int) -> Mesh:
    """All parts at once, so that their common borders stay common and the worst goes last."""
    try:
        meshoptimizer.library()
    except ImportError:
        raise InputError(
            "levels of detail need the package meshoptimizer; pip install 'facerender[lod]'"
        ) from None
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    rows = np.concatenate([_vertices(mesh, index) for index in range(len(mesh.parts))])
    # Some files share no vertex.
    rows, first, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = numbers.reshape(-1)[np.concatenate(faces)]
    columns = rows.astype(np.float32)
    weights = np.array(_WEIGHTS[: rows.shape[1] - 4], dtype=np.float32)
    left = meshoptimizer.collapsed(
        corners.astype(np.uint32), columns[:, 1:4], columns[:, 4:], weights, triangles
    )
    parts = []
    for index, part in enumerate(mesh.parts):
        chosen = left[rows[left[:, 0], 0] == index]
        if not len(chosen):
            all_faces = corners[rows[corners[:, 0], 0] == index]
            chosen = all_faces[[np.argmax(_double_areas(rows[all_faces, 1:4]))]]
        vertices, own = np.unique(chosen, return_inverse=True)
        arrays = {
            name: values[first[vertices] - starts[index]]
            for name in ("positions", "normals", "uv", "colors", "occlusion", "uv2")
            if (values := getattr(part, name)) is not None
        }
        corners_of_part = own.reshape(chosen.shape).astype(np.uint32)
        ordered = meshoptimizer.in_cache_order(corners_of_part, len(vertices))
        parts.append(Part(**arrays, faces=ordered, name=part.name))
    return replace(mesh, parts=tuple(parts), regions=find_regions(mesh))


def _vertices(mesh: Mesh, index: int) -> Float:
    """Return number of the part, position, normal, scaled place on the maps, colour: (N, 12),
    occlusion where a part of the mesh has it or what follows: (N, 13), and where a part has it the
    scaled second place on the maps: (N, 15)."""
    part = mesh.parts[index]
    count = len(part.positions)
    columns = [
        np.full((count, 1), index),
        mesh.normalised(part.positions),
        part.normals,
        _on_surface(mesh, part, part.uv),
        np.ones((count, 3)) if part.colors is None else part.colors,
    ]
    second = any(each.uv2 is not None for each in mesh.parts)
    if second or any(each.occlusion is not None for each in mesh.parts):
        columns.append((np.ones(count) if part.occlusion is None else part.occlusion)[:, None])
    if second:
        columns.append(_on_surface(mesh, part, part.uv2))
    return np.concatenate(columns, axis=1)


def _on_surface(mesh: Mesh, part: Part, uv: Float | None) -> Float:
    """Return places on a part's maps, (N, 2), as lengths on its surface in radii of the mesh."""
    if uv is None:
        return np.zeros((len(part.positions), 2))
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    on_map = float(_double_areas(flat[part.faces]).sum())
    on_surface = float(_double_areas(part.positions[part.faces]).sum())
    scale = math.sqrt(on_surface / on_map) if on_map > 0.0 else 1.0
    return uv * (scale / mesh.radius)


def _double_areas(corners: Float) -> Float:
    """Return twice the areas of triangles, (F, 3, 3) to (F,)."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))
