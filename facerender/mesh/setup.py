"""The triangles of a part as the GPU gets them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import add
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.mesh.part import Float, Part, Space

# Clip coordinates of corners whose bounds are the whole image.
_EVERYWHERE = np.array([[x, y, 0.0, 1.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)] * 2)
_EDGE_ON = 0.01  # sine of the angle between view ray and triangle


class Area(NamedTuple):
    """A rectangle of an image: left column, lowest row, width and height in pixels."""

    left: int = 0
    low: int = 0
    width: int = 0
    height: int = 0

    @property
    def empty(self) -> bool:
        return not (self.width and self.height)

    @classmethod
    def around(cls, areas: Sequence[Area]) -> Area:
        """Return the bounds of several areas. Empty areas are ignored."""
        filled = [area for area in areas if area[2] and area[3]]
        if not filled:
            return cls()
        lefts, lows, widths, heights = zip(*filled, strict=True)
        left, low = min(lefts), min(lows)
        right = max(map(add, lefts, widths))
        return cls(left, low, right - left, max(map(add, lows, heights)) - low)


def face_normals(
    columns: NDArray[Any], faces: NDArray[Any]
) -> tuple[NDArray[Any], list[NDArray[Any]]]:
    """Return the first corner and the normal of each triangle, (3, F). The length of a normal is
    twice the triangle's area.

    columns : x, y and z of the vertices, (3, N)
    faces : (3, F)
    """
    a, b, c = (columns.take(corner, axis=1) for corner in faces)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    return a, [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx]


@dataclass(frozen=True, eq=False)
class TriangleSetup:
    """The triangles of a part in the renderer's space, as the GPU gets them.

    vertices : (N, 6) float32, vertex positions in the renderer's space, and normals
    faces : (F, 3) uint32, indices of vertices
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]

    @classmethod
    def of(cls, part: Part, space: Space) -> TriangleSetup:
        """Return the triangle setup of a part of a mesh."""
        vertices = np.empty((len(part.positions), 6), dtype=np.float32)
        vertices[:, :3], vertices[:, 3:] = space.normalised(part.positions), part.normals
        return cls(vertices, np.asarray(part.faces, dtype=np.uint32))

    @property
    def positions(self) -> NDArray[np.float32]:
        """Vertex positions in the renderer's space, (N, 3)."""
        return self.vertices[:, :3]

    @cached_property
    def bounds(self) -> NDArray[np.floating[Any]]:
        """Corners of the vertices' bounding box, homogeneous, (8, 4)."""
        columns = np.ascontiguousarray(self.positions.T)
        sides = zip(columns.min(axis=1), columns.max(axis=1), strict=True)
        return np.stack(np.meshgrid(*sides, [1.0]), axis=-1).reshape(-1, 4)

    @cached_property
    def planes(self) -> NDArray[np.float32]:
        """Unit normal of each triangle, and the distance of the origin from its plane, (4, F)."""
        columns, faces = (np.ascontiguousarray(array.T) for array in (self.positions, self.faces))
        corners, vectors = face_normals(columns, faces)
        normals = np.stack(vectors)
        normals /= np.maximum(np.linalg.norm(normals, axis=0), 1e-30)
        return np.vstack([normals, -np.einsum("ij,ij->j", normals, corners)])

    def facing(self, camera: Float) -> NDArray[np.int64]:
        """Return the indices of the triangles that can face a camera at the given position (3,).

        Triangles that are seen edge-on are included, because a driver rounds positions to fractions
        of a pixel before it decides which triangles are back faces.
        """
        edge_on = -_EDGE_ON * (1.0 + math.sqrt(camera @ camera))
        return (np.array((*camera, 1.0), dtype=np.float32) @ self.planes > edge_on).nonzero()[0]


def areas_of(bounds: Float, view: Float, size: tuple[int, int]) -> list[Area]:
    """Return the bounds of each part in an image; empty for a part outside the image.

    bounds : (parts, 8, 4), see :attr:`TriangleSetup.bounds`
    view : matrix of the image's :class:`View`
    size : width and height of the image
    """
    clip = bounds @ view
    w = clip[..., 3:]
    if np.minimum.reduce(w, None) <= 0.0:  # a part may reach the camera
        w = np.where(behind := w.min(axis=1, keepdims=True) <= 0.0, 1.0, w)
        clip = np.where(behind, _EVERYWHERE, clip)
    corners = (clip[..., :2] / w * 0.5 + 0.5) * size
    # The largest of negated corners are the lowest ones: one array serves all four sides.
    sides = np.maximum.reduce(np.concatenate([-corners, corners], axis=2), 1)
    width, height = size
    sides = np.maximum(np.ceil(sides), (-width, -height, 0, 0))
    sides = np.minimum(sides, (0, 0, width, height)).astype(int)
    return [Area(-left, -low, left + right, low + top) for left, low, right, top in sides.tolist()]
