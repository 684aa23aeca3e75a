"""Poses of a mesh: moved vertices of the same triangles, their normals, and the camera framing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, warn
from facerender.scenes.framing import find_regions
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.repair import stacked, used
from facerender.scenes.vectors import MOST_RADII, rows_of

Float = NDArray[np.float64]

# The radius of the renderer's space grows by this factor if vertices leave it. Small steps would
# change the space, and thus upload all parts again, in every frame.
_GROWTH = 2.0**0.25
_SAME_NORMAL = 0.999  # minimum: cosine between two normals of one vertex that is split by a seam


def rows_of_parts(mesh: Mesh, name: str, values: Any) -> list[Float | None]:
    """Return the rows (N, 3) of each part; None for a part without rows. For the accepted values
    and the errors see :meth:`Mesh.with_positions`."""
    parts = mesh.parts
    if isinstance(values, Mapping):
        chosen: dict[int, Any] = {}
        for key, own in values.items():
            chosen |= dict.fromkeys(mesh.called(str(key)), own)
        values = [chosen.get(number) for number in range(len(parts))]
    if values is None:
        values = [None] * len(parts)
    each_part = isinstance(values, list | tuple) and all(
        own is None or np.ndim(own) == 2 for own in values
    )
    if each_part:
        if len(values) != len(parts):
            raise InputError(
                f"{name} has {len(values)} arrays: give {len(parts)}, one for each part of "
                f"{mesh.name}"
            )
        return [
            None if own is None else _of_part(f"{name} of {part.name or mesh.name}", own, part)
            for own, part in zip(values, parts, strict=True)
        ]
    rows: Float = rows_of(name, values, (3,))
    counts = [len(part.positions) for part in parts]
    sources = {part.source_count for part in parts if part.sources is not None}
    if len(rows) in sources and len(sources) == 1:
        return [
            rows[:count] if part.sources is None else rows[part.sources]
            for part, count in zip(parts, counts, strict=True)
        ]
    if len(rows) != sum(counts):
        wanted = " or ".join(map(str, dict.fromkeys((*sources, sum(counts)))))
        raise InputError(
            f"{name} has {len(rows)} rows: give {wanted}, one for each vertex of {mesh.name}"
        )
    return list(np.split(rows, np.cumsum(counts)[:-1]))


def _of_part(name: str, values: Any, part: Part) -> Float:
    rows: Float = rows_of(name, values, (3,))
    if part.sources is not None and len(rows) == part.source_count:
        return np.asarray(rows[part.sources])
    if len(rows) != len(part.positions):
        raise InputError(
            f"{name} has {len(rows)} rows: give {len(part.positions)}, one for each vertex"
        )
    return rows


def moved(mesh: Mesh, places: Sequence[Float | None], normals: Sequence[Float | None]) -> Mesh:
    """Return a mesh with moved vertices; see :meth:`Mesh.with_positions`.

    Parameters
    ----------
    places : finite positions (N, 3) of each part; None for a part that stays as it is
    normals : finite normals (N, 3) of each part; None to compute them. A vector of length 0 is
        replaced by the normal of the reference pose
    """
    rest = reference_of(mesh)
    if any(part.occlusion is not None for part in rest.parts):
        warn(
            f"the baked occlusion of {rest.name} remains that of the reference pose: bake it for "
            "each pose with facerender.with_occlusion, or leave it out"
        )
    if any(own is not None and n is None for own, n in zip(places, normals, strict=True)):
        pairs = zip(mesh.parts, places, strict=True)
        sums = face_normal_sums(rest, [p.positions if own is None else own for p, own in pairs])
    parts = []
    for number, (part, own, normal) in enumerate(zip(mesh.parts, places, normals, strict=True)):
        if own is not None or normal is not None:
            root = part.root
            at = part.positions if own is None else own
            at = at if (drawn := _drawn_of(root)) is None else np.where(drawn, at, mesh.center)
            turned = _unit(sums[number] if normal is None else normal, root.normals)
            part = replace(root, positions=at, normals=turned, rest=root)
        parts.append(part)
    return _in_space(replace(mesh, parts=tuple(parts), regions=None, rest=rest))


def reference_of(mesh: Mesh) -> Mesh:
    """Return the mesh in the reference pose: the mesh itself unless it is a pose of another mesh
    with the same arrays."""
    rest = mesh.rest
    if rest is None or any(a.root is not b for a, b in zip(mesh.parts, rest.parts, strict=True)):
        return mesh
    return rest


def tracked(mesh: Mesh) -> Mesh:
    """Return a mesh whose camera framing follows the head; see :meth:`Mesh.tracked`."""
    rest = mesh.rest
    if rest is None:
        return mesh
    head = find_regions(rest)["head"]
    steps = []
    for part, own in zip(mesh.parts, rest.parts, strict=True):
        places = rest.normalised(own.positions)
        if head is not None:
            away = np.abs(places - head.center)
            inside = (np.hypot(away[:, 0], away[:, 2]) <= head.radius) & (away[:, 1] <= head.height)
            steps.append((part.positions - own.positions)[inside & used(places, own.faces)])
    step = np.median(np.concatenate(steps), axis=0)
    return _in_space(replace(mesh, bounds=rest.bounds + step))


def _in_space(mesh: Mesh) -> Mesh:
    """Return a posed mesh whose radius is at least the distance of all vertices from its centre.
    The profile, which is relative to the radius, shrinks accordingly."""
    rest = mesh.rest
    assert rest is not None
    away = (part.positions - mesh.center for part in mesh.parts)
    reach = math.sqrt(max(np.einsum("ij,ij->i", each, each).max() for each in away)) / rest.radius
    if reach > MOST_RADII:
        raise InputError(
            f"a vertex of {mesh.name} is {reach:.3g} mesh radii from the mesh's centre: give "
            f"positions within {MOST_RADII:g}"
        )
    steps = max(math.ceil(math.log(reach * (1.0 - 1e-9), _GROWTH)), 0) if reach > 0.0 else 0
    growth = _GROWTH**steps
    return replace(mesh, radius=rest.radius * growth, profile=rest.profile / growth)


def _unit(normals: Float, others: Float) -> Float:
    """Return vectors (N, 3) scaled to length 1; vectors of length 0 are replaced by others."""
    squares = np.einsum("ij,ij->i", normals, normals)
    if not (squares > 0.0).all():
        normals = np.where((squares > 0.0)[:, None], normals, others)
        squares = np.einsum("ij,ij->i", normals, normals)
    return np.asarray(normals / np.sqrt(squares)[:, None])


_drawn: WeakKeyDictionary[Part, NDArray[np.bool_] | None] = WeakKeyDictionary()


def _drawn_of(root: Part) -> NDArray[np.bool_] | None:
    """Return a mask (N, 1) of the vertices that faces use; None if faces use all vertices."""
    if root not in _drawn:
        mask = used(root.positions, root.faces)[:, None]
        _drawn[root] = None if mask.all() else mask
    return _drawn[root]


@dataclass(frozen=True, eq=False)
class _Corners:
    """The corners of a mesh's faces, sorted by vertex.

    Attributes
    ----------
    faces : (3, F) vertex indices; the vertices of all parts are numbered consecutively
    order : (3 F,) index of each corner's face
    starts : (G,) first corner of each group of vertices that share a normal
    groups : (N,) group of each vertex
    """

    faces: NDArray[np.int64]
    order: NDArray[np.int64]
    starts: NDArray[np.int64]
    groups: NDArray[np.int64]

    @classmethod
    def of(cls, rest: Mesh) -> _Corners:
        positions = [part.positions for part in rest.parts]
        _, faces, welded, _ = stacked(positions, [part.faces for part in rest.parts])
        groups = _split_at_creases(welded, np.concatenate([part.normals for part in rest.parts]))
        corners = groups[faces].ravel()
        order = np.argsort(corners, kind="stable")
        known, starts = np.unique(corners[order], return_index=True)
        return cls(
            np.ascontiguousarray(faces.T),
            order // 3,
            starts,
            np.searchsorted(known, groups).clip(max=len(known) - 1),
        )


def _split_at_creases(welded: NDArray[np.int64], normals: Float) -> NDArray[np.int64]:
    """Return labels in which vertices at one position share a label if their normals are equal."""
    labels = np.empty_like(welded)
    left, count = np.arange(len(welded)), 0
    while len(left):
        _, first, group = np.unique(welded[left], return_index=True, return_inverse=True)
        like = np.einsum("ij,ij->i", normals[left], normals[left[first[group]]]) > _SAME_NORMAL
        like[first] = True
        labels[left[like]] = count + group[like]
        left, count = left[~like], count + len(first)
    return labels


_corners: WeakKeyDictionary[Mesh, _Corners] = WeakKeyDictionary()


def face_normal_sums(rest: Mesh, positions: Sequence[Float]) -> list[Float]:
    """Return, for each vertex, the sum of the normals of its faces, weighted by their areas.
    Vertices that share position and normal in the reference pose share the sum.

    Parameters
    ----------
    rest : the mesh in the reference pose
    positions : (N, 3) for each part of the mesh
    """
    if rest not in _corners:
        _corners[rest] = _Corners.of(rest)
    own = _corners[rest]
    x, y, z = (np.concatenate([each[:, axis] for each in positions]) for axis in range(3))
    ax, ay, az = (column[own.faces[0]] for column in (x, y, z))
    ux, uy, uz = (c[own.faces[1]] - a for c, a in ((x, ax), (y, ay), (z, az)))
    vx, vy, vz = (c[own.faces[2]] - a for c, a in ((x, ax), (y, ay), (z, az)))
    normals = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    sums = (np.add.reduceat(each[own.order], own.starts)[own.groups] for each in normals)
    ends = np.cumsum([len(each) for each in positions])[:-1]
    return np.split(np.stack([*sums], axis=1), ends)
