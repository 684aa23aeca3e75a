"""Mip chains of maps, with an averaging method for each kind of map. Maps are reduced in strips of
rows, which gives the same result as reducing the whole map."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.images.image import linear_to_srgb, srgb_to_linear
from facerender.terms.model import MAP_DEVIATION

Kind = Literal["color", "linear-color", "normal", "data"]
Levels = list[NDArray[Any]]
Strips = Iterable[NDArray[np.uint8]]

STRIP = 32  # number of rows that are reduced at once: they fit in the CPU cache


def mip_chain(mip_kind: Kind, strips: Strips, height: int, drop: int) -> Levels:
    """Return the mip levels of an image, down to one texel. See ``Texture.levels`` for the kinds;
    :func:`data_chain` returns the levels of kind "data".

    strips : rows of the image from the bottom; all strips but the last one contain an even number
        of rows of the mip level ``drop``
    height : number of rows of the finest level
    drop : number of finest levels to omit
    """
    decode, halve, encode = _METHODS[mip_kind]
    low = 0
    for texels in strips:
        means = decode(as_rgb(texels))
        for _ in range(drop):
            means = halve(means)
        # The full normal map keeps its bytes: encode() would change the length of the vectors.
        level = _with_alpha(texels, 0) if mip_kind == "normal" and not drop else encode(means)
        half = halve(means)
        if not low:  # arrays of this size leave no holes in the heap, as a list of strips would
            finest = np.empty((height, *level.shape[1:]), level.dtype)
            halves = np.empty((-(-height // 2), *half.shape[1:]), half.dtype)
        finest[low : low + len(level)] = level
        halves[low // 2 : low // 2 + len(half)] = half
        low += len(level)
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        halves = halves[: max(len(levels[-1]) // 2, 1)]  # without the half of a last odd row
        strips = [halves[top : top + STRIP] for top in range(0, len(halves), STRIP)]
        levels.append(np.concatenate([*map(encode, strips)]))
        halves = np.concatenate([*map(halve, strips)])
    return levels


def data_chain(finest: NDArray[np.uint8]) -> Levels:
    """Return the mip levels of kind "data" from the finest level, (H, W, 3)."""
    levels = [finest]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1], 1))
    return levels


def reduced_data(strips: Strips, drop: int) -> NDArray[np.uint8]:
    """Return the finest level of kind "data", (H, W, 3), or (H, W) for grey strips. Pillow may
    round a value to another 8-bit level than the level ``drop`` of :func:`data_chain`."""
    return np.concatenate([_halved(strip, drop) for strip in strips])


def _halved(texels: NDArray[np.uint8], times: int) -> NDArray[np.uint8]:
    from PIL import Image

    image = Image.fromarray(texels)
    for _ in range(times):
        half = max(image.width // 2, 1), max(image.height // 2, 1)
        image = image.resize(half, Image.Resampling.BOX)
    return np.asarray(image)


def as_rgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return texels (H, W, 3) of grey texels (H, W), and other texels as they are."""
    return np.repeat(texels[..., None], 3, axis=2) if texels.ndim == 2 else texels


def _with_alpha(texels: NDArray[np.uint8], alpha: int) -> NDArray[np.uint8]:
    """Return a copy (H, W, 4) of texels with a constant alpha."""
    copy = np.empty((*texels.shape[:2], 4), dtype=np.uint8)
    copy[..., :3], copy[..., 3] = as_rgb(texels), alpha
    return copy


def _even(texels: NDArray[Any], columns: int = 1) -> NDArray[Any]:
    """Make the numbers of rows and of columns, which lie along an axis, even: double a side of 1;
    any other odd side loses its last texels."""
    for axis in (0, columns):
        if texels.shape[axis] == 1:
            texels = np.repeat(texels, 2, axis)
        elif texels.shape[axis] % 2:
            texels = texels.take(range(texels.shape[axis] - 1), axis)
    return texels


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
    # Adds four 16-bit channels as one uint64. Each sum fits in 16 bits, so there is no carry.
    light = decode[_even(texels)].view(np.uint64)[..., 0]
    rows = light[0::2] + light[1::2]
    blocks = rows[:, 0::2] + rows[:, 1::2]
    return np.asarray(encode[blocks.view(np.uint16)].reshape(*blocks.shape, 4))


def _linear(texels: NDArray[np.uint8]) -> NDArray[np.float32]:
    decode = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    return np.asarray(decode[_with_alpha(texels, 255)])


def _halve_linear(texels: NDArray[np.float32]) -> NDArray[np.float32]:
    even = _even(texels)
    blocks = even.reshape(len(even) // 2, 2, even.shape[1] // 2, 2, 4)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _unit_vectors(texels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return texels of a normal map as unit vectors (H, 3, W)."""
    vectors = np.moveaxis(texels, -1, 1).astype(np.float32, order="C")
    vectors -= np.float32(127.5)  # no byte becomes 0, so no vector has length 0
    vectors *= 1.0 / _length(vectors)[:, None]
    return vectors


def _length(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2))


def _halve_vectors(means: NDArray[np.float32]) -> NDArray[np.float32]:
    even = _even(means, columns=2)
    rows = even[0::2] + even[1::2]
    blocks = rows[..., 0::2] + rows[..., 1::2]
    blocks *= np.float32(0.25)
    return np.asarray(blocks)


def _with_deviation(means: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the texels (H, W, 4) of a normal map's mip level from its mean normals (H, 3, W). RGB
    is the direction of the mean, alpha is the slope deviation."""
    length = _length(means).clip(1e-6, 1.0)
    texels = np.empty((*length.shape, 4), dtype=np.uint8)
    scale = np.float32(127.5) / length
    for axis in range(3):
        texels[..., axis] = means[:, axis] * scale + np.float32(128.0)  # truncated to uint8
    deviation = np.sqrt((1.0 - length) / length)
    texels[..., 3] = np.minimum(deviation * np.float32(255.0 / MAP_DEVIATION), 255.0) + 0.5
    return texels


# Keyed by kind: functions that decode a strip of texels (H, W, 3), halve what was decoded, and
# encode it as texels of a mip level.
_METHODS: dict[Kind, tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]] = {
    "color": (lambda texels: _with_alpha(texels, 255), _halve_srgb, lambda texels: texels),
    "linear-color": (_linear, _halve_linear, lambda light: light.astype(np.float16)),
    "normal": (_unit_vectors, _halve_vectors, _with_deviation),
}
