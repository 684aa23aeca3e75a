"""The geometry of a mesh, which never changes, and its poses.

Materials change by option and the pose changes by frame; the geometry stays. Each of these values
owns what derives from it: a cache is an attribute of that value, and dies with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from facerender.errors import InputError, check_range, clipped, quoted, warn
from facerender.mesh.part import Float, Framing, Part, Space, TriangleSetup, face_normals, used
from facerender.mesh.repair import joined, stacked
from facerender.values.fields import parameters
from facerender.values.vectors import MAX_RADII, MILLIMETRES, ROTATIONS, SHAPE_WEIGHTS, Vector, unit

if TYPE_CHECKING:
    from facerender.mesh.rig import Clip

_Rows = list[Float | None]


class Latest(dict[Any, Any]):
    """Results by name, each with the value that it was made for."""

    def of(self, name: str, value: Any, make: Callable[[], Any]) -> Any:
        """Return the result of a name; make it if the last one was made for another value."""
        if name not in self or self[name][0] != value:
            self[name] = value, make()
        return self[name][1]


class Corners:
    """The corners of a mesh's faces in the reference pose, sorted by vertex.

    faces : (3, F) vertex indices; the vertices of all parts are numbered consecutively
    order : (3 F,) index of each corner's face
    starts : (G,) first corner of each group of vertices that share a normal
    groups : (N,) group of each vertex
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        _, joint, welded, _ = stacked(parts)
        normals = np.concatenate([part.normals for part in parts])
        # Vertices at one position share a group if their normals are nearly equal.
        groups, remaining, count = np.empty_like(welded), np.arange(len(welded)), 0
        while len(remaining):
            _, first, group = np.unique(welded[remaining], return_index=True, return_inverse=True)
            rows = normals[remaining]
            like = np.einsum("ij,ij->i", rows, rows[first[group]]) > 0.999
            like[first] = True
            groups[remaining[like]] = count + group[like]
            remaining, count = remaining[~like], count + len(first)
        corners = groups[joint].ravel()
        order = np.argsort(corners, kind="stable")
        used_groups, self.starts = np.unique(corners[order], return_index=True)
        self.faces, self.order = np.ascontiguousarray(joint.T), order // 3
        self.groups = np.searchsorted(used_groups, groups).clip(max=len(used_groups) - 1)

    def normal_sums(self, positions: Sequence[Float]) -> list[Float]:
        """Return, for each vertex of each part with positions (N, 3), the sum of the normals of its
        faces, weighted by their areas. The vertices of a group share the sum."""
        _, normals = face_normals(np.ascontiguousarray(np.concatenate(positions).T), self.faces)
        sums = [np.add.reduceat(column[self.order], self.starts)[self.groups] for column in normals]
        return np.split(np.stack(sums, axis=1), np.cumsum([*map(len, positions)])[:-1])


@dataclass(frozen=True, eq=False)
class Geometry:
    """The parts of a mesh in the reference pose, which its other materials and poses share."""

    name: str
    parts: tuple[Part, ...]
    bounds: Float  # (2, 3), lowest and highest coordinates of the vertices that faces use
    radius: float  # largest distance of a face's vertex from the centre of the bounds
    # (K, 2), outline of the solid that the mesh sweeps when it rotates about the vertical axis
    # through the centre of the bounds: distance from the axis and height, in the renderer's space.
    profile: Float
    millimetres: float | None = None  # per unit of mesh space, for scattering; None if unknown
    known_framing: Framing | None = None  # as from the cache; None to compute :attr:`framing`
    # (3, 3), for column vectors, from the axes of the file to mesh space; None if they are equal.
    rotation: Float | None = None
    shift: Vector = (0.0, 0.0, 0.0)  # after the rotation, from :func:`facerender.register`
    # For each part, the highlight of the material in the file; None if the mesh was not loaded.
    # Hints name only these highlights, see :func:`facerender.mesh.hints.gloss_of`.
    gloss: tuple[Any, ...] | None = None

    __getstate__ = parameters

    def __post_init__(self) -> None:
        if self.millimetres is not None:
            MILLIMETRES.check("millimetres", self.millimetres)

    @classmethod
    def of(cls, name: str, parts: Sequence[Part], millimetres: float | None = None) -> Geometry:
        """Return the geometry of parts, whose face indices must be valid."""
        vertices = np.concatenate([p.positions[used(p.positions, p.faces)] for p in parts])
        bounds = np.array([vertices.min(axis=0), vertices.max(axis=0)])
        offsets = vertices - bounds.mean(axis=0)
        radius = float(np.linalg.norm(offsets, axis=1).max())
        # The outermost vertex in each of at most 511 horizontal slices is in the profile.
        x, heights, z = (offsets / radius).T
        widths, slices = np.hypot(x, z), np.round(heights * 255.0).astype(np.int64)
        order = np.lexsort((widths, slices))
        widest = order[np.diff(slices[order], append=slices.max() + 1) > 0]
        profile = np.stack([widths[widest], heights[widest]], axis=1)
        within = tuple(part.within(bounds) for part in parts)
        return cls(name, within, bounds, radius, profile, millimetres)

    @cached_property
    def space(self) -> Space:
        """The renderer's space."""
        return Space(tuple(self.bounds.mean(axis=0).tolist()), self.radius)

    @cached_property
    def token(self) -> object:
        """A value that no other geometry and no pose has, for keys that must not hold arrays."""
        return object()

    @cached_property
    def framing(self) -> Framing:
        """The face, and the regions that cameras frame. The search takes about half a second."""
        if self.known_framing:
            return self.known_framing
        from facerender.mesh.framing import framing_of

        return framing_of(self.parts, self.space, self.profile)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the morph targets."""
        return tuple(dict.fromkeys(s.name for p in self.parts if p.rig for s in p.rig.shapes))

    @cached_property
    def corners(self) -> Corners:
        """Corners of the faces, from which a pose computes its normals."""
        return Corners(self.parts)

    @cached_property
    def mean_normals(self) -> list[Float]:
        """Mean face normals around each vertex as unit vectors, (N, 3) for each part."""
        return [*map(unit, self.corners.normal_sums([part.positions for part in self.parts]))]

    @cached_property
    def setups(self) -> list[TriangleSetup]:
        """The triangles of each part as the GPU gets them."""
        return [TriangleSetup.of(part, self.space) for part in self.parts]

    @cached_property
    def derived(self) -> Latest:
        """Results that hints and drawing derive from the geometry with recent materials, and
        simplified geometries. They are freed with it, so that no renderer keeps a mesh alive."""
        return Latest()


@dataclass(frozen=True, eq=False)
class MeshPose:
    """Moved vertices of a geometry."""

    geometry: Geometry
    parts: tuple[Part, ...]  # the geometry's parts, some with other positions and normals
    bounds: Float  # bounds of the geometry, moved with the head if the framing follows it

    __getstate__ = parameters

    def __post_init__(self) -> None:
        _ = self.space  # refuses vertices that are too far away

    @cached_property
    def space(self) -> Space:
        """The renderer's space. Raises InputError if a vertex is too far from its centre."""
        center, radius = self.bounds.mean(axis=0), self.geometry.radius
        offsets = (part.positions - center for part in self.parts)
        squares = [np.einsum("ij,ij->i", vectors, vectors).max() for vectors in offsets]
        reach = math.sqrt(np.max(squares)) / radius
        if not reach <= MAX_RADII:
            distance = f"{reach:.3g} mesh radii from its centre"
            remedy = f"give positions, weights, a clip or a time within {MAX_RADII:g} radii"
            name = self.geometry.name
            raise InputError(f"the pose moves vertices of {name} to {distance}: {remedy}")
        return Space(tuple(center.tolist()), radius, reach if reach > 1.0 + 1e-9 else 1.0)

    @cached_property
    def token(self) -> object:
        """A value that no other pose has; see :attr:`Geometry.token`."""
        return object()

    @cached_property
    def levels(self) -> dict[int, MeshPose | None]:
        """The pose of simplified geometries, by triangle limit."""
        return {}

    @cached_property
    def setups(self) -> list[TriangleSetup]:
        """The triangles of each part as the GPU gets them; unmoved ones share the geometry's."""
        geometry = self.geometry
        stays = self.bounds is geometry.bounds
        return [
            geometry.setups[i] if stays and part is stored else TriangleSetup.of(part, self.space)
            for i, (part, stored) in enumerate(zip(self.parts, geometry.parts, strict=True))
        ]


def are_closed(parts: Sequence[Part]) -> list[bool]:
    """Return, for each part, whether no back face of it is visible from outside: it belongs to a
    surface, perhaps of several parts, that is closed, wound consistently, and wound outwards."""
    positions, faces, welded, _ = stacked(parts)
    owners = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    corners, points = welded[faces], positions[faces]
    a, b = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    keys = np.minimum(a, b) * (int(corners.max()) + 1) + np.maximum(a, b)
    _, edges = np.unique(keys, return_inverse=True)
    # Faces traverse an edge equally often in both directions, except at holes.
    at_hole = (np.bincount(edges, np.sign(b - a)) != 0.0)[edges].reshape(-1, 3).any(axis=1)
    users = np.unique(corners.ravel() * len(parts) + np.repeat(owners, 3))
    vertices, numbers = np.divmod(users, len(parts))
    pairs = np.stack([numbers[:-1], numbers[1:]], axis=1)[vertices[:-1] == vertices[1:]]
    label = joined(pairs, len(parts))
    volumes = np.linalg.det(points - points.mean(axis=(0, 1)))
    inwards = np.bincount(label[owners], volumes, len(parts)) < 0.0
    has_hole = np.bincount(label[owners], at_hole, len(parts)) > 0.0
    return list((~inwards & ~has_hole)[label])


def clips_of(parts: Sequence[Part]) -> tuple[Clip, ...]:
    """Return the clips of a mesh's file, also the damaged ones."""
    return next((part.rig.skeleton.clips for part in parts if part.rig), ())


def unit_or(normals: Float, others: Float) -> Float:
    """Return vectors (N, 3) scaled to length 1; vectors of length 0 are replaced by others."""
    squares = np.einsum("ij,ij->i", normals, normals)
    if not ((squares > 1e-200) & (squares < 1e200)).all():
        largest = np.abs(normals).max(axis=1, keepdims=True)
        normals = np.where(largest > 0.0, normals / np.where(largest > 0.0, largest, 1.0), others)
        squares = np.einsum("ij,ij->i", normals, normals)
    return np.asarray(normals / np.sqrt(squares)[:, None])


@np.errstate(all="ignore")  # MeshPose refuses positions that cause overflow
def posed(
    rest: Geometry,
    weights: Mapping[str, float] | None,
    joints: Mapping[str, Sequence[float]] | None,
    clip: str | None,
    time: float | None,
) -> tuple[_Rows, _Rows]:
    """Return positions and normals of each part of a mesh in a pose; None for a part in its stored
    pose. The normals have any length. For the pose see :meth:`Mesh.with_pose`."""
    skeleton = next((part.rig.skeleton for part in rest.parts if part.rig), None)
    if skeleton is None:
        remedy = "give a glTF file with a rig, or leave out the pose"
        raise InputError(f"{rest.name} has no shapes, clips or joints: {remedy}")
    nodes = dict(skeleton.joints)
    overrides = _checked(rest, "shape", weights, rest.shapes)
    rotations = _checked(rest, "joint", joints, [*nodes])
    animated_values = _clip_values(rest, skeleton.clips, clip, time)
    for name, angles in rotations.items():
        if any(angles):
            animated_values.setdefault(nodes[name], {})["angles"] = angles
    world_matrices = skeleton.world_matrices(animated_values)
    nodes_move = any(values.keys() - {"weights"} for values in animated_values.values())
    positions: _Rows = [None] * len(rest.parts)
    normals, lagging_positions = [*positions], dict[int, Float]()
    for index, part in enumerate(rest.parts):
        if (rig := part.rig) is None:
            continue
        clip_weights = animated_values.get(rig.node, {}).get("weights", rig.weights)
        pairs = zip(rig.shapes, [*clip_weights, *[0.0] * len(rig.shapes)], strict=False)
        mixed = tuple(float(overrides.get(shape.name, weight)) for shape, weight in pairs)
        if nodes_move or mixed != rig.weights:
            try:
                positions[index], new_normals = rig.posed(world_matrices, mixed)
            except ValueError as error:
                cause = f"a shape of {rest.name} is damaged ({error})"
                raise InputError(f"{cause}; export it again") from None
            normals[index] = part.normals if new_normals is None else new_normals
            if new_normals is not None and not np.isfinite(new_normals).all():
                new_normals[~np.isfinite(new_normals).all(axis=1)] = 0.0
        if (lagging := rig.lagging(mixed)) != mixed:
            lagging_positions[index] = part.positions
            if nodes_move or lagging != rig.weights:
                rows, _ = replace(rig, normals=None).posed(world_matrices, lagging)
                lagging_positions[index] = rows
    if not lagging_positions:
        return positions, normals
    return positions, _following(rest, positions, lagging_positions, normals)


def _checked(
    geometry: Geometry, noun: str, values: Mapping[str, Any] | None, known: Sequence[str]
) -> dict[str, Any]:
    """Return checked weights, keyed by shape, or angles, keyed by joint."""
    label, limits = ("weight of", SHAPE_WEIGHTS) if noun == "shape" else ("joint", ROTATIONS)
    for name in values or {}:
        if name not in known:
            names = _known(f"{noun}s", known)
            raise InputError(f"{geometry.name} has no {noun} {quoted(name)}: {names}")
    return {n: limits.check(f"{label} {quoted(n)}", value) for n, value in (values or {}).items()}


def _known(nouns: str, names: Sequence[str]) -> str:
    return f"its {nouns} are {clipped(', '.join(names), 300)}" if names else f"it has no {nouns}"


def _clip_values(
    geometry: Geometry, clips: Sequence[Clip], name: str | None, time: float | None
) -> dict[int, dict[str, Sequence[float]]]:
    """Return the values of a clip, or of the first one for None, at a time; see :meth:`Clip.at`."""
    if name is None and time is None:
        return {}
    clip = next((clip for clip in clips if name in (None, clip.name)), None)
    if clip is None:
        cause = f"time = {quoted(time)} needs a clip" if name is None else f"clip = {quoted(name)}"
        known = _known("clips", [clip.name for clip in clips])
        raise InputError(f"{cause}, which {geometry.name} lacks: {known}")
    label = f"clip {quoted(clip.name)}"
    if clip.fault:
        raise InputError(f"{label} of {geometry.name} is damaged ({clip.fault}); export it again")
    if time is not None:
        check_range(f"time of {label}", time, 0.0, clip.duration)
    if clip.ignored:
        warn(f"{label} of {geometry.name} has channels of {clip.ignored}: ignored")
    return clip.at(0.0 if time is None else float(time))


def _following(
    geometry: Geometry, positions: _Rows, lagging_positions: Mapping[int, Float], normals: _Rows
) -> _Rows:
    """Return normals that follow shapes without own normals. A normal changes by the difference of
    the face normals around its position with and without these shapes. In ``lagging_positions``,
    keyed by the part's index, these shapes have their stored weights."""
    pairs = zip(geometry.parts, positions, strict=True)
    moved = [part.positions if rows is None else rows for part, rows in pairs]
    lagging = [lagging_positions.get(index, rows) for index, rows in enumerate(moved)]
    stays = all(rows is part.positions for rows, part in zip(lagging, geometry.parts, strict=True))
    means = geometry.mean_normals if stays else map(unit, geometry.corners.normal_sums(lagging))
    new_means = map(unit, geometry.corners.normal_sums(moved))
    new_normals: _Rows = []
    for part, normal, before, after in zip(geometry.parts, normals, means, new_means, strict=True):
        step = after - before
        base = part.normals if normal is None else normal
        new_normals.append(None if normal is None and not step.any() else unit(base) + step)
    return new_normals
