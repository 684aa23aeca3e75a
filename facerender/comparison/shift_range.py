"""The range of each pixel's value over 24 shifts of the image by at most 0.1 pixel, which a golden
may keep. It explains detail finer than a pixel, which no neighbourhood does. It holds colours of
covered pixels only: a black pixel is no uncovered background.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from facerender.comparison.neighbourhoods import Float, Mask, filtered
from facerender.images.image import ImageData, PixelRange

FARTHEST = 0.1  # pixels
# Pixels to the right and down: circles of several radii, since fine detail comes and goes.
SHIFTS = tuple(
    (round(by * math.cos(0.25 * i * math.pi), 6), round(by * math.sin(0.25 * i * math.pi), 6))
    for by in (FARTHEST, FARTHEST * 2.0 / 3.0, FARTHEST / 3.0)
    for i in range(8)
)
COVERED = 0.5  # coverage from which on a pixel is
_HIGHEST = 65504.0  # of half floats
_RELATIVE = 0.01  # of the level that a value may leave the range by
_ALPHA = 0.01  # likewise of coverage


def range_of(images: Sequence[ImageData]) -> PixelRange:
    """Return the range of linear images of one size: of colours where they are covered."""
    each = []
    for image in images:
        color, alpha = image.rows(slice(None))
        values = np.where(alpha[..., None] >= COVERED, color, np.float32(np.nan))
        if image.pixels.shape[2] > color.shape[2]:
            values = np.concatenate([values, alpha[..., None]], axis=2)
        each.append(values)
    ends = []
    for choose, beyond in ((np.fmin, -np.inf), (np.fmax, np.inf)):
        values = choose.reduce(each).clip(-_HIGHEST, _HIGHEST).astype(np.float16)
        with np.errstate(over="ignore"):
            ends.append(np.nextafter(values, np.float16(beyond)))
    return PixelRange(*ends)


def explained(
    shift_range: PixelRange, color: Float, alpha: Float, least: float
) -> tuple[Mask, Mask]:
    """Return where the range explains colour, and where coverage: (H, W) each. Colours may lie in
    that of 3 x 3 pixels, darker ones too where the background is uncovered.

    Parameters
    ----------
    color, alpha : (H, W, C) and (H, W)
    least : that a colour may leave the range by, beside a hundredth of its level
    """
    low, high = (end.astype(np.float32) for end in shift_range)
    channels = color.shape[2]
    coverage = np.ones(alpha.shape, dtype=bool)
    if low.shape[2] > channels:
        coverage = (alpha >= low[..., -1] - _ALPHA) & (alpha <= high[..., -1] + _ALPHA)
    bare = alpha < COVERED
    within = coverage.copy()
    for channel in range(channels):
        value = color[..., channel]
        allowed = np.float32(least) + np.float32(_RELATIVE) * np.abs(value)
        within &= bare | (value >= filtered(low[..., channel], np.fmin) - allowed)
        within &= value <= filtered(high[..., channel], np.fmax) + allowed  # False where NaN
    return within, coverage
