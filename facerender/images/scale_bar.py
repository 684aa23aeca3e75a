"""Scale bars of images whose pixels have a known size."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SMALLEST = 11  # size of the font, in pixels


def draw_scale_bar(pixels: NDArray[Any], mm_per_pixel: float) -> None:
    """Draw a scale bar and its length in the lower right corner of an image, in place.

    The length is 1, 2 or 5 x 10^k mm, and at most a quarter of the image's width. Bar and text are
    black on bright or transparent pixels and white on dark pixels, with an outline of the other.

    pixels : (H, W, 3), or (H, W, 4) with straight alpha; uint8 or uint16
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = pixels.shape[:2]
    longest = 0.25 * width * mm_per_pixel * (1.0 + 1e-9)
    power = 10.0 ** math.floor(math.log10(longest))
    length = power * max(digit for digit in (1, 2, 5) if digit * power <= longest)
    across = max(round(length / mm_per_pixel), 1)
    size = max(min(width, height) // 32, _SMALLEST)
    outline, thickness = max(size // 12, 1), max(size // 6, 2)
    font, label = ImageFont.load_default(size), f"{length:g} mm"
    wider = math.ceil(max(across, font.getlength(label)))
    box_width, box_height = min(wider + 2 * size, width), min(3 * size, height)
    left = max(box_width - size - (wider + across) // 2, 0)
    bottom = max(box_height - size, min(box_height, thickness))
    masks = []
    for margin in (outline, 0):
        image = Image.new("L", (box_width, box_height))
        draw = ImageDraw.Draw(image)
        ends = left - margin, bottom - thickness - margin
        draw.rectangle((*ends, left + across + margin - 1, bottom + margin - 1), 255)
        above = left + across / 2.0, bottom - 2 * thickness
        draw.text(above, label, 255, font, "ms", stroke_width=margin)
        masks.append(np.asarray(image, dtype=np.float32)[..., None] / np.float32(255.0))
    box, white = pixels[-box_height:, -box_width:], np.iinfo(pixels.dtype).max
    behind = box[..., :3].mean(axis=-1) + (white - box[..., 3:]).sum(axis=-1)
    bright = np.average(behind, weights=masks[0][..., 0]) > 0.5 * white
    color = np.full(pixels.shape[-1], white, dtype=np.float32)  # alpha, if any, remains white
    for mask, is_white in zip(masks, (bright, not bright), strict=True):
        color[:3] = white * is_white
        box[:] = np.round(box + (color - box) * mask)
