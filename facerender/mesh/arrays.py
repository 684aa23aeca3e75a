"""Meshes from arrays: checked vertices and faces, split at the seams of the texture; normals of
moved vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_type
from facerender.images.image import srgb_to_linear
from facerender.material import MAPS, SKIN_ALBEDO, Material
from facerender.mesh.repair import Piece, stacked, with_faces
from facerender.values.vectors import rows_of

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


def piece_of(
    positions: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike | None,
    uv_faces: ArrayLike | None,
    normals: ArrayLike | None,
    colors: ArrayLike | None,
    material: Material | None,
) -> Piece:
    """Return a piece; for the parameters and errors see :meth:`facerender.Mesh.from_arrays`."""
    check_type("material", material, Material | None, "a facerender.Material or None")
    places = rows_of("positions", positions, (3,))
    count = len(places)
    hint = "; cut polygons into triangles"
    corners = _indices("faces", faces, count, "vertex", "a face uses vertex", hint)
    if material is None:
        material = Material(albedo=SKIN_ALBEDO if colors is None else (1.0, 1.0, 1.0))
    maps = [name for name in MAPS if getattr(material, name) is not None]
    if uv is None and maps:
        raise InputError(f"the material has {maps[0]}, but the mesh has no uv: give uv")
    if uv is None and uv_faces is not None:
        raise InputError("uv_faces without uv: give uv as well")
    vectors = None if normals is None else rows_of("normals", normals, (3,), count=count)
    linear = None if colors is None else _linear_colors(colors, count)
    piece = Piece(places, corners, vectors, None, linear, material)
    if uv_faces is not None and uv is not None:
        rows = rows_of("uv", uv, (2,))
        uv_corners = _indices("uv_faces", uv_faces, len(rows), "row", "uv_faces use row")
        return _split_at_seams(piece, rows, uv_corners)
    piece.uv = None if uv is None else rows_of("uv", uv, (2,), count=count)
    return piece


def _indices(
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


def _split_at_seams(piece: Piece, uv: NDArray[np.float64], uv_faces: NDArray[np.int64]) -> Piece:
    """Return a piece with a vertex for each pair of a vertex and a row of uv that a corner uses."""
    if len(uv_faces) != len(piece.faces):
        remedy = f"give {len(piece.faces)}, one for each face"
        raise InputError(f"uv_faces has {len(uv_faces)} rows: {remedy}")
    pairs, corners = np.unique(piece.faces * len(uv) + uv_faces, return_inverse=True)
    vertices, rows = np.divmod(pairs, len(uv))
    return replace(with_faces(piece, corners.reshape(-1, 3), vertices), uv=uv[rows])


def _linear_colors(colors: ArrayLike, count: int) -> NDArray[np.float64]:
    rows = rows_of("colors", colors, (3, 4), count=count)[:, :3]
    dtype = np.asarray(colors).dtype
    if dtype in (np.uint8, np.uint16):
        return srgb_to_linear(rows / np.iinfo(dtype).max)
    if rows.min() < 0.0 or rows.max() > 1.0:
        raise InputError(
            f"colors range from {rows.min():.4g} to {rows.max():.4g}: give linear values in [0, 1] "
            "or sRGB-encoded uint8"
        )
    return rows
