"""Mip chains of maps, with an averaging method for each kind of map. Large maps are reduced in
strips, which gives the same result as reducing the whole map. OpenGL is not used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.images.image import linear_to_srgb, srgb_to_linear
from facerender.terms.model import MAP_DEVIATION

Kind = Literal["color", "linear-color", "normal", "data"]
Levels = list[NDArray[Any]]
Rows = Callable[[int, int], NDArray[np.uint8]]  # returns rows [low, high), row 0 at the bottom

_STRIP = 32  # number of rows that are reduced at once


def coarse_base(
    kind: Literal["color", "normal", "data"], rows: Rows, size: tuple[int, int], drop: int
) -> NDArray[Any] | tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the base level from which :func:`coarse_chain` computes a mip chain.

    The function needs memory only for one strip and the result.

    Parameters
    ----------
    size : width and height of the full image
    drop : number of finest levels to skip, >= 1; the base level must have at least 2 x 2 texels
    """
    if kind == "data":
        return coarse_data(rows, size, drop)
    width, height = (side >> drop for side in size)
    finest = np.empty((height, width, 4), dtype=np.uint8)
    if kind == "color":
        for top, strip in _coarse_strips(rows, height, drop):
            pixels = _with_alpha(strip, 255)
            for _ in range(drop):
                pixels = _halve_srgb(_even(pixels))
            finest[top : top + len(pixels)] = pixels
        return finest
    means = np.empty((3, height // 2, width // 2), dtype=np.float32)
    for top, strip in _coarse_strips(rows, height, drop):
        normals = _halve_planes(_unit_planes(_even(in_three(strip))))
        for _ in range(drop - 1):
            normals = _halve_planes(_even_planes(normals))
        bottom = top + normals.shape[1]
        finest[top:bottom] = _with_deviation(normals)
        even = normals[:, : normals.shape[1] & -2, : width & -2]
        means[:, top // 2 : bottom // 2] = _halve_planes(even)
    return finest, means


def coarse_chain(base: NDArray[Any] | tuple[NDArray[np.uint8], NDArray[np.float32]]) -> Levels:
    """Return the mip chain of a base from :func:`coarse_base`. The chain equals the result of
    ``CHAIN`` without the skipped levels, except that Pillow may round a value of kind "data" to
    the next 8-bit level."""
    if isinstance(base, tuple):
        return [base[0], *_normal_chain(base[1])]
    return _color_chain(base) if base.shape[2:] == (4,) else _data_chain(in_three(base))


def coarse_data(rows: Rows, size: tuple[int, int], drop: int) -> NDArray[np.uint8]:
    """Return the base level of kind "data", (H, W, 3), or (H, W) for grey rows. See
    :func:`coarse_base` for the parameters."""
    width, height = (side >> drop for side in size)
    finest = np.empty((height, width, *rows(0, 1).shape[2:]), dtype=np.uint8)
    for top, strip in _coarse_strips(rows, height, drop):
        finest[top : top + (len(strip) >> drop)] = _halved(strip, drop)
    return finest


def _coarse_strips(rows: Rows, height: int, drop: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield strips of an image, each with the index of its first row in the base level, which is
    even. The base level has the given height."""
    step = max(_STRIP >> drop, 2)
    for top in range(0, height, step):
        yield top, rows(top << drop, min(top + step, height) << drop)


def _data_chain(finest: NDArray[np.uint8]) -> Levels:
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1], 1))
    return levels


def _halved(texels: NDArray[np.uint8], times: int) -> NDArray[np.uint8]:
    from PIL import Image

    image = Image.fromarray(texels)
    for _ in range(times):
        half = max(image.width // 2, 1), max(image.height // 2, 1)
        image = image.resize(half, Image.Resampling.BOX)
    return np.asarray(image)


def in_three(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return texels (H, W, 3) of grey texels (H, W), and other texels as they are."""
    return np.repeat(texels[..., None], 3, axis=2) if texels.ndim == 2 else texels


def _with_alpha(texels: NDArray[np.uint8], alpha: int) -> NDArray[np.uint8]:
    """Return a copy (H, W, 4) of texels with a constant alpha."""
    copy = np.empty((*texels.shape[:2], 4), dtype=np.uint8)
    copy[..., :3], copy[..., 3] = in_three(texels), alpha
    return copy


def _even(texels: NDArray[Any]) -> NDArray[Any]:
    """Make both sides even: double a side of 1; any other odd side loses its last texels."""
    for axis in (0, 1):
        if texels.shape[axis] == 1:
            texels = np.repeat(texels, 2, axis)
    return texels[: texels.shape[0] // 2 * 2, : texels.shape[1] // 2 * 2]


@lru_cache(maxsize=1)
def _light_tables() -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return two tables to average sRGB bytes in linear light. The first maps a byte to a quarter
    of its linear value. The second maps the sum of four quarters to a byte."""
    quarter = 16383
    decode = np.round(srgb_to_linear(np.arange(256) / 255.0) * quarter).astype(np.uint16)
    encode = np.round(linear_to_srgb(np.arange(65536) / (4 * quarter)) * 255.0).astype(np.uint8)
    return decode, encode


def _halve_srgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    decode, encode = _light_tables()
    height, width, channels = texels.shape
    halved = np.empty((height // 2, width // 2, channels), dtype=np.uint8)
    for top, strip in _strips(texels):
        # Adds four 16-bit channels as one uint64. Each sum fits in 16 bits, so there is no carry.
        light = decode[strip].view(np.uint64)[..., 0]
        rows = light[0::2] + light[1::2]
        blocks = rows[:, 0::2] + rows[:, 1::2]
        halved[top // 2 : top // 2 + len(blocks)] = encode[blocks.view(np.uint16)].reshape(
            *blocks.shape, channels
        )
    return halved


def _color_chain(finest: NDArray[np.uint8]) -> Levels:
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halve_srgb(_even(levels[-1])))
    return levels


def _halve_linear(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width, channels = texels.shape
    blocks = texels.reshape(height // 2, 2, width // 2, 2, channels)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _linear_color_levels(texels: NDArray[np.uint8]) -> Levels:
    decoded = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    finest = _with_alpha(texels, 255)
    levels = [decoded.astype(np.float16)[finest]]
    halved = [_halve_linear(decoded[strip]) for _, strip in _strips(_even(finest))]
    means = np.concatenate(halved)
    while max(levels[-1].shape[:2]) > 1:
        levels.append(means.astype(np.float16))
        means = _halve_linear(_even(means))
    return levels


def _strips(rows: NDArray[Any]) -> list[tuple[int, NDArray[Any]]]:
    """Return strips of rows that fit in the CPU cache, each with the index of its first row."""
    return [(top, rows[top : top + _STRIP]) for top in range(0, len(rows), _STRIP)]


def _halve_planes(planes: NDArray[Any]) -> NDArray[np.float32]:
    """Return the means of 2 x 2 blocks of planes (C, H, W) with even sides."""
    rows = planes[:, 0::2] + planes[:, 1::2]
    blocks = rows[..., 0::2] + rows[..., 1::2]
    blocks *= np.float32(0.25)
    return np.asarray(blocks)


def _unit_planes(texels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return texels of a normal map as unit vectors (3, H, W)."""
    planes = np.moveaxis(texels, -1, 0).astype(np.float32, order="C")
    planes -= np.float32(127.5)  # no byte becomes 0, so no vector has length 0
    planes *= 1.0 / np.sqrt(planes[0] ** 2 + planes[1] ** 2 + planes[2] ** 2)
    return planes


def _with_deviation(means: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the texels (H, W, 4) of a normal map's mip level from its mean normals (3, H, W). RGB
    is the direction of the mean, alpha is the slope deviation."""
    length = np.sqrt(means[0] ** 2 + means[1] ** 2 + means[2] ** 2).clip(1e-6, 1.0)
    texels = np.empty((*length.shape, 4), dtype=np.uint8)
    scale = np.float32(127.5) / length
    for channel, plane in enumerate(means):
        texels[..., channel] = plane * scale + np.float32(128.0)  # truncated to uint8
    deviation = np.sqrt((1.0 - length) / length)
    texels[..., 3] = np.minimum(deviation * np.float32(255.0 / MAP_DEVIATION), 255.0) + 0.5
    return texels


def _even_planes(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.moveaxis(_even(np.moveaxis(planes, 0, -1)), -1, 0)


def _normal_levels(texels: NDArray[np.uint8]) -> Levels:
    finest = _with_alpha(texels, 0)
    if max(texels.shape[:2]) == 1:
        return [finest]
    even = _even(texels)
    means = np.empty((3, even.shape[0] // 2, even.shape[1] // 2), dtype=np.float32)
    for top, strip in _strips(even):
        means[:, top // 2 : (top + len(strip)) // 2] = _halve_planes(_unit_planes(strip))
    return [finest, *_normal_chain(means)]


def _normal_chain(means: NDArray[np.float32]) -> Levels:
    levels = []
    while True:
        strips = _strips(np.moveaxis(means, 0, -1))
        texels = [_with_deviation(np.moveaxis(strip, -1, 0)) for _, strip in strips]
        levels.append(np.concatenate(texels))
        if max(means.shape[1:]) == 1:
            return levels
        means = _halve_planes(_even_planes(means))


# Functions that return all mip levels of texels (H, W, 3) with row 0 at the bottom. See
# Texture.levels for the kinds.
CHAIN: dict[Kind, Callable[[NDArray[np.uint8]], Levels]] = {
    "color": lambda texels: _color_chain(_with_alpha(texels, 255)),
    "linear-color": _linear_color_levels,
    "normal": _normal_levels,
    "data": _data_chain,
}
