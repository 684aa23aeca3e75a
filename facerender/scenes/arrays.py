"""Arrays that a program gives as a mesh: checked, and copied."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_type, reason
from facerender.images.srgb import srgb_to_linear
from facerender.scenes.material import MAPS, SKIN_ALBEDO, Material
from facerender.scenes.repair import Piece

Float = NDArray[np.float64]


def piece_of(
    positions: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike | None,
    normals: ArrayLike | None,
    colors: ArrayLike | None,
    material: Material | None,
) -> Piece:
    """Return a piece of copies; parameters and errors as of :meth:`facerender.Mesh.from_arrays`."""
    check_type("material", material, Material | None, "a facerender.Material or None")
    places = _rows("positions", positions, (3,))
    corners = _rows("faces", faces, (3,), "; cut polygons into triangles")
    count = len(places)
    if (corners != np.floor(corners)).any():
        raise InputError("faces are no whole numbers: give indices of vertices")
    if ((corners < 0) | (corners >= count)).any():
        bad = int(corners.min()) if (corners < 0).any() else int(corners.max())
        raise InputError(f"a face names vertex {bad} of {count}: number them from 0 on")
    if material is None:
        material = Material(albedo=SKIN_ALBEDO if colors is None else (1.0, 1.0, 1.0))
    maps = [each for each in MAPS if getattr(material, each) is not None]
    if uv is None and maps:
        raise InputError(f"the material has {maps[0]}, and the mesh no uv: give it as well")
    return Piece(
        places,
        corners.astype(np.int64),
        None if normals is None else _rows("normals", normals, (3,), count=count),
        None if uv is None else _rows("uv", uv, (2,), count=count),
        None if colors is None else _linear_colors(colors, count),
        material,
    )


def _rows(
    name: str,
    array: ArrayLike,
    widths: tuple[int, ...],
    hint: str = "",
    count: int | None = None,
) -> Float:
    """Return a copy of rows of finite numbers, as many as there are vertices if that is known."""
    try:
        values = np.asarray(array)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} cannot be an array ({reason(error)}): give rows") from None
    if values.dtype.kind not in "fiu" or values.ndim != 2 or values.shape[1] not in widths:
        wanted = " or ".join(map(str, widths))
        raise InputError(
            f"{name} has the shape {values.shape} of {values.dtype}: give rows of {wanted} "
            f"numbers{hint}"
        )
    if not len(values) or count not in (None, len(values)):
        wanted = f"{count}, one for each vertex" if count else "at least one"
        raise InputError(f"{name} has {len(values)} rows: give {wanted}")
    rows = np.array(values, dtype=np.float64)
    if not (finite := np.isfinite(rows).all(axis=1)).all():
        bad = int(finite.argmin())
        raise InputError(
            f"{name}[{bad}] = {rows[bad].tolist()}: {int((~finite).sum())} rows are not finite; "
            "leave them out"
        )
    return rows


def _linear_colors(colors: ArrayLike, count: int) -> Float:
    rows = _rows("colors", colors, (3, 4), count=count)[:, :3]
    dtype = np.asarray(colors).dtype
    if dtype in (np.uint8, np.uint16):
        return srgb_to_linear(rows / np.iinfo(dtype).max)
    if rows.min() < 0.0 or rows.max() > 1.0:
        raise InputError(
            f"colors reach from {rows.min():.4g} to {rows.max():.4g}: give linear ones in [0, 1], "
            "or uint8 that are sRGB-encoded"
        )
    return rows
