"""Images to look at: what an image shows, how two of them differ, a heat map. The page that shows
them is in ``report.py``.

Each is (H, W, 3) of 8-bit sRGB, linear radiance 1 being white, over black where the coverage ends;
values that are not finite are magenta.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import flip
from facerender.comparison.pairs import Pair
from facerender.errors import InputError
from facerender.image import Encoding, Picture, encode_srgb8, save_png

MOST_SHOWN = 1 << 24  # pixels: what shows more is no page to look at
LEVELS = 32  # of the difference, either way
DARKER, BRIGHTER, UNCOVERED = (74, 163, 255), (255, 148, 41), (190, 70, 255)
NOT_FINITE = (255, 0, 255)
FLOORS: dict[Encoding, float] = {"linear": 1e-3, "srgb8": 1.0}  # of the difference's scale

Bytes = NDArray[np.uint8]


def shown(picture: Picture) -> Bytes:
    """Return what an image shows."""
    linear, color = picture.encoding == "linear", picture.color
    pixels = encode_srgb8(color) if linear else np.round(color).astype(np.uint8)
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=-1)
    pixels[~np.isfinite(picture.pixels).all(axis=-1)] = NOT_FINITE
    return pixels


def thumbnail(picture: Picture, side: int) -> Bytes:
    """Return what an image shows, no side longer than so many pixels."""
    from PIL import Image

    height, width = picture.pixels.shape[:2]
    step = max(math.isqrt(height * width // MOST_SHOWN), 1)
    image = Image.fromarray(shown(replace(picture, pixels=picture.pixels[::step, ::step])))
    image.thumbnail((side, side))
    return np.asarray(image)


def difference(a: Picture, b: Picture) -> tuple[Bytes, float]:
    """Return the signed difference in the worst channel, linear below the floor and logarithmic
    above; and the largest difference, which has the full colour."""
    floor = FLOORS[a.encoding]
    signed = np.subtract(b.color, a.color, dtype=np.float64)
    worst = np.abs(signed).argmax(axis=-1)[..., None]
    signed = np.take_along_axis(signed, worst, axis=-1)[..., 0]
    largest = max(float(np.abs(signed).max()), floor)
    level = np.log1p(np.abs(signed) / floor) / np.log1p(largest / floor)
    level = np.round(level * LEVELS).astype(int)
    ramp = np.linspace(0.0, 1.0, LEVELS + 1)[:, None]
    colors = np.round([ramp * DARKER, ramp * BRIGHTER]).astype(np.uint8)
    pixels = colors[(signed > 0.0).astype(int), level]
    pixels[((a.coverage >= 0.5) != (b.coverage >= 0.5)) & (level == 0)] = UNCOVERED
    return pixels, largest


def heat_map(a: Picture, b: Picture) -> Bytes:
    """Return FLIP of two images of one size.

    Raises
    ------
    InputError : flip-evaluator is missing, or the images have more than MOST_SHOWN pixels
    """
    height, width = a.pixels.shape[:2]
    if height * width > MOST_SHOWN:
        raise InputError(
            f"no heat map of {width} x {height} pixels: at most {MOST_SHOWN}; give smaller images"
        )
    return flip.heat_map(shown(a) / 255.0, shown(b) / 255.0)


def save_heat_map(path: str | os.PathLike[str], pair: Pair) -> None:
    """Write the heat map of a pair as PNG.

    Raises
    ------
    InputError : flip-evaluator is missing, an image could not be read, the sizes differ, or the
        file is no .png or cannot be written
    """
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"the heat map {path}: give a .png")
    a, b = pair.reference, pair.image
    if a is None or b is None or a.pixels.shape[:2] != b.pixels.shape[:2]:
        raise InputError(f"no heat map: {pair.error}")
    save_png(path, heat_map(a, b), {})


def png(pixels: Bytes) -> bytes:
    """Encode pixels as PNG."""
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()
