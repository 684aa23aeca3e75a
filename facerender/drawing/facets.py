"""Triangles as deferred shading reads them: each one's plane, and its attributes as affine
functions of the position; and whether their backs can be seen. No OpenGL here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.program import part_columns
from facerender.scenes.mesh import Mesh, Part

IN_ROW = 256  # of the texture
_AT_ONCE = 1 << 16
_MOST_OPEN_EDGES = 4096

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Facets:
    """The triangles of a part.

    Attributes
    ----------
    positions : (N, 3) float32, of the vertices in the renderer's space
    faces : (F, 3) uint32
    columns : the attributes of the vertices, from the normal on, (N, K) float32
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.uint32]
    columns: NDArray[np.float32]

    @classmethod
    def of(cls, part: Part, mesh: Mesh) -> Facets:
        """Take what is drawn of a part."""
        columns = part_columns(part, mesh)
        positions = columns.pop("in_position").astype(np.float32)
        attributes = np.hstack([*columns.values()], dtype=np.float32, casting="same_kind")
        return cls(positions, np.asarray(part.faces, dtype=np.uint32), attributes)

    @cached_property
    def bounds(self) -> tuple[Floats, Floats]:
        """The lowest and the highest corner of what the triangles use."""
        used = self.positions[self.faces.ravel()]
        return used.min(axis=0), used.max(axis=0)

    @property
    def texels(self) -> int:
        """How many texels a triangle takes."""
        return 1 + int(self.columns.shape[1])

    def texture(self) -> NDArray[np.float32]:
        """Return (rows, IN_ROW * texels, 4) float32: of each triangle the unit normal of its plane
        with the plane's distance from the origin, and for each attribute gradient and offset."""
        rows = -(-len(self.faces) // IN_ROW)
        packed = np.zeros((rows * IN_ROW, self.texels, 4), dtype=np.float32)
        for start in range(0, len(self.faces), _AT_ONCE):
            faces = self.faces[start : start + _AT_ONCE]
            corner = self.positions[faces[:, 0]]
            u, v = (self.positions[faces[:, i]] - corner for i in (1, 2))
            normal = np.cross(u, v)
            area = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-30)[:, None]
            value = self.columns[faces[:, 0]]
            change_u, change_v = (self.columns[faces[:, i]] - value for i in (1, 2))
            out = packed[start : start + len(faces)]
            out[:, 0, :3] = normal / np.sqrt(area)
            across_u, across_v = np.cross(v, normal) / area, np.cross(normal, u) / area
            out[:, 1:, :3] = change_u[..., None] * across_u[:, None]
            out[:, 1:, :3] += change_v[..., None] * across_v[:, None]
            out[:, 0, 3] = np.einsum("ij,ij->i", out[:, 0, :3], corner)
            out[:, 1:, 3] = value - np.einsum("ijk,ik->ij", out[:, 1:, :3], corner)
        return packed.reshape(rows, IN_ROW * self.texels, 4)

    def hides_back(self, eye: NDArray[np.float64]) -> bool:
        """Tell whether no back of a triangle can be seen from an eye outside the unit sphere: the
        part is closed, or all its holes lie on the far side."""
        if self._caps is None:
            return False
        corner, normal = self._caps
        return bool((np.einsum("ij,ij->i", eye - corner, normal) <= 0.0).all())

    @cached_property
    def _caps(self) -> tuple[Floats, Floats] | None:
        """A corner and the normal of triangles that close the part; None if they cannot: its
        triangles are not all turned outwards, or edges have more than two of them."""
        place = np.unique(_first_at_place(self.positions), return_inverse=True)[1]
        faces = place[self.faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        key = low * (place.max() + 1) + high
        order = np.argsort(key)
        key, forward = key[order], (start < end)[order]
        again = key[1:] == key[:-1]
        if (again[1:] & again[:-1]).any() or (again & (forward[1:] == forward[:-1])).any():
            return None
        alone = np.ones(len(key), dtype=bool)
        alone[1:] &= ~again
        alone[:-1] &= ~again
        rims = order[alone]
        if len(rims) > _MOST_OPEN_EDGES:
            return None
        at = np.empty((place.max() + 1, 3))
        at[place] = self.positions
        island = _islands(len(at), start, end)
        hole = _islands(len(at), start[rims], end[rims])[start[rims]]
        middle = np.zeros_like(at)
        np.add.at(middle, hole, at[start[rims]])
        middle = middle[hole] / np.bincount(hole, minlength=len(at))[hole, None]
        caps = np.stack([at[end[rims]], at[start[rims]], middle], axis=1)
        corners = np.concatenate([at[faces], caps])
        volume = np.linalg.det(corners)
        of = np.concatenate([island[faces[:, 0]], island[start[rims]]])
        if (np.bincount(of, volume, minlength=len(at))[np.unique(of)] <= 0.0).any():
            return None
        normal = np.cross(caps[:, 1] - caps[:, 0], caps[:, 2] - caps[:, 0])
        return caps[:, 0], normal


_made: WeakKeyDictionary[Part, Facets] = WeakKeyDictionary()


def facets_of(part: Part, mesh: Mesh) -> Facets:
    """Return the facets of a part of a mesh, made once."""
    if part not in _made:
        _made[part] = Facets.of(part, mesh)
    return _made[part]


def _first_at_place(positions: Floats) -> NDArray[np.int64]:
    """The first vertex with the position of each vertex."""
    keys = np.zeros(len(positions), dtype=np.uint64)
    for axis in (positions + 0.0).astype(np.float64).T:
        keys = _mixed(keys + np.ascontiguousarray(axis).view(np.uint64))
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return np.asarray(first[inverse])


def _mixed(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scatter 64 bits over 64: Steele, Lea and Flood (2014), "Fast splittable pseudorandom number
    generators", figure 16."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(bits ^ (bits >> np.uint64(31)))


def _islands(count: int, start: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.int64]:
    """The lowest vertex that edges connect to each vertex."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[start], label[end])
        before = label.copy()
        for ends in (label[start], label[end], start, end):
            np.minimum.at(label, ends, low)
        while (label != label[label]).any():
            label = label[label]
        if (label == before).all():
            return label
