"""Point and block gate between two linear images (H, W, 3), as far as the tests need them: P sees a
few wrong pixels and lets shifted edges pass, B sees a lobe or a weight that changed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float32]


def point(a: Image, b: Image) -> float:
    """Largest excess of a pixel over the 3 x 3 neighbourhood in the other image, either way."""
    window = (3, 3, 1)
    high_a, low_a = ndimage.maximum_filter(a, window), ndimage.minimum_filter(a, window)
    high_b, low_b = ndimage.maximum_filter(b, window), ndimage.minimum_filter(b, window)
    return float(max((b - high_a).max(), (low_a - b).max(), (a - high_b).max(), (low_b - a).max()))


def block(a: Image, reference: Image, coverage: NDArray[np.float32]) -> float:
    """Largest mean signed difference over 16 x 16 blocks, at least 3 pixels inside the coverage,
    relative to max(|reference|, 0.01)."""
    inside = ndimage.binary_erosion(coverage >= 1.0, iterations=3)
    difference = ((a - reference) / np.maximum(np.abs(reference), 0.01)).mean(axis=-1) * inside
    height, width = (side // 16 * 16 for side in inside.shape)
    blocks = (height // 16, 16, width // 16, 16)
    total = difference[:height, :width].reshape(blocks).sum(axis=(1, 3))
    count = inside[:height, :width].reshape(blocks).sum(axis=(1, 3))
    filled = count >= 64
    return float(np.abs(total[filled] / count[filled]).max())
