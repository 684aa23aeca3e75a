"""Meshes from arrays: checked vertices and faces, split at the seams of the texture; normals of
moved vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError
from facerender.images.image import srgb_to_linear
from facerender.mesh.part import Part
from facerender.mesh.repair import Piece, stacked, with_faces
from facerender.values.vectors import rows_of

Float = NDArray[np.float64]
Column = NDArray[np.floating[Any]]
Columns = tuple[Column, Column, Column]


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
    def of(cls, parts: Sequence[Part]) -> Corners:
        """Return the corners of a mesh in the reference pose."""
        _, joint, welded, _ = stacked(parts)
        groups = _split_at_creases(welded, np.concatenate([part.normals for part in parts]))
        corners = groups[joint].ravel()
        order = np.argsort(corners, kind="stable")
        used_groups, starts = np.unique(corners[order], return_index=True)
        dense = np.searchsorted(used_groups, groups).clip(max=len(used_groups) - 1)
        return cls(np.ascontiguousarray(joint.T), order // 3, starts, dense)

    def normal_sums(self, positions: Sequence[Float]) -> list[Float]:
        """Return, for each vertex of each part with positions (N, 3), the sum of the normals of its
        faces, weighted by their areas. Vertices that share position and normal in the reference
        pose share the sum."""
        columns = [np.concatenate([places[:, axis] for places in positions]) for axis in range(3)]
        _, normals = face_normals(columns, self.faces)
        sums = (np.add.reduceat(column[self.order], self.starts)[self.groups] for column in normals)
        splits = np.cumsum([len(places) for places in positions])[:-1]
        return np.split(np.stack([*sums], axis=1), splits)


def face_normals(columns: Sequence[Column], faces: NDArray[Any]) -> tuple[Columns, Columns]:
    """Return the first corner and the normal of each triangle as columns x, y and z, (F,) each.
    The length of a normal is twice the triangle's area.

    columns : x, y and z of the vertices, (N,) each
    faces : (3, F)
    """
    corners = ([np.take(column, corner) for corner in faces] for column in columns)
    (ax, ux, vx), (ay, uy, vy), (az, uz, vz) = ((a, b - a, c - a) for a, b, c in corners)
    return (ax, ay, az), (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def _split_at_creases(welded: NDArray[np.int64], normals: Float) -> NDArray[np.int64]:
    """Return labels that vertices at one position share if their normals are nearly equal."""
    labels = np.empty_like(welded)
    remaining, count = np.arange(len(welded)), 0
    while len(remaining):
        _, first, group = np.unique(welded[remaining], return_index=True, return_inverse=True)
        rows = normals[remaining]
        like = np.einsum("ij,ij->i", rows, rows[first[group]]) > 0.999
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


def indices_of(
    name: str, indices: ArrayLike, count: int, kind: str, uses: str, hint: str = ""
) -> NDArray[np.int64]:
    """Return indices (F, 3) in [0, count) from an array or nested lists. ``kind`` names the indices
    in messages, and ``uses`` begins the message about an invalid one."""
    rows = rows_of(name, indices, (3,), hint)
    if (rows != np.floor(rows)).any():
        raise InputError(f"{name} are not whole numbers: give {kind} indices")
    if ((rows < 0) | (rows >= count)).any():
        bad = int(rows.min()) if (rows < 0).any() else int(rows.max())
        raise InputError(f"{uses} {bad} of {count}: give indices from 0 on")
    return rows.astype(np.int64)


def split_at_seams(piece: Piece, uv: Float, indices: ArrayLike) -> Piece:
    """Return a piece with a vertex for each pair of a vertex and a row of uv that a corner uses.

    indices : uv_faces of :meth:`facerender.Mesh.from_arrays`
    """
    uv_faces = indices_of("uv_faces", indices, len(uv), "row", "uv_faces use row")
    if len(uv_faces) != len(piece.faces):
        remedy = f"give {len(piece.faces)}, one for each face"
        raise InputError(f"uv_faces has {len(uv_faces)} rows: {remedy}")
    pairs, corners = np.unique(piece.faces * len(uv) + uv_faces, return_inverse=True)
    vertices, rows = np.divmod(pairs, len(uv))
    return replace(with_faces(piece, corners.reshape(-1, 3), vertices), uv=uv[rows])


def linear_colors(colors: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return linear RGB (N, 3); for the colours see :meth:`facerender.Mesh.from_arrays`."""
    rows = rows_of("colors", colors, (3, 4), count=count)[:, :3]
    dtype = np.asarray(colors).dtype
    if dtype in (np.uint8, np.uint16):
        return srgb_to_linear(rows / np.iinfo(dtype).max)
    if rows.min() < 0.0 or rows.max() > 1.0:
        remedy = "give linear values in [0, 1] or sRGB-encoded uint8"
        raise InputError(f"colors range from {rows.min():.4g} to {rows.max():.4g}: {remedy}")
    return rows
