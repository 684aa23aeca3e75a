"""How finely an image reads maps, which large ones are reduced to. No OpenGL here."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.view import View

_UNSEEN = 2e-4  # of the triangles' pixels: a chart's few stretched triangles do not count


def levels_to_spare(
    mesh: Mesh,
    part: Part,
    uv: NDArray[np.float64],
    texels: tuple[int, int],
    view: View,
    size: tuple[int, int],
    anisotropy: float = 1.0,
) -> int:
    """Return how many of the finest mip levels of a map an image does not read.

    A triangle reads the level log2 of the texels that a pixel covers along its longer side (OpenGL
    3.3, section 3.8.11), with anisotropy along a part of it (EXT_texture_filter_anisotropic);
    triangles that hide each other all count.

    Parameters
    ----------
    part, uv : of the mesh, and its texture coordinates
    texels, size : width and height of the map, and of the image
    """
    clip = np.column_stack([mesh.normalised(part.positions), np.ones(len(part.positions))])
    x, y, w = (clip @ view.matrix[:, [0, 1, 3]]).T
    before = w[part.faces] > 1e-6
    crossing = before.any(axis=1) & ~before.all(axis=1)
    faces = part.faces[before.all(axis=1)]
    half = np.divide(size, 2.0)
    pixels = np.stack([x, y], axis=-1) / np.maximum(w, 1e-6)[:, None] * half
    corners, coordinates = pixels[faces], (uv * texels)[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    shown = np.clip(np.minimum(high, half) - np.maximum(low, -half), 0.0, None)
    across, along = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    double = across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Of the box around a triangle, as much of the triangle is in the frame.
        area = np.abs(double) * np.nan_to_num(np.prod(shown / (high - low), axis=1))
        first, second = (coordinates[:, i] - coordinates[:, 0] for i in (1, 2))
        by_x = (first * along[:, 1:] - second * across[:, 1:]) / double[:, None]
        by_y = (second * across[:, :1] - first * along[:, :1]) / double[:, None]
        read = np.sqrt(np.maximum((by_x**2).sum(axis=1), (by_y**2).sum(axis=1))) / anisotropy
    visible = (area > 0.0) & np.isfinite(read)
    if crossing.any() or not visible.any():
        return 0
    area, read = area[visible], read[visible]
    order = np.argsort(read)
    finest = read[order][np.searchsorted(np.cumsum(area[order]), _UNSEEN * area.sum())]
    most = min(texels).bit_length() - 2  # two texels are left on a side
    return max(min(math.floor(math.log2(max(finest, 1.0))), most), 0)
