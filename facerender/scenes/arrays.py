"""Meshes from arrays: checked vertices and faces, split at the seams of the texture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_type
from facerender.images.srgb import srgb_to_linear
from facerender.scenes.material import MAPS, SKIN_ALBEDO, Material
from facerender.scenes.repair import Piece, with_faces
from facerender.scenes.vectors import rows_of


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
