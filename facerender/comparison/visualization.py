"""Images for the report: images in 8-bit sRGB, their difference in false colours, and a heat map.

Each image has the shape (H, W, 3). Linear radiance 1 is white, the background is black, and pixels
that are not finite are magenta.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import flip
from facerender.errors import InputError
from facerender.images.image import Encoding, ImageData
from facerender.images.srgb import encode_srgb8
from facerender.images.write import save_png

if TYPE_CHECKING:
    from facerender.comparison.compare import Pair

MAX_PIXELS = 1 << 24  # largest number of pixels of an image that is displayed
HEAT = 1 << 17  # largest number of pixels of a page's heat map; FLIP takes 1.3 s for 2**20
LEVELS = 32  # number of colours of a difference, for each sign
DARKER, BRIGHTER, UNCOVERED = (74, 163, 255), (255, 148, 41), (190, 70, 255)
# Differences up to which the colour scale is linear.
FLOORS: dict[Encoding, float] = {"linear": 1e-3, "srgb8": 1.0}

_STRIP = 256  # rows that are converted at once

Bytes = NDArray[np.uint8]


def displayed(image: ImageData) -> Bytes:
    """Return an image as 8-bit sRGB."""
    pixels = np.empty((*image.pixels.shape[:2], 3), dtype=np.uint8)
    for rows in strips(image):
        color, _ = image.rows(rows)
        linear = image.encoding == "linear"
        pixels[rows] = encode_srgb8(color) if linear else np.round(color)
        if linear:
            pixels[rows][~np.isfinite(image.pixels[rows]).all(axis=-1)] = (255, 0, 255)
    return pixels


def thumbnail(image: ImageData, side: int) -> Bytes:
    """Return an image as 8-bit sRGB, scaled to at most ``side`` pixels in width and height."""
    from PIL import Image

    height, width = image.pixels.shape[:2]
    step = max(math.isqrt(height * width // MAX_PIXELS), 1)
    small = Image.fromarray(displayed(replace(image, pixels=image.pixels[::step, ::step])))
    small.thumbnail((side, side))
    return np.asarray(small)


def difference(a: ImageData, b: ImageData) -> tuple[Bytes, float]:
    """Return the signed difference in the worst channel as colours, and the largest difference.

    The colour scale is linear below a value of FLOORS and logarithmic above it. The largest
    difference has the full colour.
    """
    floor = FLOORS[a.encoding]
    signed = signed_difference(a, b)
    largest = float(np.abs(signed).max())
    scale = max(largest, floor)
    ramp = np.linspace(0.0, 1.0, LEVELS + 1)[:, None]
    colors = np.round([ramp * DARKER, ramp * BRIGHTER]).astype(np.uint8)
    pixels = np.empty((*signed.shape, 3), dtype=np.uint8)
    for rows in strips(a):
        level = np.log1p(np.abs(signed[rows]) / floor) / np.log1p(scale / floor)
        level = np.round(level * LEVELS).astype(int)
        pixels[rows] = colors[(signed[rows] > 0.0).astype(int), level]
        pixels[rows][other_coverage(a, b, rows) & (level == 0)] = UNCOVERED
    return pixels, largest


def signed_difference(a: ImageData, b: ImageData) -> NDArray[np.float32]:
    """Return b - a in the channel that differs most, (H, W)."""

    def worst_of(rows: slice) -> NDArray[np.float32]:
        signed = b.rows(rows)[0] - a.rows(rows)[0]
        worst = np.abs(signed).argmax(axis=-1)[..., None]
        return np.asarray(np.take_along_axis(signed, worst, axis=-1)[..., 0])

    return np.concatenate([worst_of(rows) for rows in strips(a)])


def other_coverage(a: ImageData, b: ImageData, rows: slice) -> NDArray[np.bool_]:
    """Return a mask of the pixels of some rows that only one of two images covers."""
    covered_a, covered_b = (image.rows(rows)[1] >= 0.5 for image in (a, b))
    return np.asarray(covered_a != covered_b)


def strips(image: ImageData) -> Iterator[slice]:
    """Yield the rows of an image in strips, to save memory."""
    for top in range(0, len(image.pixels), _STRIP):
        yield slice(top, top + _STRIP)


def small_heat_map(a: Bytes, b: Bytes) -> Bytes:
    """Return a FLIP heat map of two displayed images, reduced to at most HEAT pixels.

    Each cell of pixels is reduced to the pixel that differs most, so that no firefly is lost.
    Raise InputError if flip-evaluator is missing.
    """
    step = _step(a, HEAT)
    differences = np.maximum(a, b) - np.minimum(a, b)
    worst_a, worst_b = _worst(differences.sum(axis=-1, dtype=np.uint16), step, a, b)
    return flip.heat_map(worst_a / 255.0, worst_b / 255.0, step)


def brightest(pixels: Bytes, most: int) -> Bytes:
    """Reduce an image to at most ``most`` pixels: to the brightest pixel of each cell of pixels."""
    return _worst(pixels.max(axis=-1), _step(pixels, most), pixels)[0]


def _step(pixels: Bytes, most: int) -> int:
    """Return the width of the cells, so that an image has at most ``most`` cells."""
    return math.ceil(math.sqrt(pixels[..., 0].size / most))


def _worst(key: NDArray[Any], step: int, *images: Bytes) -> list[Bytes]:
    """Return images (H, W, 3), reduced to the pixel with the largest key (H, W) of each cell."""
    if step == 1:
        return [*images]
    height, width = (-(-side // step) for side in key.shape)
    padding = [(0, height * step - key.shape[0]), (0, width * step - key.shape[1])]

    def cells(pixels: NDArray[Any]) -> NDArray[Any]:
        pad_width = [*padding, *((0, 0) for _ in pixels.shape[2:])]
        padded = np.pad(pixels, pad_width, "edge")
        split = padded.reshape(height, step, width, step, *pixels.shape[2:]).swapaxes(1, 2)
        return split.reshape(height, width, step * step, *pixels.shape[2:])

    indices = cells(key).argmax(axis=-1)[..., None, None]
    return [np.take_along_axis(cells(image), indices, axis=2)[:, :, 0] for image in images]


def save_heat_map(path: str | os.PathLike[str], pair: Pair) -> None:
    """Write the FLIP heat map of a pair as PNG.

    Raises
    ------
    InputError : flip-evaluator is missing, an image could not be read, the sizes differ or exceed
        MAX_PIXELS, or the file cannot be written
    """
    a, b = pair.reference, pair.image
    if a is None or b is None or a.pixels.shape[:2] != b.pixels.shape[:2]:
        raise InputError(f"no heat map: {pair.error}")
    height, width = a.pixels.shape[:2]
    if height * width > MAX_PIXELS:
        raise InputError(
            f"no heat map of {width} x {height} pixels: at most {MAX_PIXELS}; give smaller images"
        )
    save_png(path, flip.heat_map(displayed(a) / 255.0, displayed(b) / 255.0), {})


def lossless(pixels: Bytes) -> tuple[bytes, str]:
    """Return pixels as a lossless file, and its format: WebP, or PNG if a side is too long."""
    from PIL import Image

    kind = "webp" if max(pixels.shape) <= 16383 else "png"
    options = {"lossless": True, "method": 1, "quality": 0} if kind == "webp" else {}
    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue(), kind
