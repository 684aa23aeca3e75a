"""Rigs: the data that move the vertices of a part (morph targets, skins, nodes, animation clips),
evaluated in float64. No files are read here.

Reference: Khronos (2021), glTF 2.0, sections 3.5 (nodes), 3.7.2.1 (morph targets), 3.7.3 (skins),
3.11 and appendix C (animations)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from facerender.values.vectors import Array, Float, rotation_of, transformed

AnimatedValues = Mapping[int, Mapping[str, Sequence[float]]]
Path = Literal["translation", "rotation", "scale", "weights"]
Interpolation = Literal["LINEAR", "STEP", "CUBICSPLINE"]

_BLOCK = 1 << 13  # vertices skinned at once, so that their matrices stay in the CPU's cache


@dataclass(frozen=True, eq=False, repr=False)
class Node:
    """A node of a scene in its stored pose: its index in the file, that of its parent, or None, and
    its transforms, see :func:`local_matrix`."""

    index: int
    parent: int | None
    transforms: Mapping[str, Sequence[float]]


@dataclass(frozen=True, eq=False, repr=False)
class Track:
    """Keys of one property, the path, of the node with an index."""

    node: int
    path: Path
    times: Float  # (K,), in seconds, in increasing order
    values: Array  # (K, W); (K, 3, W) with in-tangent, value and out-tangent for a cubic spline
    interpolation: Interpolation = "LINEAR"

    def at(self, time: float) -> list[float]:
        """Return the value at a time, which is constant before the first and after the last key."""
        next_key = int(np.searchsorted(self.times, time, "right"))
        first, last = max(next_key - 1, 0), min(next_key, len(self.times) - 1)
        cubic = self.interpolation == "CUBICSPLINE"
        values = self.values[:, 1] if cubic else self.values
        a, b = values[first].astype(np.float64), values[last].astype(np.float64)
        if first == last or self.interpolation == "STEP":
            mixed = a
        else:
            length = float(self.times[last] - self.times[first])
            u = (time - float(self.times[first])) / length
            if cubic:
                leaving, arriving = length * self.values[[first, last], [2, 0]].astype(np.float64)
                mixed = (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * leaving
                mixed += (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * arriving
            elif self.path == "rotation":
                return _slerp(a.tolist(), b.tolist(), u)
            else:
                mixed = (1.0 - u) * a + u * b
        value: list[float] = mixed.tolist()
        return _unit(value) if self.path == "rotation" else value


def _unit(quaternion: list[float]) -> list[float]:
    length = math.hypot(*quaternion)
    return [component / length for component in quaternion] if length > 0.0 else quaternion


def _slerp(a: list[float], b: list[float], u: float) -> list[float]:
    """Interpolate between two quaternions of any length along the shorter arc (Shoemake 1985)."""
    a, b = _unit(a), _unit(b)
    if sum(x * y for x, y in zip(a, b, strict=True)) < 0.0:
        b = [-component for component in b]
    # atan2 is accurate where the arc cosine of the product is not: for nearly equal quaternions.
    arc = 2.0 * math.atan2(math.dist(a, b), math.hypot(*(x + y for x, y in zip(a, b, strict=True))))
    first, second = 1.0 - u, u
    if math.sin(arc) >= 1e-12:
        first, second = (math.sin(share * arc) / math.sin(arc) for share in (first, second))
    return _unit([first * x + second * y for x, y in zip(a, b, strict=True)])


@dataclass(frozen=True, eq=False, repr=False)
class Clip:
    """An animation: tracks of different properties."""

    name: str  # name from the file, unique among the clips of the file
    tracks: tuple[Track, ...] = ()
    fault: str = ""  # description of the damage if the clip is damaged, which then has no tracks
    ignored: str = ""  # name of the extension that the clip needs and this package ignores

    @property
    def duration(self) -> float:
        """Time of the last key in seconds."""
        return max((float(track.times[-1]) for track in self.tracks), default=0.0)

    def at(self, time: float) -> dict[int, dict[str, Sequence[float]]]:
        """Return the values at a time, keyed by the node's index and the property."""
        values: dict[int, dict[str, Sequence[float]]] = {}
        for track in self.tracks:
            values.setdefault(track.node, {})[track.path] = track.at(time)
        return values


@dataclass(frozen=True, eq=False, repr=False)
class Skeleton:
    """The nodes of a file's scene, parents first, the clips of the file, the name and node of each
    joint of its skins, and the transform (4, 4) of the scene, or None."""

    nodes: tuple[Node, ...]
    clips: tuple[Clip, ...] = ()
    joints: tuple[tuple[str, int], ...] = ()
    root: Float | None = None

    def world_matrices(self, animated_values: AnimatedValues) -> dict[int, Float]:
        """Return the world matrix (4, 4) of each node, keyed by its index. Animated values replace
        stored transforms, as from :meth:`Clip.at`, or are "angles", see :meth:`Mesh.with_pose`."""
        matrices: dict[int, Float] = {}
        changes: dict[int | None, Float] = {}  # transforms in mesh space that follow from angles
        for node in self.nodes:
            node_values = animated_values.get(node.index, {})
            local = self._locals[node.index]
            if node_values:
                local = local_matrix({**node.transforms, **node_values})
            parent = self.root if node.parent is None else matrices[node.parent]
            world = matrices[node.index] = local if parent is None else parent @ local
            if node.parent in changes:
                changes[node.index] = changes[node.parent]
            if "angles" in node_values:
                change = np.eye(4)
                change[:3, :3] = rotation_of(node_values["angles"])
                change[:3, 3] = world[:3, 3] - change[:3, :3] @ world[:3, 3]
                changes[node.index] = changes.get(node.parent, np.eye(4)) @ change
        return {i: changes[i] @ world if i in changes else world for i, world in matrices.items()}

    @cached_property
    def _locals(self) -> dict[int, Float]:
        return {node.index: local_matrix(node.transforms) for node in self.nodes}

    def below(self, indices: Iterable[int]) -> set[int]:
        """Return the indices of the given nodes and of all nodes below them."""
        subtree = set(indices)
        for node in self.nodes:
            if node.parent in subtree:
                subtree.add(node.index)
        return subtree


@dataclass(frozen=True, eq=False, repr=False)
class Shape:
    """A morph target of a part. Vertices that do not move are left out."""

    name: str  # name from the file, or shape1, shape2...
    rows: Array | None = None  # indices (M,) of the vertices that move
    moves: Array | None = None  # their displacements (M, 3)
    normal_rows: Array | None = None  # as rows; None if the file has no normals for this target
    normal_moves: Array | None = None
    fault: str = ""  # description of the damage if the target is damaged, which moves nothing


@dataclass(frozen=True, eq=False, repr=False)
class Skin:
    """The joints that move a part."""

    joints: tuple[int, ...]  # indices of the nodes
    inverse: Float | None  # (J, 4, 4), inverse bind matrices; None: unit matrices
    indices: Array  # (K, N), K joints of each vertex as indices into ``joints``
    weights: Float  # (K, N), their weights, which add up to 1

    @classmethod
    def of(
        cls, joints: tuple[int, ...], inverse: Float | None, indices: Array, weights: Array
    ) -> Skin:
        """Return a skin of the indices and weights (N, K) of a file. Vertices without weights
        follow their first joint. Raises ValueError if a joint index is out of range."""
        if indices.size and indices.max() >= len(joints):
            raise ValueError(f"a vertex uses joint {indices.max()}, the skin has {len(joints)}")
        weights = np.maximum(np.nan_to_num(weights.astype(np.float64)), 0.0)
        weights[:, 0] += weights.sum(axis=1) == 0.0
        weights /= weights.sum(axis=1, keepdims=True)
        columns = indices.T.astype(np.uint16 if len(joints) < 1 << 16 else np.uint32, order="C")
        return cls(joints, inverse, columns, np.ascontiguousarray(weights.T))


@dataclass(frozen=True, eq=False, repr=False)
class Rig:
    """The data that move the vertices of a part."""

    skeleton: Skeleton  # nodes and clips, shared by the parts of a file
    node: int  # index of the node whose mesh the part belongs to
    positions: Array  # (N, 3), in the node's space, before morph targets
    # (N, 3), as the positions, vectors of any length; None until the file's reader computes missing
    # normals, see :meth:`with_normals`.
    normals: Array | None
    weights: tuple[float, ...] = ()  # stored weights of the shapes
    shapes: tuple[Shape, ...] = ()
    skin: Skin | None = None
    placed: bool = True  # whether the node places the part; false with a skin
    offset: Float | None = None  # (4, 4), transform of an instance within the node's space
    sign: float = 1.0  # -1 if the normals have to be reversed: the file's faces are inside out

    def lagging(self, weights: Sequence[float]) -> tuple[float, ...]:
        """Return weights in which the shapes without own normals have their stored weights."""
        rows = zip(self.shapes, self.weights, weights, strict=True)
        return tuple(stored if s.normal_rows is None else weight for s, stored, weight in rows)

    def posed(
        self, world_matrices: Mapping[int, Float], weights: Sequence[float]
    ) -> tuple[Float, Float | None]:
        """Return positions (N, 3) and normals (N, 3) in mesh space, for a weight of each shape. The
        normals have any length; they are None if the part has none or a matrix is singular."""
        points, normals = morphed(self.positions, self.normals, self.shapes, weights)
        if self.skin is not None:
            points, normals, _ = skinned(points, normals, self.skin, world_matrices)
        else:
            points, normals, _ = transformed(points, normals, self._matrix(world_matrices))
        return points, None if normals is None else self.sign * normals

    def _matrix(self, world_matrices: Mapping[int, Float]) -> Float:
        if not self.placed:
            return np.eye(4) if self.skeleton.root is None else self.skeleton.root
        world = world_matrices[self.node]
        return world if self.offset is None else world @ self.offset

    def with_normals(self, normals: Float) -> Rig:
        """Return a rig with normals that :meth:`posed` maps to the given ones, (N, 3), in the
        stored pose. The normals of the shapes are dropped."""
        world_matrices = self.skeleton.world_matrices({})
        if self.skin is None:
            node_normals = normals @ self._matrix(world_matrices)[:3, :3]
        else:
            node_normals = np.empty_like(normals)
            for rows, blend in _blended(self.skin, world_matrices):
                a, b, c, _, d, e, f, _, g, h, i, _ = blend
                x, y, z = normals[rows].T
                columns = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
                node_normals[rows] = np.stack(columns, axis=1)
        shapes = tuple(replace(s, normal_rows=None, normal_moves=None) for s in self.shapes)
        return replace(self, normals=node_normals, shapes=shapes)


def local_matrix(transforms: Mapping[str, Sequence[float] | Array]) -> Float:
    """Return the local matrix of a node, (4, 4), for column vectors.

    transforms : scale; rotation, a quaternion x, y, z, w of any length; translation; and matrix, 16
        numbers in column-major order. They apply in this order
    """
    local = np.eye(4)
    if "rotation" in transforms:
        quaternion = [*map(float, transforms["rotation"])]
        length = math.hypot(*quaternion)
        if 1e-12 < length < math.inf:
            x, y, z, w = (component / length for component in quaternion)
            local[:3, :3] = [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
    if "scale" in transforms:
        local[:3, :3] *= np.asarray(transforms["scale"], dtype=np.float64)
    if "translation" in transforms:
        local[:3, 3] = transforms["translation"]
    if "matrix" not in transforms:
        return local
    return np.asarray(np.array(transforms["matrix"], dtype=np.float64).reshape(4, 4).T @ local)


def morphed(
    positions: Array, normals: Array | None, shapes: Sequence[Shape], weights: Sequence[float]
) -> tuple[Float, Array | None]:
    """Return positions (N, 3) and normals (N, 3) with weighted morph targets added; the normals
    have any length. The arguments do not change. Raises ValueError if a target whose weight is not
    0 is damaged."""
    active = [(s, w) for s, w in zip(shapes, weights, strict=False) if w]
    points = np.array(positions, dtype=np.float64)
    if normals is not None and any(shape.normal_rows is not None for shape, _ in active):
        normals = np.array(normals, dtype=np.float64)
    for shape, weight in active:
        if shape.fault:
            raise ValueError(shape.fault)
        arrays = (points, shape.rows, shape.moves), (normals, shape.normal_rows, shape.normal_moves)
        for vectors, rows, moves in arrays:
            if vectors is not None and rows is not None and moves is not None:
                every = len(rows) == len(vectors)
                vectors[... if every else rows] += np.multiply(moves, weight, dtype=np.float64)
    return points, normals


def skinned(
    positions: Float, normals: Array | None, skin: Skin, world_matrices: Mapping[int, Float]
) -> tuple[Float, Float | None, bool]:
    """Return skinned positions and normals, and whether skinning mirrors most vertices. The
    normals have any length, and the direction of the inverse transpose."""
    moved = np.empty((len(positions), 3))
    turned = None if normals is None else np.empty((len(positions), 3))
    mirrored = 0
    for rows, (a, b, c, x, d, e, f, y, g, h, i, z) in _blended(skin, world_matrices):
        p, q, r = np.asarray(positions[rows], dtype=np.float64).T
        out = moved[rows]
        out[:, 0] = a * p + b * q + c * r + x
        out[:, 1] = d * p + e * q + f * r + y
        out[:, 2] = g * p + h * q + i * r + z
        k, l, m = e * i - f * h, f * g - d * i, d * h - e * g
        sign = np.sign(a * k + b * l + c * m)
        mirrored += int((sign < 0.0).sum())
        if turned is not None and normals is not None:
            p, q, r = np.asarray(normals[rows], dtype=np.float64).T * sign
            out = turned[rows]
            out[:, 0] = k * p + l * q + m * r
            out[:, 1] = (h * c - i * b) * p + (i * a - g * c) * q + (g * b - h * a) * r
            out[:, 2] = (b * f - c * e) * p + (c * d - a * f) * q + (a * e - b * d) * r
    return moved, turned, 2 * mirrored > len(positions)


def _blended(skin: Skin, world_matrices: Mapping[int, Float]) -> Iterable[tuple[slice, Float]]:
    """Yield slices of the vertices with the first three rows of their blended matrices, (12, n)."""
    matrices = np.stack([world_matrices[joint] for joint in skin.joints])
    matrices = matrices if skin.inverse is None else matrices @ skin.inverse
    matrices = np.ascontiguousarray(matrices[:, :3].reshape(-1, 12).T)
    for start in range(0, skin.indices.shape[1], _BLOCK):
        rows = slice(start, start + _BLOCK)
        blend = np.zeros((12, skin.indices[0, rows].size))
        for joints, weights in zip(skin.indices[:, rows], skin.weights[:, rows], strict=True):
            if weights.any():
                blend += matrices.take(joints, axis=1) * weights
        yield rows, blend
