"""The point check: detect pixels that their neighbourhood in the other image does not explain.

A value is explained if it lies within the range of the 3 x 3 neighbourhood in the other image. This
range is widened by half the range of the 5 x 5 neighbourhood: a shift by a fraction of a pixel or
another sample pattern may change an edge by this amount. In linear images the range is also widened
by 1 % of the neighbourhood's maximum. On smooth skin the ranges are narrow, so small differences
are detected, also in dark areas. The lower end of a range includes covered neighbours only, since a
black background would explain any dark value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.images.image import Encoding

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]

_HALO = 4  # pixels around a window that the neighbourhoods of the window's pixels read
_CONTRAST = 0.5  # a range is widened by this fraction of the range of 5 x 5 pixels
_RELATIVE = 0.01  # a range is widened by this fraction of the level
COVERED = 0.5  # smallest coverage of a covered pixel
FULL = 0.99  # least coverage of a pixel inside the mesh: half floats and filters do not reach 1
MARGIN = 2  # width in pixels of the coverage's border, which statistics of areas ignore
_STEP = 0.2  # smallest range of 5 x 5 pixels at an edge, as a fraction of their maximum


@dataclass(frozen=True)
class Slack:
    """Largest difference that thin slivers of light and shade may add to a pixel."""

    # if 5 x 5 pixels have a range of 1/10 to 1/5 of their maximum; proportionally less below
    rough: float
    edge: float  # if 5 x 5 pixels have a range of at least 1/5 of their maximum


SLIVERS: dict[Encoding, Slack] = {"linear": Slack(0.1, 0.28), "srgb8": Slack(52.0, 53.0)}
# Classes of the pixels that exceed the point limit: a possible sliver; others in a smooth area, in
# texture, and at an edge.
SLIVER, SMOOTH, ROUGH, EDGE = 1, 2, 3, 4


class Excess(NamedTuple):
    """Unexplained differences of the pixels, (H, W)."""

    value: NDArray[np.float32]  # of the worst channel; negative where the image is darker
    slack: NDArray[np.float32]  # part of ``value`` that slivers may cause


def excess(a: Float, b: Float, full: Mask | None, least: float, relative: bool) -> Excess:
    """Return how far each pixel leaves the range of its neighbourhood in the other image.

    Parameters
    ----------
    a, b : (H, W, C)
    full : (H, W), pixels that both images cover fully; None: all
    least : smallest difference of interest; areas with smaller differences get 0
    relative : whether the images are linear; otherwise the images contain 8-bit levels
    """
    value, slack = np.zeros((2, *a.shape[:2]), dtype=np.float32)
    # An unexplained difference is at most the plain difference, which is fast to compute.
    different = difference(a, b) > least
    if different.any():
        sides = (np.flatnonzero(different.any(axis=axis)) for axis in (1, 0))
        window = tuple(slice(max(side[0] - _HALO, 0), side[-1] + 1 + _HALO) for side in sides)
        covered = None if full is None or full[window].all() else full[window]
        value[window], slack[window] = _excess(a[window], b[window], covered, relative)
    return Excess(value, slack)


def holes(a: Float, b: Float, full: Mask | None, relative: bool) -> Mask:
    """Return a mask of the pixels whose radiance is below a quarter of the radiance of every
    covered pixel in the 7 x 7 neighbourhood of the other image; parameters as in :func:`excess`."""
    fraction, floor = (0.25, 5e-4) if relative else (0.5, 1.0)  # sRGB encodes 1/4 as about 1/2
    mask = np.zeros(a.shape[:2], dtype=bool)
    levels = [
        np.maximum.reduce([x[..., i] for i in range(x.shape[2])]).clip(np.float32(0.0))
        for x in (a, b)
    ]
    for x, y in (levels, levels[::-1]):
        candidates = y < fraction * x - floor
        if full is not None:
            candidates &= full
        places = np.argwhere(candidates)
        if not places.size:
            continue
        covered = x if full is None else np.where(full, x, np.inf)
        padded = np.pad(covered, 3, constant_values=np.inf)
        low = np.minimum.reduce(
            [padded[tuple((places + (i, j)).T)] for i in range(7) for j in range(7)]
        )
        rows, columns = places[y[candidates] < fraction * low - floor].T
        mask[rows, columns] = True
    return mask


def gaps(a: Float, b: Float) -> Mask:
    """Return a mask of the pixels that only one of two coverages (H, W) leaves uncovered, although
    the other one covers their 7 x 7 neighbourhood completely."""
    mask = np.zeros(a.shape, dtype=bool)
    for x, y in ((a, b), (b, a)):
        inside, bare = x >= FULL, y < COVERED
        if (inside & bare).any():
            mask |= shrunk(inside, 3) & bare
    return mask


def difference(a: Float, b: Float) -> NDArray[np.float32]:
    """Return the largest absolute difference of any channel, (H, W)."""
    largest = np.zeros(a.shape[:2], dtype=np.float32)
    for channel in range(a.shape[2]):  # NumPy is slow along a short last axis
        np.maximum(largest, np.abs(b[..., channel] - a[..., channel]), out=largest)
    return largest


def filtered(x: NDArray[Any], choose: Callable[..., Any]) -> NDArray[Any]:
    """Apply np.maximum, np.minimum or a similar function over 3 x 3 pixels, fewer at the border."""
    for axis in (0, 1):
        y = np.moveaxis(x, axis, 0)
        x = x.copy()
        z = np.moveaxis(x, axis, 0)
        choose(z[1:], y[:-1], out=z[1:])
        choose(z[:-1], y[1:], out=z[:-1])
    return x


def shrunk(mask: Mask, pixels: int) -> Mask:
    """Return a mask without the pixels that are at most `pixels` rows and columns from its edge."""
    for _ in range(pixels):
        mask = filtered(mask, np.minimum)
    return mask


def _excess(a: Float, b: Float, full: Mask | None, relative: bool) -> Excess:
    worst, slack = np.zeros((2, *a.shape[:2]), dtype=np.float32)

    def take(distance: Float, sign: float, sliver: Float) -> None:
        larger = distance > np.abs(worst)  # False where NaN
        np.copyto(worst, sign * distance, where=larger)
        np.copyto(slack, sliver, where=larger)

    for channel in range(a.shape[2]):
        images = [np.ascontiguousarray(image[..., channel]) for image in (a, b)]
        for sign, (x, y) in ((1.0, images), (-1.0, images[::-1])):
            low, high, allowed, sliver = _range(x, np.minimum, np.maximum, relative)
            take(y - high - allowed, sign, sliver)
            if full is not None:
                x, y = (np.where(full, image, np.float32(np.nan)) for image in (x, y))
                low, _, allowed, sliver = _range(x, np.fmin, np.fmax, relative)
            take(low - y - allowed, -sign, sliver)
    return Excess(worst, slack)


def _range(
    x: Float, minimum: Callable[..., Any], maximum: Callable[..., Any], relative: bool
) -> tuple[Float, Float, Float, Float]:
    """Return the minimum of 3 x 3 pixels, their maximum, the amount by which this range is widened,
    and the difference that a sliver may add."""
    low, high = filtered(x, minimum), filtered(x, maximum)
    top = filtered(high, maximum)
    span = top - filtered(low, minimum)
    allowed = np.float32(_CONTRAST) * span
    if relative:
        allowed += np.float32(_RELATIVE) * np.abs(top)
    slack = SLIVERS["linear" if relative else "srgb8"]
    steepness = span / np.maximum(np.abs(top), np.float32(1e-6))
    sliver = np.float32(slack.rough) * np.minimum(steepness / np.float32(0.5 * _STEP), 1.0)
    sliver[steepness >= _STEP] = slack.edge
    return low, high, allowed, sliver
