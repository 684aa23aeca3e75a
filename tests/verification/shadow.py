"""Shadow mapping in float64: the reference for ``shaders/facerender/shadow.glsl``, which defines
light space."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]
Tile = tuple[int, int, int]

SEARCH, SAMPLES = 8, 12  # Values of FR_SHADOW_SEARCH and FR_SHADOW_SAMPLES in GLSL.
_TURN = 2.39996323  # Golden angle between consecutive samples of a spiral, in radians.


def shadow_depth(map: ArrayLike, tile: Tile, texel: ArrayLike) -> Float:
    """Return the z of the surface nearest to the light in a texel.

    Parameters
    ----------
    map : z of the surface nearest to the light, (H, W)
    tile : column and row of the first texel of the light's map, and the side of the map in texels
    texel : column and row in the light's map, (..., 2)
    """
    inside = np.clip(np.asarray(texel, dtype=np.float64), 0, tile[2] - 1).astype(int)
    column, row = (inside[..., i] + tile[i] for i in (0, 1))
    return np.asarray(np.asarray(map, dtype=np.float64)[row, column])


def shadow_weight(texel: ArrayLike, centre: ArrayLike, width: ArrayLike) -> Float:
    """Return the weight of a texel in the mean over a square.

    Parameters
    ----------
    texel : lower corner of the texel, (..., 2)
    centre : centre of the square in texels, (..., 2)
    width : side of the square in texels, in [1, 3]
    """
    low, middle = np.asarray(texel, np.float64), np.asarray(centre, np.float64)
    side = np.asarray(width, np.float64)[..., None]
    overlap = np.maximum(low, middle - 0.5 * side), np.minimum(low + 1.0, middle + 0.5 * side)
    return np.asarray((np.maximum(overlap[1] - overlap[0], 0.0) / side).prod(axis=-1))


def shadow_hard(
    map: ArrayLike, tile: Tile, p: ArrayLike, plane: ArrayLike, width: ArrayLike, bias: float
) -> Float:
    """Return the visible fraction of a light without angular radius.

    Parameters
    ----------
    map, tile : see :func:`shadow_depth`
    p : points in light space, (..., 3)
    plane : change of z per unit of x and per unit of y on the surface, (..., 2)
    width : side in texels, in [1, 3], of the square over which the visibility is averaged
    bias : offset added to the z of p
    """
    place = np.asarray(p, dtype=np.float64)
    side = np.asarray(width, dtype=np.float64)
    centre = (0.5 * place[..., :2] + 0.5) * tile[2]
    visibility = np.zeros(place.shape[:-1])
    for corner in np.ndindex(4, 4):
        texel = np.floor(centre - 0.5 * side[..., None]) + corner
        aside = (texel + 0.5 - centre) * (2.0 / tile[2])
        z = place[..., 2] + bias + np.maximum((np.asarray(plane) * aside).sum(axis=-1), 0.0)
        visibility += shadow_weight(texel, centre, side) * (shadow_depth(map, tile, texel) <= z)
    return visibility


def shadow_disc(
    map: ArrayLike,
    tile: Tile,
    p: ArrayLike,
    plane: ArrayLike,
    tan_radius: float,
    top: float,
    bias: float,
    width: float,
    start: ArrayLike,
) -> Float:
    """Return the visible fraction of a disc light or a sphere light.

    Parameters
    ----------
    map, tile, p, plane, bias : see :func:`shadow_hard`
    tan_radius : tangent of the angular radius of the light, in [0, tan(20 degrees)]
    top : largest z of the occluders; the light is fully visible if the z of p is at least this
        value
    width : smallest side of the square in texels, in [1, 3]
    start : direction of the first sample, a unit vector (..., 2)
    """
    place = np.asarray(p, dtype=np.float64)
    slope = np.asarray(plane, dtype=np.float64)[..., None, :] * (2.0 / tile[2])
    middle = (0.5 * place[..., :2] + 0.5)[..., None, :] * tile[2]
    z, base = (place[..., 2] + bias)[..., None], place[..., 2:]
    cone = 0.5 * tile[2] * tan_radius
    x, y = np.moveaxis(np.asarray(start, dtype=np.float64), -1, 0)
    angle = _TURN * np.arange(max(SEARCH, SAMPLES)) + np.arctan2(y, x)[..., None]
    spiral = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def texels(away: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Return the map's z at samples, and whether it is above the tangent plane.

        away : distances (..., N) of the samples from p, in texels
        """
        aside = away[..., None] * spiral[..., : away.shape[-1], :]
        occluder_z = shadow_depth(map, tile, middle + aside)
        return occluder_z, occluder_z > z + np.maximum((slope * aside).sum(axis=-1), 0.0)

    reach = np.maximum(cone * np.clip(top - base, 0.0, 1.0), 0.5 * width)
    away = reach * (np.arange(SEARCH) + 0.5) / SEARCH
    occluder_z, blocks = texels(away)
    blocks &= base < top
    weights = np.where(away < np.maximum(cone * (occluder_z - base), 1.0), 1.0, 0.1) * blocks
    depth = (weights * occluder_z).sum(axis=-1) / np.maximum(weights.sum(axis=-1), 0.1)

    radius = cone * (depth - place[..., 2])
    away = radius[..., None] * np.sqrt((np.arange(SAMPLES) + 0.5) / SAMPLES)
    occluder_z, above = texels(away)
    above &= away <= np.maximum(1.5 * cone * (occluder_z - base), 1.0)
    wide = 1.0 - above.mean(axis=-1)
    narrow = shadow_hard(map, tile, place, plane, np.clip(2.0 * radius, width, 3.0), bias)
    count = blocks.sum(axis=-1)
    return np.select([count == 0, count == SEARCH, radius < 1.0], [1.0, 0.0, narrow], wide)
