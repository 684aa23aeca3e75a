"""Shadow mapping in float64: the reference for ``shaders/facerender/shadow.glsl``, which defines
light space."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]
Tile = tuple[int, int, int]

SEARCH, SAMPLES = 12, 28  # Values of FR_SHADOW_SEARCH and FR_SHADOW_SAMPLES in GLSL.
_TURN = 2.39996323  # Golden angle between consecutive samples of the search, in radians.
_NEXT = 0.6  # Angle between consecutive crosses of the mean, in radians.


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
    jitter: tuple[float, float] = (0.5, 0.5),
) -> Float:
    """Return the visible fraction of a disc light or a sphere light.

    Parameters
    ----------
    map, tile, p, plane, bias : see :func:`shadow_hard`
    tan_radius : tangent of the angular radius of the light, in [0, tan(20 degrees)]
    top : largest z of the occluders; the light is fully visible if the z of p is at least this
        value
    width : width of a pixel in texels, in [1, 3]
    start : direction of the first sample, a unit vector (..., 2)
    jitter : position of the samples within their rings, in search and mean
    """
    place = np.asarray(p, dtype=np.float64)
    slope = np.asarray(plane, dtype=np.float64)[..., None, :] * (2.0 / tile[2])
    middle = (0.5 * place[..., :2] + 0.5)[..., None, :] * tile[2]
    z, base = (place[..., 2] + bias)[..., None], place[..., 2:]
    cone = 0.5 * tile[2] * tan_radius
    x, y = np.moveaxis(np.asarray(start, dtype=np.float64), -1, 0)
    first = np.arctan2(y, x)[..., None]

    def texels(away: Float, angle: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Return the map's z at samples, and whether it is above the tangent plane.

        away, angle : distances (..., N) of the samples from p, in texels, and directions
        """
        aside = away[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        occluder_z = shadow_depth(map, tile, middle + aside)
        return occluder_z, occluder_z > z + np.maximum((slope * aside).sum(axis=-1), 0.0)

    reach = np.maximum(cone * np.clip(top - base, 0.0, 1.0), 0.5 * width)
    away = reach * (np.arange(SEARCH) + jitter[0]) / SEARCH
    occluder_z, blocks = texels(away, first + _TURN * np.arange(SEARCH))
    blocks &= base < top
    weights = np.where(away < np.maximum(cone * (occluder_z - base), 1.0), 1.0, 0.1) * blocks
    depth = (weights * occluder_z).sum(axis=-1) / np.maximum(weights.sum(axis=-1), 0.1)

    crosses = np.repeat(np.arange(SAMPLES // 4), 4)
    radius = np.maximum(cone * (depth - place[..., 2]), 0.56 * width)
    away = radius[..., None] * np.sqrt((crosses + jitter[1]) / (SAMPLES // 4))
    quarters = np.tile(0.5 * np.pi * np.arange(4), SAMPLES // 4)
    occluder_z, above = texels(away, first + _NEXT * crosses + quarters)
    above &= away <= np.maximum(
        1.5 * cone * (occluder_z - base), np.maximum(0.56 * np.asarray(width), 1.0)
    )
    return np.where(blocks.any(axis=-1), 1.0 - above.mean(axis=-1), 1.0)
