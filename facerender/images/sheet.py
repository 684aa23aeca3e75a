"""Layout of 8-bit images of one size in a grid with titles, for sheets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped
from facerender.images.decode import check_pixels

MOST_COLUMNS = 4  # default largest number of images in a row
_BYTES = 24  # per pixel: 8-bit RGB, and float32 RGBA of a Frame
_TEXT = 11, 32  # smallest and largest size of the font, in pixels
_PAPER, _INK = (255, 255, 255), (20, 20, 20)


def arranged(
    images: Sequence[NDArray[np.uint8]],
    titles: Sequence[str] = (),
    columns: int | None = None,
) -> NDArray[np.uint8]:
    """Return one image (H, W, 3) with ``images`` in rows, on white.

    Parameters
    ----------
    images : (h, w, 3) each, of one size
    titles : one text above each image; default: no titles
    columns : number of images in a row; default: all, at most :data:`MOST_COLUMNS`

    Raises
    ------
    InputError : the sheet is too large
    """
    columns = columns or min(len(images), MOST_COLUMNS)
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    gap = max(width // 64, 2)
    size = min(max(width // 20, _TEXT[0]), _TEXT[1])
    band = round(1.5 * size) if any(titles) else 0
    across, down = width + gap, band + height + gap
    sheet_size = columns * across + gap, rows * down + gap
    check_pixels(f"a sheet of {len(images)} images", *sheet_size, _BYTES, math.inf)
    pixels = np.full((*sheet_size[::-1], 3), _PAPER, dtype=np.uint8)
    for number, image in enumerate(images):
        top, left = gap + number // columns * down, gap + number % columns * across
        if band and titles[number]:
            pixels[top : top + band, left : left + width] = _text(titles[number], size, width, band)
        pixels[top + band : top + band + height, left : left + width] = image
    return pixels


def _text(title: str, size: int, width: int, height: int) -> NDArray[np.uint8]:
    """Return one line of text (height, width, 3), in a smaller font if the line is too long."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.new("RGB", (width, height), _PAPER)
    draw, line = ImageDraw.Draw(image), clipped(title)
    long = draw.textlength(line, ImageFont.load_default(size))
    font = ImageFont.load_default(max(min(size * width / max(long, 1.0), size), _TEXT[0]))
    draw.text((0, height // 2), line, _INK, font, "lm")
    return np.asarray(image)
