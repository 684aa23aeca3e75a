"""How far one linear image is from another: the point gate sees a few wrong pixels and lets shifted
edges pass, the block gate sees a lobe or a weight that changed. No OpenGL here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLOCK = 16


def point_error(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return the largest excess of a pixel over the 3 x 3 neighbourhood in the other image, either
    way; a and b are (H, W, 3)."""
    from scipy import ndimage

    window = (3, 3, 1)
    high_a, low_a = ndimage.maximum_filter(a, window), ndimage.minimum_filter(a, window)
    high_b, low_b = ndimage.maximum_filter(b, window), ndimage.minimum_filter(b, window)
    return float(max((b - high_a).max(), (low_a - b).max(), (a - high_b).max(), (low_b - a).max()))


def block_error(
    a: NDArray[np.floating], reference: NDArray[np.floating], coverage: NDArray[np.floating]
) -> float:
    """Return the largest mean signed difference over 16 x 16 blocks, relative to
    max(|reference|, 0.01).

    Parameters
    ----------
    a, reference : (H, W, 3) linear
    coverage : (H, W) in [0, 1]; only pixels at least 3 inside of full coverage count, and blocks
        with at least 64 of them
    """
    from scipy import ndimage

    inside = ndimage.binary_erosion(coverage >= 1.0, iterations=3)
    difference = ((a - reference) / np.maximum(np.abs(reference), 0.01)).mean(axis=-1) * inside
    height, width = (side // BLOCK * BLOCK for side in inside.shape)
    blocks = (height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    total = difference[:height, :width].reshape(blocks).sum(axis=(1, 3))
    count = inside[:height, :width].reshape(blocks).sum(axis=(1, 3))
    filled = count >= 64
    return float(np.abs(total[filled] / count[filled]).max(initial=0.0))
