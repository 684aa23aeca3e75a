"""The likely cause of a difference, derived from the pixels of two images. Each cause has its trace
in the change of linear radiance, relative to the pixel's level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import windows
from facerender.comparison.windows import FULL, Float, Mask, cell_sums
from facerender.images.image import ImageData, srgb_to_linear

# Texts of the causes, each with its trace.
LOBE = "another slope, lobe or weight"  # light of the lamp's colour, which skin does not tint
LIGHT = "another light"  # light with the colour of the image, changed alike over large areas
EXPOSURE = "another exposure"  # one factor for all blocks
TEXTURE = "another texture, normal map or noise"  # another hue, or detail that appears or vanishes
GEOMETRY = "another mesh or camera"  # detail that moved, or a changed coverage
DRIVER = "another driver or other samples"  # a few pixels at edges, or faint detail
# A function of the value, fewer values, or noise in the colours.
CODEC = "another encoding, such as gamma, JPEG or fewer bits"

_ROWS = 128  # height of a strip
_PIXELS = 1 << 20  # of larger images, evenly spaced strips with this number of pixels are used
_HIGHEST_HALF = np.float32(65504.0)  # largest half float
_DARK = 0.1  # smallest radiance that changes are divided by
_BRIGHT = 2.0  # larger radiance counts as this
_STEEP = 0.5  # smallest range of 3 x 3 pixels at an edge, as a fraction of their maximum
_WINDOW = 8  # width and height in cells of the areas whose displacement is fitted


@dataclass(frozen=True)
class Change:
    """The change from one image to another in some strips of rows."""

    power: NDArray[np.float32]  # (H, W), squared relative change, summed over the channels
    inside: Mask  # (H, W), pixels that are not near an edge of the coverage and not clipped
    steep: Mask  # (H, W), pixels at edges of either image
    detail: float  # sum of the squared change between adjacent pixels that all channels share
    # (H, W, 2 C + 1) over blocks: number of pixels inside, change and level of each channel
    blocks: NDArray[np.float64]
    cells: NDArray[np.float64]  # (H, W, 2) over cells: mean radiance of both images
    # (3, N), per value of the first image: count of the value, sum and squared sum of its changes.
    # Values are 8-bit levels, or half floats without their last three bits, whose changes are
    # relative
    values: NDArray[np.float64]
    rounding: float  # variance of a value's change that rounding to 8-bit levels causes

    @classmethod
    def between(cls, a: ImageData, b: ImageData, rows: Sequence[slice]) -> Change:
        """Return the change in strips of rows."""
        changes = [cls._of(a, b, strip) for strip in rows]
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(change, name) for change in changes])
            for name in ("power", "inside", "steep", "blocks", "cells")
        }
        detail = sum(change.detail for change in changes)
        values = np.sum([change.values for change in changes], axis=0)
        return replace(changes[0], detail=detail, values=values, **joined)

    @classmethod
    def _of(cls, a: ImageData, b: ImageData, rows: slice) -> Change:
        (x, alpha_x), (y, alpha_y) = a.rows(rows), b.rows(rows)
        x, y = (color.clip(-_HIGHEST_HALF, _HIGHEST_HALF) for color in (x, y))
        inside = windows.shrunk((alpha_x >= FULL) & (alpha_y >= FULL), windows.MARGIN)
        halves = x.astype(np.float16).view(np.uint16) >> 3
        numbers = x.astype(np.uint8) if a.encoding == "srgb8" else halves
        of_value = y - x
        if a.encoding == "linear":
            of_value = of_value / np.maximum(np.abs(x), np.float32(_DARK))
        else:
            inside &= np.maximum(x, y).max(axis=2) < 255.0
            table = srgb_to_linear(np.arange(256) / 255.0)
            x, y = (np.interp(color, np.arange(256), table).astype(np.float32) for color in (x, y))
        x, y = (color.clip(np.float32(-_BRIGHT), np.float32(_BRIGHT)) for color in (x, y))
        level = np.maximum(np.maximum(np.abs(x), np.abs(y)).max(axis=2), np.float32(_DARK))
        change = (y - x) / level[..., None]
        planes = (np.ascontiguousarray(plane * inside) for plane in np.moveaxis(change, 2, 0))
        details = [windows.detail_of(plane) for plane in planes]
        interior = windows.filtered(inside, np.minimum)
        means = [color.mean(axis=2) for color in (x, y)]
        blocks = [inside.astype(np.float32)]
        for image in (y - x, np.abs(x)):
            blocks += [np.ascontiguousarray(plane * inside) for plane in np.moveaxis(image, 2, 0)]
        ones = cell_sums(np.ones(level.shape, np.float32))
        change_of_value = of_value[inside].ravel()
        weights = (None, change_of_value, np.square(change_of_value))
        values = [np.bincount(numbers[inside].ravel(), weight, 1 << 13) for weight in weights]
        return cls(
            np.square(change).sum(axis=2),
            inside,
            np.maximum(*(_range(mean) for mean in means)) > 0.0,
            float(np.vdot(interior, windows.common_squares(details))),
            np.stack([windows.block_sums(cell_sums(plane)) for plane in blocks], axis=-1),
            np.stack([cell_sums(mean).astype(np.float64) / ones for mean in means], axis=-1),
            np.stack(values),
            1.0 / 6.0 if a.encoding == "srgb8" else 0.0,
        )

    @cached_property
    def _judged(self) -> tuple[Mask, NDArray[np.float64], NDArray[np.float64]]:
        """Mask of the changed blocks that are not dark, their relative change and level (N, C)."""
        count, sums = self.blocks[..., 0], self.blocks[..., 1:]
        means = sums / np.maximum(count, 1.0)[..., None]
        change, level = np.split(means, 2, axis=-1)
        bright = np.maximum(level, level + change).max(axis=-1)
        judged = (count >= 0.5 * windows.BLOCK**2) & change.any(axis=-1)
        if judged.any():
            judged &= bright > 0.1 * np.percentile(bright[judged], 90)
        scale = np.maximum(bright, _DARK)[judged, None]
        return judged, change[judged] / scale, level[judged] / scale

    @property
    def smooth(self) -> float:
        """Sum of the squared changes of the blocks' means, per channel."""
        judged, change, _ = self._judged
        return float((self.blocks[judged, :1] * change**2).sum() / max(change.shape[1], 1))

    @property
    def fineness(self) -> float:
        """Fraction of the change that lies in fine detail; noise of single channels is ignored."""
        detail = max(self.detail, 0.0)
        return detail / max(detail + self.smooth, 1e-12)

    @property
    def roughness(self) -> float:
        """RMS of the change's fine detail."""
        return float(np.sqrt(max(self.detail, 0.0) / max(float(self.inside.sum()), 1.0)))

    @property
    def few(self) -> float:
        """Fraction of the squared change in the 0.1 % of the pixels that changed most."""
        power = (self.power * self.inside).ravel()
        count = max(int(self.inside.sum()) // 1000, 1)
        return float(np.partition(power, -count)[-count:].sum() / max(float(power.sum()), 1e-12))

    def share(self, mask: Mask) -> float:
        """Return the fraction of the squared change in the pixels of a mask."""
        return float(self.power[mask].sum() / max(float(self.power.sum()), 1e-12))

    @property
    def by_factor(self) -> float:
        """Fraction of the blocks' change that one factor explains."""
        _, change, level = self._judged
        if not change.size:
            return 0.0
        residual = change - level * (change * level).sum() / max((level**2).sum(), 1e-20)
        return 1.0 - float((residual**2).sum() / max((change**2).sum(), 1e-20))

    @property
    def by_curve(self) -> float:
        """Fraction of the pixels' change that a function of the value explains."""
        count, change, power = self.values
        explained = np.square(change) / np.maximum(count, 1.0)
        noise = self.rounding * count.sum()
        return float(explained.sum() / max(power.sum() - noise, 0.5 * power.sum(), 1e-20))

    @property
    def hues(self) -> tuple[float, float, float]:
        """Fractions of the blocks' change that lie outside the block's colour, outside the most
        common colour of the change, and outside white."""
        _, change, level = self._judged
        total = max(float((change**2).sum()), 1e-20)
        tinted = (change * level).sum(axis=1) ** 2 / np.maximum((level**2).sum(axis=1), 1e-12)
        of_channels = change.T @ change
        white = of_channels.sum() / len(of_channels)
        common = np.linalg.eigvalsh(of_channels)[-1]
        hue, shared, color = (1.0 - float(power) / total for power in (tinted.sum(), common, white))
        return hue, shared, color

    @property
    def grey(self) -> bool:
        """Whether the blocks have no colour."""
        _, _, level = self._judged
        return bool((level.min(axis=1, initial=1.0) > 0.95 * level.max(axis=1, initial=0.0)).all())

    @property
    def alike(self) -> float:
        """Correlation of the changes of neighbouring blocks."""
        judged, change, _ = self._judged
        grid = np.full(judged.shape, np.nan)
        grid[judged] = change.sum(axis=1)
        pairs = [(grid[:, 1:] * grid[:, :-1]).ravel(), (grid[1:] * grid[:-1]).ravel()]
        products = np.concatenate(pairs)
        products = products[np.isfinite(products)]
        if not products.size:
            return 0.0
        return float(products.mean() / max(np.nanmean(grid**2), 1e-20))

    @property
    def one_sided(self) -> float:
        """Sum of the blocks' changes, as a fraction of the sum of their absolute values."""
        _, change, _ = self._judged
        return float(np.abs(change.sum()) / max(np.abs(change).sum(), 1e-20))

    @property
    def moved(self) -> float:
        """Fraction of the change that displacements of areas of 32 x 32 pixels explain: the smaller
        one of the whole change's fraction and the median of the areas."""
        reference, image = np.moveaxis(self.cells, -1, 0)
        middle = 0.5 * (reference + image)
        if min(middle.shape) < _WINDOW:
            return 0.0
        scale = np.maximum(np.maximum(np.abs(reference), np.abs(image)), _DARK)
        parts = (*np.gradient(middle), middle, np.ones_like(middle))
        model = np.stack([_windows(part / scale) for part in parts], axis=-1)
        change = _windows((image - reference) / scale)
        brighter, displaced = (_residuals(model[..., i:], change) for i in (2, 0))
        explained = brighter - displaced
        total = float((change**2).sum())
        if not total:
            return 0.0
        changed = brighter > 0.1 * brighter.mean()
        fractions = explained[changed] / brighter[changed]
        return min(float(explained.sum()) / total, float(np.median(fractions)))


def strips(height: int, width: int, *include: int) -> list[slice]:
    """Return all strips of a small image, else evenly spaced strips and the rows ``include``."""
    tops = [*range(0, height, _ROWS)]
    chosen = {*tops[:: -(-height * width // _PIXELS)], *(row // _ROWS * _ROWS for row in include)}
    return [slice(top, min(top + _ROWS, height)) for top in sorted(chosen)]


def cause_of(change: Change) -> str:
    """Return the likely cause of a change of many pixels."""
    hue, shared, white = change.hues
    if change.by_factor > 0.9 and hue < 0.03:
        return EXPOSURE
    if change.by_curve > 0.985:
        return CODEC
    if not change.smooth and not change.detail:
        return GEOMETRY
    moved = change.moved > 0.12
    if change.fineness > 0.6:
        return _cause_of_detail(change, moved)
    if white > 0.5 and shared > 0.03:
        return CODEC
    if (white < 0.8 * hue and change.by_factor < 0.75) or (change.grey and change.alike > 0.3):
        return LOBE
    if moved:
        return LIGHT if change.one_sided > 0.95 else GEOMETRY  # a shadow's edges look moved
    if hue > 0.03:
        return TEXTURE
    return LIGHT if change.alike > 0.6 else TEXTURE


def _cause_of_detail(change: Change, moved: bool) -> str:
    """Return the likely cause of changed detail."""
    few, at_edges = change.few, change.share(change.steep)
    if moved and few < 0.6:
        return GEOMETRY
    if few < 0.2 and at_edges > 0.6 and change.alike > 0.6:
        return LIGHT  # edges of shadows moved
    faint = change.roughness < 0.005
    if few > 0.18 or (faint and at_edges > 0.2):
        return DRIVER
    return CODEC if change.hues[2] > 0.5 else TEXTURE


def _range(x: Float) -> NDArray[np.float32]:
    """Return the range of 3 x 3 pixels minus the range of an edge."""
    high, low = windows.filtered(x, np.maximum), windows.filtered(x, np.minimum)
    return np.asarray(high - low - _STEEP * np.maximum(high, 0.5 * _DARK))


def _windows(cells: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cells of each window, (N, K)."""
    height, width = (side // _WINDOW for side in cells.shape)
    cut = cells[: height * _WINDOW, : width * _WINDOW]
    return cut.reshape(height, _WINDOW, width, _WINDOW).swapaxes(1, 2).reshape(-1, _WINDOW**2)


def _residuals(model: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared residual of each window's least-squares fit."""
    normal = model.swapaxes(1, 2) @ model + 1e-4 * np.eye(model.shape[2])
    factors = np.linalg.solve(normal, model.swapaxes(1, 2) @ change[..., None])
    return np.asarray(np.square(change[..., None] - model @ factors).sum(axis=(1, 2)))
