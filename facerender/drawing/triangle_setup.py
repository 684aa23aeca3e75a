"""Triangle data for deferred shading: the plane of each triangle, and its attributes as affine
functions of the position. No OpenGL here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.program import part_columns
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.view import View

IN_ROW = 256  # triangles in a row of the texture
_AT_ONCE = 1 << 12  # triangles per block, to limit temporary memory
_EDGE_ON = 0.01  # sine of the angle between view ray and triangle
_ROUNDING = 2.0**-22  # rounding error of a triangle's width, for float32 positions of magnitude 1

Floats = NDArray[np.floating[Any]]
Area = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class TriangleSetup:
    """The triangles of a part.

    Attributes
    ----------
    positions : (N, 3) float32, vertex positions in the renderer's space
    faces : (F, 3) uint32, indices of vertices
    columns : (N, K) float32, vertex attributes; the first three columns are the normal, and the
        last one is the dot product of position and normal
    """

    positions: NDArray[np.float32]
    faces: NDArray[np.uint32]
    columns: NDArray[np.float32]

    @classmethod
    def of(cls, part: Part, mesh: Mesh) -> TriangleSetup:
        """Return the triangle setup of a part of a mesh."""
        columns = part_columns(part, mesh)
        positions = columns.pop("in_position").astype(np.float32)
        columns.pop("in_uv2", None)  # deferred shading supports one set of texture coordinates
        tangent_planes = np.einsum("ij,ij->i", positions, columns["in_normal"])[:, None]
        columns["tangent_plane"] = tangent_planes
        attributes = np.hstack([*columns.values()], dtype=np.float32, casting="same_kind")
        return cls(positions, np.asarray(part.faces, dtype=np.uint32), attributes)

    @cached_property
    def bounds(self) -> Floats:
        """Corners of the vertices' bounding box, homogeneous, (8, 4)."""
        columns = np.ascontiguousarray(self.positions.T)
        sides = zip(columns.min(axis=1), columns.max(axis=1), strict=True)
        return np.stack(np.meshgrid(*sides, [1.0]), axis=-1).reshape(-1, 4)

    @cached_property
    def planes(self) -> NDArray[np.float32]:
        """Unit normal of each triangle, and the distance of the origin from its plane, (F, 4)."""
        a, b, c = (np.take(self.positions, corner, axis=0) for corner in self.faces.T)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        return np.column_stack([normals, -np.einsum("ij,ij->i", normals, a)])

    def facing(self, camera: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the indices of the triangles that can face a camera at the given position (3,).

        Triangles that are seen edge-on are included, because a driver rounds positions to fractions
        of a pixel before it decides which triangles are back faces.
        """
        edge_on = _EDGE_ON * (1.0 + np.linalg.norm(camera))
        return np.flatnonzero(self.planes @ np.append(camera, 1.0).astype(np.float32) > -edge_on)

    @property
    def texels(self) -> int:
        """Number of texels per triangle."""
        return 1 + int(self.columns.shape[1])

    def area(self, view: View, size: tuple[int, int]) -> Area:
        """Return the bounds of the part in an image: left column, lowest row, width and height in
        pixels. If width or height is 0, the part is outside the image.

        size : width and height of the image
        """
        clip = self.bounds @ view.matrix
        if clip[:, 3].min() <= 0.0:
            return (0, 0, *size)
        at = (clip[:, :2] / clip[:, 3:] * 0.5 + 0.5) * size
        start = np.clip(np.floor(at.min(axis=0)), 0, size).astype(int)
        end = np.clip(np.ceil(at.max(axis=0)), 0, size).astype(int)
        return (*start.tolist(), *(end - start).tolist())

    def texture(self) -> NDArray[np.float32]:
        """Return the texture of all triangles, (rows, IN_ROW * texels, 4) float32.

        The first texel of a triangle holds the unit normal of its plane and the plane's distance
        from the origin. Each further texel holds an attribute's gradient, and the
        attribute's value at the origin.

        A triangle may be narrower than the rounding error, for example in a filled T-junction. Then
        its attributes vary only along its length, and its first vertex determines the normal.
        """
        rows = -(-len(self.faces) // IN_ROW)
        packed = np.zeros((rows * IN_ROW, self.texels, 4), dtype=np.float32)
        for start in range(0, len(self.faces), _AT_ONCE):
            faces = self.faces[start : start + _AT_ONCE].T
            a, b, c = (np.take(self.positions, each, axis=0).astype(np.float64) for each in faces)
            u, v = b - a, c - a
            normal = np.cross(u, v)
            largest = np.maximum(np.maximum(np.abs(a), np.abs(b)), np.abs(c)).max(axis=1)
            hidden = (_ROUNDING * np.maximum(largest, 1e-30))[:, None] ** 2
            lengths = _dot(u, u) + _dot(v, v) + hidden
            normal *= _dot(normal, normal) > hidden * lengths
            area = _dot(normal, normal) + hidden * lengths
            value, *others = (np.take(self.columns, each, axis=0) for each in faces)
            change_u, change_v = (each - value for each in others)
            across_u = (np.cross(v, normal) + hidden * u) / area
            across_v = (np.cross(normal, u) + hidden * v) / area
            along = (u * _dot(u, value[:, :3]) + v * _dot(v, value[:, :3])) / lengths
            normal += np.sqrt(hidden * lengths) * (value[:, :3] - along)
            normal /= np.sqrt(_dot(normal, normal))
            out = packed[start : start + faces.shape[1]]
            out[:, 0, :3] = normal
            out[:, 0, 3] = np.einsum("ij,ij->i", out[:, 0, :3], a)
            for i in range(3):
                gradients = change_u * across_u[:, i : i + 1] + change_v * across_v[:, i : i + 1]
                out[:, 1:, i] = gradients
                value = value - out[:, 1:, i] * a[:, i : i + 1]
            out[:, 1:, 3] = value
        return packed.reshape(rows, IN_ROW * self.texels, 4)


def _dot(a: Floats, b: Floats) -> Floats:
    """Return the dot product of each row of `a` with the same row of `b`, (N, 1)."""
    return np.asarray(np.einsum("ij,ij->i", a, b)[:, None])


def around(areas: Sequence[Area]) -> Area:
    """Return the bounds of several areas. Empty areas are ignored."""
    seen = [area for area in areas if all(area[2:])] or [(0, 0, 0, 0)]
    left, low = min(area[0] for area in seen), min(area[1] for area in seen)
    right, high = max(area[0] + area[2] for area in seen), max(area[1] + area[3] for area in seen)
    return left, low, right - left, high - low


_made: WeakKeyDictionary[Part, tuple[tuple[float, ...], TriangleSetup]] = WeakKeyDictionary()


def triangle_setup_of(part: Part, mesh: Mesh) -> TriangleSetup:
    """Return the triangle setup of a part of a mesh, from a cache. Meshes with the same centre and
    radius share one setup."""
    place = (*mesh.center, mesh.radius)
    known = _made.get(part)
    if known is None or known[0] != place:
        _made[part] = known = place, TriangleSetup.of(part, mesh)
    return known[1]
