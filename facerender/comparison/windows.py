"""Two checks of a comparison: statistics of pixel blocks, which reveal small changes of lobe,
weight or exposure, and pixels that their neighbourhood in the other image does not explain.

The change of a block is the mean change of its 16 x 16 pixels; pixels in smooth areas weigh more
than pixels at edges and in texture. The effect of a displacement of the whole image is subtracted.
The change's standard error is estimated from the scatter of the block's cells of 4 x 4 pixels, and
from the grain of the difference image. Drivers, cameras and codecs change neighbouring blocks at
random. A changed lobe or weight changes neighbouring blocks alike. The trend is the mean product of
the changes of two neighbouring blocks, in units of the blocks' standard errors. The trend is the
statistic of Moran (1950) without the denominator.

A value is explained if it lies within the range of the 3 x 3 neighbourhood in the other image. This
range is widened by half the range of the 5 x 5 neighbourhood: a shift by a fraction of a pixel or
another sample pattern may change an edge by this amount. In linear images the range is also widened
by 1 % of the neighbourhood's maximum. On smooth skin the ranges are narrow, so small differences
are detected, also in dark areas. The lower end of a range includes covered neighbours only, since a
black background would explain any dark value."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.images.image import Encoding, ImageData

BLOCK, _CELL = 16, 4  # width and height of a block and of a cell, in pixels
LEAST = 48  # smallest number of pixels of a judged block
FLOOR = 0.01  # smallest radiance that relative differences are divided by
MOVED = 0.25  # default limit of the whole image's displacement, in pixels
_WILD = 1e3  # relative steps are clipped to this value, since squares of larger steps may overflow
_SPREAD = 4.0  # blocks are judged if their weight is spread over more cells than this
_FEW = 4  # grain and texture need at least this number of changed blocks
_STEP = 0.01  # squared slope added to all pixels of 8-bit images, so that few pixels give no shift
_DITHER = 0.6  # variance between adjacent pixels of an image dithered with noise of half a step
# Noise between two linear images of one driver. Measured on skin: single channels have at most 0.08
# of the noise that all channels share if a parameter changed, at least 0.22 with another driver.
_OWN = 0.2  # largest ratio of these two kinds of noise, if the image is coloured
_TINT = 0.1  # smallest relative difference between the channels of a coloured image
_STILL = 2e-5  # smaller noise of single channels, and 1/4 of their common noise, is no driver's
_SMOOTH = 0.25  # variance between adjacent pixels below which an 8-bit image has no detail
_CLIPPED = 10.0  # a block's change is clipped to this number of standard errors


@dataclass(frozen=True)
class Scale:
    """Constants of an encoding. Linear: fractions of a pixel's level; sRGB: 8-bit levels."""

    noise: float  # expected noise of a pixel in flat areas
    slope: float  # fraction of the step to a neighbour that is noise, since edges move a little
    edge: float  # a pixel counts if all steps around the pixel are smaller than this value
    flat: float  # the grain uses a pixel if all steps around the pixel are smaller than this value
    error: float  # smallest standard error of a block's change
    grain: float  # standard error of a block's mean per unit of the grain
    drift: float  # change of a block's mean if another driver filters 8-bit textures: 0.3 levels
    # Largest difference that thin slivers of light and shade may add to a pixel: if 5 x 5 pixels
    # have a range of 1/10 to 1/5 of their maximum (proportionally less below), or a larger range
    rough_sliver: float
    edge_sliver: float


LINEAR = Scale(5e-4, 0.1, 0.5, 0.015, 1e-4, 2.0, 2.8e-3, 0.1, 0.28)
SRGB8 = Scale(0.3, 0.1, 50.0, 10.0, 0.01, 0.8, 0.3, 52.0, 53.0)
SCALES: dict[Encoding, Scale] = {"linear": LINEAR, "srgb8": SRGB8}


def cell_sums(values: Float | Mask) -> NDArray[np.float32]:
    """Return the sums over cells of 4 x 4 pixels; pixels beyond the border count as 0."""
    padding = [(0, -side % _CELL) for side in values.shape]
    padded: NDArray[Any] = np.pad(values, padding) if np.any(padding) else values
    height, width = (side // _CELL for side in padded.shape)
    rows = padded.reshape(height, _CELL, width * _CELL).sum(axis=1, dtype=np.float32)
    # NumPy is slow along a short last axis.
    return np.asarray(sum(rows[:, column::_CELL] for column in range(_CELL)))


def block_sums(of_cells: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the sums over blocks, from the sums over cells (H, W)."""
    side = BLOCK // _CELL
    padded = np.pad(of_cells, [(0, -size % side) for size in of_cells.shape])
    height, width = (size // side for size in padded.shape)
    return np.asarray(padded.reshape(height, side, width, side).sum(axis=(1, 3), dtype=np.float64))


@dataclass(frozen=True)
class BlockSums:
    """Sums over the same strip of rows in two images. Sums over cells of 4 x 4 pixels have the
    shape (H, W) and are means over the channels. In linear images a pixel's change and level are
    divided by the pixel's largest channel in both images."""

    weight: NDArray[np.float32]  # weights of the pixels, over cells
    # (3, H, W) over cells: weighted changes, and weighted changes that displacements by one pixel
    # across and down cause
    changes: NDArray[np.float32]
    levels: NDArray[np.float32]  # (2, H, W) over cells: levels of reference and image
    # (C, 4, H, W) over blocks: weighted change, across, down and level of each channel
    channels: NDArray[np.float64]
    pixels: NDArray[np.float64]  # (2, H, W) over blocks: numbers of counted and of flat pixels
    # (4, H, W) over blocks: squared differences between adjacent pixels in flat areas. Values 0, 1,
    # 2: part common to all channels, in difference image, reference and image. Value 3: remaining
    # part, in the difference image
    grain: NDArray[np.float64]
    texture: NDArray[np.float64]  # (4, H, W) over blocks: the same four values in all areas
    normal: NDArray[np.float64]  # (2, 3), normal equations of the least-squares displacement

    @classmethod
    def of(cls, a: Float, b: Float, inside: Mask, rows: slice, scale: Scale) -> BlockSums:
        """Return the sums over ``rows`` of two images (H, W, C); other rows serve as neighbours.
        ``inside`` (H, W) is the mask of the pixels that are not near an edge of the coverage."""
        count = a.shape[2]
        planes = [[np.ascontiguousarray(image[..., i]) for i in range(count)] for image in (a, b)]
        means = [np.add.reduce(channels) / np.float32(count) for channels in planes]
        steps = [_steps(mean) for mean in means]
        steepest = filtered(np.maximum(*steps), np.maximum)
        level: Float = np.ones((1, 1), np.float32)
        if scale is LINEAR:
            level = np.maximum.reduce([np.abs(plane) for plane in (*planes[0], *planes[1])])
            level = np.maximum(level, np.float32(FLOOR))
        counts = inside & (steepest < np.float32(scale.edge) * level)
        flat = inside & (np.minimum(*steps) < np.float32(scale.flat) * level)
        flat, counted = filtered(flat, np.minimum)[rows], counts[rows]
        slope = np.minimum(np.float32(scale.slope) * steepest / level, np.float32(_WILD))
        noise = scale.noise**2 + np.square(slope)
        weight = (counts / noise / level).astype(np.float32)[rows]
        level = level if scale is SRGB8 else level[rows]
        inverse = weight / level
        if scale is SRGB8:  # rounding moves the contours of smooth areas
            inverse *= steepest[rows] > 1.0
        normal = np.zeros((2, 3))
        of_cells, of_blocks = [], []
        for x, y in zip(*planes, strict=True):
            middle, change = np.float32(0.5) * (x + y), (y - x)[rows]
            slopes = np.zeros((2, *middle.shape), middle.dtype)  # central differences, 0 at borders
            slopes[0, :, 1:-1] = np.float32(0.5) * (middle[:, 2:] - middle[:, :-2])
            slopes[1, 1:-1] = np.float32(0.5) * (middle[2:] - middle[:-2])
            slopes = slopes[:, rows]
            weighted = [inverse * slope for slope in slopes]
            normal += [[np.vdot(row, column) for column in (*slopes, change)] for row in weighted]
            floor = np.float32(FLOOR if scale is LINEAR else 0.0)
            parts = (change, *slopes, np.maximum(np.abs(x[rows]), floor))
            of_cells.append([cell_sums(weight * part) for part in parts])
            of_blocks.append([block_sums(cells) for cells in of_cells[-1]])
        wild = np.float32(_WILD)
        fine = [
            [(detail_of(plane[rows]) / level).clip(-wild, wild) for plane in channels]
            for channels in planes
        ]
        differences = [y - x for x, y in zip(*fine, strict=True)]
        squares = [common_squares(details) for details in (differences, *fine)]
        single = sum(np.square(detail) for detail in differences) / np.float32(count) - squares[0]
        return cls(
            cell_sums(weight * level),
            np.mean(of_cells, axis=0)[:3],
            np.stack([cell_sums(mean[rows]) for mean in means]),
            np.stack(of_blocks),
            np.stack([block_sums(cell_sums(mask)) for mask in (counted, flat)]),
            np.stack([block_sums(cell_sums(flat * square)) for square in (*squares, single)]),
            np.stack([block_sums(cell_sums(counted * square)) for square in (*squares, single)]),
            normal,
        )

    @classmethod
    def joined(cls, strips: list[BlockSums]) -> BlockSums:
        """Return the sums of strips, joined from top to bottom."""
        *parts, normals = zip(*(vars(strip).values() for strip in strips), strict=True)
        joined = [np.concatenate(part, axis=-2) for part in parts]
        return cls(*joined, np.add.reduce(normals))  # type: ignore[call-arg]


@dataclass(frozen=True)
class BlockStatistics:
    """Statistics of the sums over two whole images."""

    sums: BlockSums
    scale: Scale
    foreign: bool = False  # whether different drivers drew the two images
    moved: float = MOVED  # largest displacement of the image whose effect is subtracted, in pixels
    allowed: float = 0.0  # additional standard error of each block's change
    looser: float = 0.0  # further standard error of each block's change; only the trend includes it

    @cached_property
    def shift(self) -> tuple[float, float]:
        """Displacement from reference to image, to the right and down, in pixels."""
        across, down, change = self.sums.normal.T
        normal = np.stack([across, down])
        ridge = 1e-6 * np.trace(normal) + 1e-12
        if self.scale is SRGB8:
            ridge += _STEP * float(self.sums.weight.sum())
        x, y = np.linalg.solve(normal + ridge * np.eye(2), -change)
        return float(x), float(y)

    def _settled(self, changes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return a change without the effect of the displacement; see :attr:`BlockSums.changes`."""
        (x, y), (change, across, down) = self.shift, changes
        factor = min(1.0, self.moved / max(float(np.hypot(x, y)), 1e-12))
        return np.asarray(change + factor * (x * across + y * down))

    @cached_property
    def _changes(self) -> NDArray[np.float64]:
        """Weighted change of each cell, over all channels."""
        return self._settled(self.sums.changes)

    @cached_property
    def judged(self) -> Mask:
        """Mask of blocks that have enough pixels and whose weight is spread over enough cells."""
        return np.asarray((self._cells > _SPREAD) & (self.sums.pixels[0] >= LEAST))

    @cached_property
    def changed(self) -> Mask:
        """Mask of the judged blocks that changed; equal blocks such as background are ignored."""
        return np.asarray(self.judged & (self.change != 0.0))

    @cached_property
    def _weight(self) -> NDArray[np.float64]:
        return np.asarray(np.maximum(block_sums(self.sums.weight), 1e-12))

    @cached_property
    def _cells(self) -> NDArray[np.float64]:
        """Effective number of cells of each block, computed from the weights of the cells."""
        return np.asarray(self._weight**2 / np.maximum(block_sums(self.sums.weight**2), 1e-12))

    @cached_property
    def change(self) -> NDArray[np.float64]:
        """Change of each block's mean, over all channels."""
        return block_sums(self._changes) / self._weight

    @cached_property
    def error(self) -> NDArray[np.float64]:
        """Standard error of each block's change."""
        weight, side = self.sums.weight, BLOCK // _CELL
        mean = np.repeat(np.repeat(self.change, side, axis=0), side, axis=1)
        residuals = self._changes - weight * mean[: weight.shape[0], : weight.shape[1]]
        scatter = block_sums(np.square(residuals)) / self._weight**2
        scatter *= self._cells / np.maximum(self._cells - 1.0, 1.0)
        variance = self.scale.error**2 + self.allowed**2 + self.scale.grain**2 * self._grains[0]
        if self.foreign:
            variance += self.scale.drift**2
        return np.asarray(np.sqrt(scatter + variance))

    @property
    def _dithered(self) -> bool:
        """Whether one image may be dithered, or rounded in another way than the other image."""
        return self.foreign and self.scale is SRGB8

    @property
    def quiet(self) -> bool:
        """Whether linear images differ between adjacent pixels as images of one driver do."""
        # Other drivers filter 8-bit textures with other rounding errors, which differ from channel
        # to channel of a coloured texture.
        if self.scale is SRGB8 or self.changed.sum() < _FEW:
            return False
        pixels = self.sums.pixels[0][self.changed]
        noise, single = np.median(self.sums.texture[::3, self.changed] / pixels, axis=1)
        level = self.sums.channels[:, 3, self.changed]
        tint = np.median(1.0 - level.min(axis=0) / np.maximum(level.max(axis=0), 1e-12))
        noiseless = max(noise / 16.0, single) < _STILL**2
        return bool(noiseless or (tint > _TINT and single < _OWN**2 * noise))

    @cached_property
    def rounding(self) -> NDArray[np.float64]:
        """Largest change of each block's mean that rounding to 8 bits may cause, in levels."""
        error = np.zeros_like(self.sums.weight, np.float64)
        # If the values in a block increase evenly by R steps, rounding changes their mean by at
        # most (1 - R) / 2 or, from R = 1/2, by 1 / (8 R). R is estimated for each cell.
        for levels in self.sums.levels / _CELL**2 if self._dithered else ():
            steps = np.hypot(*np.gradient(np.pad(levels, 1, "edge")))[1:-1, 1:-1]
            steps = steps * np.float64(BLOCK // _CELL)
            error += np.where(steps < 0.5, 0.5 * (1.0 - steps), 0.125 / np.maximum(steps, 0.5))
        return block_sums(self.sums.weight * error) / self._weight

    @cached_property
    def channels(self) -> NDArray[np.float64]:
        """Change of each block's mean in the block's worst channel: a fraction of that mean in
        linear images, else 8-bit levels. NaN if the block is not judged; 0 if the change is within
        three standard errors."""
        parts = self.sums.channels.swapaxes(0, 1)
        divisor = np.maximum(parts[3], 1e-12) if self.scale is LINEAR else self._weight
        relative = self._settled(parts[:3]) / divisor
        worst = np.abs(relative).argmax(axis=0)
        worst_change = np.take_along_axis(relative, worst[None], axis=0)[0]
        worst_change[np.abs(self.change) < 3.0 * self.error] = 0.0
        worst_change[~self.judged] = np.nan
        return np.asarray(worst_change)

    @cached_property
    def _grains(self) -> NDArray[np.float64]:
        """Values of :attr:`BlockSums.grain` per flat pixel, (4,): medians over the blocks."""
        flat = self.sums.pixels[1]
        counts = (flat >= LEAST) & self.changed
        if counts.sum() < _FEW:
            return np.zeros(4)
        return np.asarray(np.median(self.sums.grain[:, counts] / flat[counts], axis=1).clip(0.0))

    @property
    def grain(self) -> float:
        """RMS of differences between adjacent pixels: RMS of the image minus RMS of the reference,
        at most the RMS of the difference image. For linear images it is the RMS of the noise that
        is independent in each channel, if this RMS is larger."""
        difference, reference, image, single = self._grains
        increase = _beyond(image - reference, self._dither(np.minimum(reference, image)))
        common = np.copysign(np.sqrt(min(abs(increase), difference)), increase)
        return float(max(common, np.sqrt(single) if self.scale is LINEAR else 0.0, key=abs))

    @cached_property
    def texture(self) -> float:
        """Median over blocks of the variance between adjacent pixels: (B - A) / (A + B)."""
        if self.changed.sum() < _FEW:
            return 0.0
        reference, image = self.sums.texture[1:3, self.changed]
        pixels = self.sums.pixels[0][self.changed]
        noise = (2.0 * self.scale.noise) ** 2 * pixels
        dither = self._dither(np.minimum(reference, image) / pixels) * pixels
        increase = _beyond(image - reference, dither)
        return float(np.median(increase / (reference + image + noise)))

    def _dither(self, variance: Any) -> Any:
        """Return the variance between adjacent pixels that dithering may add to an 8-bit image,
        from the smaller variance of two images. An image without detail may be smooth."""
        return np.where(variance < _SMOOTH, _DITHER, 0.0) if self._dithered else 0.0

    @property
    def gain(self) -> float:
        """Brightness that the changed blocks gained: fraction of the reference, or 8-bit levels."""
        # The effect of a displacement is included, since a gain can look like a displacement.
        change, _, _, level = self.sums.channels[:, :, self.changed].sum(axis=(0, 2))
        if self.scale is SRGB8:
            level = len(self.sums.channels) * self._weight[self.changed].sum()
        return float(change / max(level, 1e-12))

    @cached_property
    def trend(self) -> float:
        """Mean product of the changes of two neighbouring blocks, in units of standard errors."""
        return float(self._products.mean()) if self._products.size else 0.0

    @property
    def z_score(self) -> float:
        """The trend divided by its standard error, which is computed as if no block had changed."""
        return self.trend * float(np.sqrt(self._products.size))

    @cached_property
    def _products(self) -> NDArray[np.float64]:
        change = _beyond(self.change, self.rounding)
        ratio = np.clip(change / np.hypot(self.error, self.looser), -_CLIPPED, _CLIPPED)
        products: list[NDArray[np.float64]] = []
        for blocks, neighbours in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            pairs = self.changed[blocks] & self.changed[neighbours]
            products.append((ratio[blocks] * ratio[neighbours])[pairs])
        return np.concatenate(products)


def _beyond(value: Any, allowed: Any) -> Any:
    """Return the part of a value beyond [-allowed, allowed]."""
    return np.sign(value) * np.maximum(np.abs(value) - allowed, 0.0)


def common_squares(channels: list[Float]) -> Float:
    """Return the mean product over pairs of different channels: rounding errors average out."""
    count = len(channels)
    if count == 1:
        return np.square(channels[0])
    products = np.square(sum(channels)) - sum(np.square(channel) for channel in channels)
    return products / np.float32(count * (count - 1))


def _steps(x: Float) -> Float:
    """Return the largest step from each pixel to one of its four neighbours."""
    largest = np.zeros_like(x)
    for axis in (0, 1):
        step = np.moveaxis(np.abs(np.diff(x, axis=axis)), axis, 0)
        target = np.moveaxis(largest, axis, 0)
        np.maximum(target[1:], step, out=target[1:])
        np.maximum(target[:-1], step, out=target[:-1])
    return largest


def detail_of(x: Float) -> Float:
    """Return each pixel minus the mean of its left and right neighbours; 0 at the border."""
    detail = np.zeros_like(x)
    detail[:, 1:-1] = x[:, 1:-1] - np.float32(0.5) * (x[:, 2:] + x[:, :-2])
    return detail


Float = NDArray[np.floating]
Mask = NDArray[np.bool_]

_HALO = 4  # pixels around a window that the neighbourhoods of the window's pixels read
_CONTRAST = 0.5  # a range is widened by this fraction of the range of 5 x 5 pixels
_RELATIVE = 0.01  # a range is widened by this fraction of the level
COVERED = 0.5  # smallest coverage of a covered pixel
FULL = 0.99  # least coverage of a pixel inside the mesh: half floats and filters do not reach 1
MARGIN = 2  # width in pixels of the coverage's border, which statistics of areas ignore
_LEVEL = 0.2  # smallest range of 5 x 5 pixels at an edge, as a fraction of their maximum


# Classes of the pixels that exceed the point limit: a possible sliver; others in a smooth area, in
# texture, and at an edge.
SLIVER, SMOOTH, ROUGH, EDGE = 1, 2, 3, 4


def excess(a: Float, b: Float, full: Mask, least: float, scale: Scale) -> tuple[Float, Float]:
    """Return the unexplained difference of each pixel, (H, W): how far its worst channel leaves the
    range of its neighbourhood in the other image, negative where image b is darker. Also return the
    part of this difference that slivers may cause.

    a, b : (H, W, C)
    full : (H, W), pixels that both images cover fully
    least : smallest difference of interest; areas with smaller differences get 0
    """
    value, slack = np.zeros((2, *a.shape[:2]), dtype=np.float32)
    # An unexplained difference is at most the plain difference, which is fast to compute.
    different = difference(a, b) > least
    if not different.any():
        return value, slack
    sides = (np.flatnonzero(different.any(axis=axis)) for axis in (1, 0))
    window = tuple(slice(max(side[0] - _HALO, 0), side[-1] + 1 + _HALO) for side in sides)
    full = full[window]
    a, b, worst, sliver_part = (x[window] for x in (a, b, value, slack))

    def take(distance: Float, sign: float, sliver: Float) -> None:
        larger = distance > np.abs(worst)  # False where NaN
        np.copyto(worst, sign * distance, where=larger)
        np.copyto(sliver_part, sliver, where=larger)

    for channel in range(a.shape[2]):
        images = [np.ascontiguousarray(image[..., channel]) for image in (a, b)]
        for sign, (x, y) in ((1.0, images), (-1.0, images[::-1])):
            low, high, allowed, sliver = _range(x, np.minimum, np.maximum, scale)
            take(y - high - allowed, sign, sliver)
            if not full.all():
                x, y = (np.where(full, image, np.float32(np.nan)) for image in (x, y))
                low, _, allowed, sliver = _range(x, np.fmin, np.fmax, scale)
            take(low - y - allowed, -sign, sliver)
    return value, slack


def holes(a: Float, b: Float, full: Mask, scale: Scale) -> Mask:
    """Return a mask of the pixels whose radiance is below a quarter of the radiance of every
    covered pixel in the 7 x 7 neighbourhood of the other image; parameters as in :func:`excess`."""
    # sRGB encodes 1/4 as about 1/2
    fraction, floor = (0.25, 5e-4) if scale is LINEAR else (0.5, 1.0)
    mask = np.zeros(a.shape[:2], dtype=bool)
    planes = ([*np.moveaxis(x, 2, 0)] for x in (a, b))
    levels = [np.maximum.reduce(channels).clip(np.float32(0.0)) for channels in planes]
    for x, y in (levels, levels[::-1]):
        candidates = full & (y < fraction * x - floor)
        positions = np.argwhere(candidates)
        if not positions.size:
            continue
        padded = np.pad(np.where(full, x, np.inf), 3, constant_values=np.inf)
        low = np.minimum.reduce([padded[tuple((positions + step).T)] for step in np.ndindex(7, 7)])
        rows, columns = positions[y[candidates] < fraction * low - floor].T
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


def _range(
    x: Float, minimum: Callable[..., Any], maximum: Callable[..., Any], scale: Scale
) -> tuple[Float, Float, Float, Float]:
    """Return the minimum of 3 x 3 pixels, their maximum, the amount by which this range is widened,
    and the difference that a sliver may add."""
    low, high = filtered(x, minimum), filtered(x, maximum)
    top = filtered(high, maximum)
    span = top - filtered(low, minimum)
    allowed = np.float32(_CONTRAST) * span
    if scale is LINEAR:
        allowed += np.float32(_RELATIVE) * np.abs(top)
    steepness = span / np.maximum(np.abs(top), np.float32(1e-6))
    sliver = np.float32(scale.rough_sliver) * np.minimum(steepness / np.float32(0.5 * _LEVEL), 1.0)
    sliver[steepness >= _LEVEL] = scale.edge_sliver
    return low, high, allowed, sliver


FADED = 0.2  # smallest change of a pixel's coverage that counts
_STRIP = 1 << 18  # pixels that are compared at once, so that they fit the processor's cache
_BORDER = 8  # rows above and below a strip, with which the strip's pixels are also compared


@dataclass(frozen=True)
class Strip:
    """Metrics of some rows of two images."""

    sums: BlockSums
    over: NDArray[np.int8]  # (H, W), class of each pixel, see :func:`compare.reasons_of`
    worst: float  # the largest unexplained difference of a pixel, minus the effect of a sliver
    point: float  # reported difference of the worst pixel
    point_at: tuple[int, int]  # its position (x, y)
    holes: int  # number of dark pixels with bright neighbours in the other image
    faded: int  # number of pixels whose coverage changed
    largest: float  # maximum of the pixels' absolute differences, in the worst channel
    total: float  # their sum
    largest_at: tuple[int, int]

    @classmethod
    def of_all(cls, a: ImageData, b: ImageData, counts: Mask, limit: float) -> Strip:
        """Return the metrics of all rows, computed strip by strip in threads; ``counts`` is the
        mask of the pixels that count, and ``limit`` the limit of a pixel's difference."""
        height, width = counts.shape
        step = max(_STRIP // width // BLOCK, 1) * BLOCK
        rows = [slice(top, min(top + step, height)) for top in range(0, height, step)]
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
            strips = list(pool.map(lambda strip: cls.of(a, b, counts, strip, limit), rows))
        farthest = max(strips, key=lambda strip: strip.largest)
        summed = ("holes", "faded", "total")
        return replace(
            max(strips, key=lambda strip: strip.worst),
            sums=BlockSums.joined([strip.sums for strip in strips]),
            over=np.concatenate([strip.over for strip in strips]),
            largest=farthest.largest,
            largest_at=farthest.largest_at,
            **{name: sum(getattr(strip, name) for strip in strips) for name in summed},
        )

    @classmethod
    def of(cls, a: ImageData, b: ImageData, counts: Mask, rows: slice, limit: float) -> Strip:
        """Return the metrics of ``rows``."""
        outer = slice(max(rows.start - _BORDER, 0), min(rows.stop + _BORDER, len(counts)))
        inner = slice(rows.start - outer.start, rows.stop - outer.start)
        (color_a, alpha_a), (color_b, alpha_b) = a.rows(outer), b.rows(outer)
        scale, counted = SCALES[a.encoding], counts[outer]
        full = (alpha_a >= FULL) & (alpha_b >= FULL)
        black = holes(color_a, color_b, full, scale) | gaps(alpha_a, alpha_b)
        value, slack = (x[inner] for x in excess(color_a, color_b, full, limit, scale))
        value = np.where(counted[inner], value, np.float32(0.0))
        beyond = np.where(value != 0.0, np.abs(value) - slack, np.float32(0.0))
        # The first condition that holds gives the class of a pixel.
        conditions = [np.abs(value) <= limit, beyond <= limit]
        conditions += [slack >= np.float32(scale.edge_sliver), slack > 0.25 * scale.rough_sliver]
        classes = np.sign(value) * np.select(conditions, [0, SLIVER, EDGE, ROUGH], SMOOTH)
        row, column = np.unravel_index(beyond.argmax(), beyond.shape)
        worst = max(beyond[row, column], 0.0)
        worst = abs(value[row, column]) if worst > limit else worst
        magnitude = difference(color_a[inner], color_b[inner]) * counted[inner]
        down, right = np.unravel_index(magnitude.argmax(), magnitude.shape)
        return cls(
            BlockSums.of(color_a, color_b, shrunk(full & counted, MARGIN), inner, scale),
            classes.astype(np.int8),
            float(beyond[row, column]),
            float(np.copysign(worst, value[row, column])),
            (int(column), rows.start + int(row)),
            int((black & counted)[inner].sum()),
            0 if full.all() else int((_faded(alpha_a, alpha_b) & counted)[inner].sum()),
            float(magnitude[down, right]),
            float(magnitude.sum(dtype=np.float64)),
            (int(right), rows.start + int(down)),
        )


def _faded(a: Float, b: Float) -> Mask:
    """Return a mask of the pixels whose coverage crossed 0.5, or lies more than FADED outside the
    range of the neighbourhood in the other image."""
    changed = (a >= 0.5) != (b >= 0.5)
    for x, y in ((a, b), (b, a)):
        changed |= y - filtered(x, np.maximum) > FADED
        changed |= filtered(x, np.minimum) - y > FADED
    return np.asarray(changed)
