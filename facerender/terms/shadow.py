"""Shadow mapping: the float64 reference for ``shaders/facerender/shadow.glsl``, which defines light
space."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]
Tile = tuple[int, int, int]

SAMPLES = 12  # Value of FR_SHADOW_SAMPLES in GLSL.
_TURN = 2.39996323


def shadow_lit(map: ArrayLike, tile: Tile, at: ArrayLike, z: ArrayLike) -> Float:
    """Return the light's visibility, 0 or 1 per texel, interpolated between four texels.

    Parameters
    ----------
    map : z of the surface nearest to the light, (H, W)
    tile : column and row of the first texel of the light's map, and the side of the map in texels
    at : x and y in light space, (..., 2)
    z : z in light space, (...)
    """
    texel = (0.5 * np.asarray(at, dtype=np.float64) + 0.5) * tile[2] - 0.5
    low = np.floor(texel)
    share = texel - low
    depth = np.asarray(z, dtype=np.float64)
    lit = np.zeros(low.shape[:-1])
    for corner in np.ndindex(2, 2):
        weight = np.where(corner, share, 1.0 - share).prod(axis=-1)
        lit += weight * (depth >= _fetch(map, tile, low + corner))
    return lit


def shadow_hard(map: ArrayLike, tile: Tile, p: ArrayLike, bias: float) -> Float:
    """Return the visible fraction of a light without angular radius.

    Parameters
    ----------
    map, tile : see :func:`shadow_lit`
    p : points in light space, (..., 3)
    bias : offset added to the z of p
    """
    place = np.asarray(p, dtype=np.float64)
    return shadow_lit(map, tile, place[..., :2], place[..., 2] + bias)


def shadow_disc(
    map: ArrayLike,
    tile: Tile,
    p: ArrayLike,
    plane: ArrayLike,
    tan_radius: float,
    top: float,
    bias: float,
    turn: ArrayLike,
) -> Float:
    """Return the visible fraction of a disc light or a sphere light.

    Parameters
    ----------
    map, tile, p, bias : see :func:`shadow_hard`
    plane : change of z per unit of x and per unit of y on the surface, (..., 2)
    tan_radius : tangent of the angular radius of the light, in (0, tan(20 degrees)]
    top : largest z of the occluders; the light is fully visible if the z of p is at least this
        value
    turn : rotation of the spiral of samples, in radians
    """
    place = np.asarray(p, dtype=np.float64)[..., None, :]  # Adds an axis for the samples.
    slope = np.asarray(plane, dtype=np.float64)[..., None, :]
    angle = _TURN * np.arange(SAMPLES) + np.asarray(turn, dtype=np.float64)[..., None]
    spiral = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    spiral *= np.sqrt((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
    z = place[..., 2] + bias

    aside = tan_radius * np.clip(top - place[..., 2:], 0.0, 1.0) * spiral
    other = _fetch(map, tile, np.floor((0.5 * (place[..., :2] + aside) + 0.5) * tile[2]))
    blocks = other > z + np.maximum((slope * aside).sum(axis=-1), 0.0) + bias
    blocks &= place[..., 2] < top
    count = blocks.sum(axis=-1)
    depth = np.where(blocks, other, 0.0).sum(axis=-1) / np.maximum(count, 1)

    radius = np.maximum(tan_radius * (depth - place[..., 0, 2]), 2.0 / tile[2])
    aside = radius[..., None, None] * spiral
    raised = z + np.maximum((slope * aside).sum(axis=-1), 0.0)
    seen = shadow_lit(map, tile, place[..., :2] + aside, raised).mean(axis=-1)
    return np.select([count == 0, count == SAMPLES], [1.0, 0.0], seen)


def _fetch(map: ArrayLike, tile: Tile, texel: Float) -> Float:
    column, row = (np.clip(texel[..., i], 0, tile[2] - 1).astype(int) + tile[i] for i in (0, 1))
    return np.asarray(np.asarray(map, dtype=np.float64)[row, column])
