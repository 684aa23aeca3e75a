"""Reasons of a difference as text: the failed check, its metric and limit, and a likely cause."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.blocks import BLOCK, BlockStatistics, block_sums, cell_sums
from facerender.comparison.neighbourhoods import Mask
from facerender.comparison.result import BLUR, Comparison

SHAPE = "another shape, texture or light"
LOBE = "a lobe or weight change"
EXPOSURE = "exposure, light or colour space"

# Largest unexplained difference of a single pixel: in a smooth area, in texture, at an edge.
_LONE = {"linear": (0.0, 0.1, 0.5), "srgb8": (0.0, 53.0, 90.0)}
_WIDELY = 0.1  # a larger fraction of wrong pixels counts as a change of the whole image
_BRIGHTER = 5e-5  # smallest gain that is reported
_SHIFTED = 0.01  # smallest shift that is reported, in pixels
_HOLES = 2  # largest number of holes that passes, since cracks and hairs cause some


def reasons_of(
    result: Comparison, over: NDArray[np.int8], statistics: BlockStatistics
) -> tuple[str, ...]:
    """Return the reasons of a difference, with likely causes.

    over : (H, W), class of each pixel that exceeds the point limit: 1 a possible sliver, 2 in a
        smooth area, 3 in texture, 4 at an edge; negative if the pixel is too dark. Other pixels: 0
    """
    reasons = []
    wrong = _wrong(result, over)
    like = _likeness(result, over, wrong, statistics) if wrong.any() else ""
    if like:
        reasons.append(f"{_pixels(result, over[wrong])}: looks like {like}")
    elif result.holes > _HOLES:
        reasons.append(
            f"{result.holes} pixels have less than a quarter of their neighbours' light or no "
            f"coverage, limit {_HOLES}: looks like missing pixels"
        )
    if result.blocks:
        guess = _guess(statistics)
        if like and guess != EXPOSURE and (like == SHAPE or _explained(result, wrong, statistics)):
            guess = like
        reasons.append(f"{_blocks(result)}: looks like {guess}{_estimate(result)}")
    elif result.changed_alike:
        reasons.append(
            f"neighbouring blocks changed alike: trend {result.trend:.2g}, limit "
            f"{result.limit_factor * result.limits.trend:g}: looks like {_guess(statistics)}"
            f"{_estimate(result)}"
        )
    if not reasons:
        reasons += [*_subtle(result)][:1]
    if result.coverage > result.limits.coverage:
        reasons.append(
            f"coverage changed on {100.0 * result.coverage:.2g} % of the pixels, limit "
            f"{100.0 * result.limits.coverage:g} %: looks like another mesh or camera"
        )
    return tuple(reasons)


def _wrong(result: Comparison, over: NDArray[np.int8]) -> Mask:
    """Return a mask of the pixels that fail: clearly different pixels, or too many slivers.

    A single clearly different pixel fails only if its difference exceeds _LONE.
    """
    place = np.abs(over)
    if result.points > 1:
        return place > 1
    if result.points and abs(result.point) > _LONE[result.encoding][int(place.max()) - 2]:
        return place > 1
    return (place > 0) & (result.slight > result.sliver_limit)


def _pixels(result: Comparison, over: NDArray[np.int8]) -> str:
    """Describe the wrong pixels; ``over`` has their classes, see :func:`reasons_of`."""
    pixels = f"{len(over)} pixel{' differs' if len(over) == 1 else 's differ'}"
    if (np.abs(over) == 1).any():
        return f"{pixels} like slivers at edges, limit {result.sliver_limit:.0f}"
    point = abs(result.point)
    by = f"{point:.2g}" if result.encoding == "linear" else f"{point:.0f} of 255"
    at_edge = " at edges" if _at_edge(over) else ""
    return (
        f"{pixels} from the surroundings in the other image by up to {by}{at_edge}, worst at "
        f"{result.point_at}, limit {result.limits.point:g}"
    )


def _blocks(result: Comparison) -> str:
    """Describe the blocks over the block limit."""
    factor, unit = (100.0, " %") if result.encoding == "linear" else (1.0, "")
    mean = f"{_signed(factor * result.block)}{unit or ' of 255'}"
    return (
        f"block at {result.block_at}: mean {mean}, limit {factor * result.limits.block:g}{unit}, "
        f"exceeded by {result.blocks} of {result.blocks_judged} blocks"
    )


def _explained(result: Comparison, wrong: Mask, statistics: BlockStatistics) -> bool:
    """Return whether every block over the limit contains a wrong pixel."""
    over = np.abs(np.nan_to_num(statistics.channels)) > result.limits.block
    return bool(block_sums(cell_sums(wrong.astype(np.float32)))[over].all())


def _subtle(result: Comparison) -> Iterator[str]:
    """Describe failures of the checks of grain, texture and shift. Other changes cause these
    failures too, so they are reported only if no other check fails."""
    limits, factor = result.limits, result.limit_factor
    grain, texture = factor * limits.grain, factor * limits.texture
    if not BLUR * -grain <= result.grain <= grain:
        by, unit = (100.0, " %") if result.encoding == "linear" else (1.0, "")
        yield (
            f"grain {by * result.grain:+.2g}{unit or ' of 255'}, limit {by * grain:g}{unit}: looks "
            f"like {_texture(result.grain)}"
        )
    if not BLUR * -texture <= result.texture <= texture:
        yield (
            f"texture {100.0 * result.texture:+.2g} %, limit {100.0 * texture:g} %: looks like "
            f"{_texture(result.texture)}"
        )
    x, y = result.shift
    if max(abs(x), abs(y)) > limits.shift:
        yield f"shift ({x:.2f}, {y:.2f}) pixels, limit {limits.shift:g}: looks like another camera"


def _likeness(
    result: Comparison, over: NDArray[np.int8], wrong: Mask, statistics: BlockStatistics
) -> str:
    """Return a likely cause of wrong pixels."""
    count, judged = wrong.sum(), result.blocks_judged * BLOCK**2
    if count > _WIDELY * judged > 0:
        guess = _guess(statistics)
        return SHAPE if guess == LOBE else guess
    bright = (over[wrong] > 0).mean()
    touching = (wrong[1:] & wrong[:-1]).sum() + (wrong[:, 1:] & wrong[:, :-1]).sum()
    scattered = touching <= 0.5 * count
    if bright > 0.9:
        return "fireflies" if scattered and not _at_edge(over[wrong]) else "false highlights"
    if bright < 0.1 and count < 0.01 * judged:
        return "missing pixels" if scattered else "missing highlights"
    return SHAPE


def _at_edge(over: NDArray[np.int8]) -> bool:
    """Return whether most pixels lie at edges; ``over`` has their classes."""
    return bool((np.abs(over) == 4).mean() > 0.5)


def _guess(statistics: BlockStatistics) -> str:
    """Return a likely cause of changed blocks."""
    changes = statistics.change[statistics.changed]
    if not changes.size:
        return SHAPE
    low, middle, high = np.percentile(changes, (10, 50, 90))
    return EXPOSURE if high - low < 0.5 * abs(middle) else LOBE


def _estimate(result: Comparison) -> str:
    """Return gain and shift of the image as text."""
    brighter = result.encoding == "linear" and abs(result.gain) > _BRIGHTER
    gain = f"gain {round(1.0 + result.gain, 4):g}" if brighter else ""
    x, y = result.shift
    moved = f"shift ({x:.2g}, {y:.2g})" if max(abs(x), abs(y)) > _SHIFTED else ""
    estimate = ", ".join(filter(None, (gain, moved)))
    return f" ({estimate})" if estimate else ""


def _texture(change: float) -> str:
    return "noise, other normals or values of fewer bits" if change > 0.0 else "a blur, other maps"


def _signed(value: float) -> str:
    return f"{value:+.2g}" if abs(value) < 10.0 else f"{value:+.0f}"
