"""Layout of 8-bit images of one size in a grid with titles, for sheets."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from facerender.errors import clipped, number_of
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
    bands = [_text(title, width) for title in titles] if any(titles) else []
    band = max(map(len, bands), default=0)
    across, down = width + gap, band + height + gap
    sheet_size = columns * across + gap, rows * down + gap
    check_pixels(f"a sheet of {number_of(len(images), 'image')}", *sheet_size, _BYTES, math.inf)
    pixels = np.full((*sheet_size[::-1], 3), _PAPER, dtype=np.uint8)
    for number, image in enumerate(images):
        top, left = gap + number // columns * down, gap + number % columns * across
        if bands:
            bottom = top + band
            pixels[bottom - len(bands[number]) : bottom, left : left + width] = bands[number]
        pixels[top + band : top + band + height, left : left + width] = image
    return pixels


def _text(title: str, width: int) -> NDArray[np.uint8]:
    """Return a title (H, W, 3); a long one has a smaller font and, if needed, several lines."""
    from PIL import Image, ImageDraw, ImageFont

    size, line = min(max(width // 20, _TEXT[0]), _TEXT[1]), clipped(title)
    long = max(ImageFont.load_default(size).getlength(line), 1.0)
    font = ImageFont.load_default(max(min(size * width / long, size), _TEXT[0]))
    excess = font.getlength(line) / width
    lines = textwrap.wrap(line, max(int(0.9 * len(line) / excess), 1)) if excess > 1.0 else [line]
    step = round(1.5 * size)
    image = Image.new("RGB", (width, step * len(lines)), _PAPER)
    draw = ImageDraw.Draw(image)
    for number, text in enumerate(lines):
        draw.text((0, number * step + step // 2), text, _INK, font, "lm")
    return np.asarray(image)
