"""Vertex normals of moved vertices: area-weighted means of face normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.scenes.repair import stacked

Float = NDArray[np.float64]
Column = NDArray[np.floating[Any]]
Columns = tuple[Column, Column, Column]

_SAME_NORMAL = 0.999  # minimum: cosine between two normals of one vertex that is split by a seam


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of a mesh's faces, sorted by vertex.

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
    def of(
        cls, positions: Sequence[Float], normals: Sequence[Float], faces: Sequence[NDArray[Any]]
    ) -> Corners:
        """Return the corners of a mesh in the reference pose, from arrays for each part."""
        _, joint, welded, _ = stacked(positions, faces)
        groups = _split_at_creases(welded, np.concatenate(normals))
        corners = groups[joint].ravel()
        order = np.argsort(corners, kind="stable")
        used_groups, starts = np.unique(corners[order], return_index=True)
        return cls(
            np.ascontiguousarray(joint.T),
            order // 3,
            starts,
            np.searchsorted(used_groups, groups).clip(max=len(used_groups) - 1),
        )

    def normal_sums(self, positions: Sequence[Float]) -> list[Float]:
        """Return, for each vertex of each part, the sum of the normals of its faces, weighted by
        their areas. Vertices that share position and normal in the reference pose share the sum.

        positions : (N, 3) for each part
        """
        columns = [np.concatenate([places[:, axis] for places in positions]) for axis in range(3)]
        _, normals = face_normals(columns, self.faces)
        sums = (np.add.reduceat(column[self.order], self.starts)[self.groups] for column in normals)
        splits = np.cumsum([len(places) for places in positions])[:-1]
        return np.split(np.stack([*sums], axis=1), splits)


def face_normals(columns: Sequence[Column], faces: NDArray[Any]) -> tuple[Columns, Columns]:
    """Return the first corner and the normal of each triangle as columns x, y and z, (F,) each.
    The length of a normal is twice the triangle's area.

    Parameters
    ----------
    columns : x, y and z of the vertices, (N,) each
    faces : (3, F)
    """
    (ax, ux, vx), (ay, uy, vy), (az, uz, vz) = (
        (
            first := np.take(column, faces[0]),
            *(np.take(column, corner) - first for corner in faces[1:]),
        )
        for column in columns
    )
    return (ax, ay, az), (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def _split_at_creases(welded: NDArray[np.int64], normals: Float) -> NDArray[np.int64]:
    """Return labels in which vertices at one position share a label if their normals are equal."""
    labels = np.empty_like(welded)
    remaining, count = np.arange(len(welded)), 0
    while len(remaining):
        _, first, group = np.unique(welded[remaining], return_index=True, return_inverse=True)
        rows = normals[remaining]
        like = np.einsum("ij,ij->i", rows, rows[first[group]]) > _SAME_NORMAL
        like[first] = True
        labels[remaining[like]] = count + group[like]
        remaining, count = remaining[~like], count + len(first)
    return labels


def unit_or(normals: Float, others: Float) -> Float:
    """Return vectors (N, 3) scaled to length 1; vectors of length 0 are replaced by others."""
    squares = np.einsum("ij,ij->i", normals, normals)
    if not ((squares > 1e-200) & (squares < 1e200)).all():
        largest = np.abs(normals).max(axis=1, keepdims=True)
        normals = np.where(largest > 0.0, normals / np.where(largest > 0.0, largest, 1.0), others)
        squares = np.einsum("ij,ij->i", normals, normals)
    return np.asarray(normals / np.sqrt(squares)[:, None])
