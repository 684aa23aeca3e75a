"""Why two images differ, in words: which gate failed, by how much, and what that looks like."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.evidence import BLOCK, Evidence, blocks, cells

if TYPE_CHECKING:
    from facerender.comparison.gates import Comparison

SHAPE = "another shape, texture or light"
LOBE = "a lobe or weight change"
EXPOSURE = "exposure, light or colour space"

SURE = 6.0  # standard errors of its own that a trend needs
FOREIGN = 6.0  # times the limits of trend and grain, where another driver drew the image
# What a single pixel may be over by: where it is smooth, in texture, and at an edge.
_LONE = {"linear": (0.0, 0.1, 0.5), "srgb8": (0.0, 53.0, 90.0)}
_SLIGHT = 50  # pixels that may be slivers, and
_SHARE = 1e-4  # of all pixels
BLUR = 1.5  # times the limits of grain and texture, that the image may have less
_WIDELY = 0.1  # share of wrong pixels from which on they are not called few
_SEEN = 0.01  # pixels of a shift, below which it is not told
_HOLES = 2  # that cracks and hairs may leave


def reasons_of(result: Comparison, over: NDArray[np.int8], evidence: Evidence) -> tuple[str, ...]:
    """Say why the images differ, and what that looks like.

    over : (H, W), 2 where a pixel is too bright, 3 in texture, 4 at an edge, and 1 where that may
        be a sliver; negative where it is too dark
    """
    limits, linear = result.limits, result.encoding == "linear"
    reasons = []
    like = ""
    wrong = np.abs(over) > 1
    place = int(np.abs(over).max(initial=0))
    few = result.points > 1 or abs(result.point) > _LONE[result.encoding][max(place - 2, 0)]
    slivers = result.slight > most_slight(result) and not (result.points and few)
    if slivers:
        wrong, few = over != 0, True
    count = int(wrong.sum())
    if count and few:
        judged = result.blocks_judged * BLOCK**2
        widely = judged and count > _WIDELY * judged
        like = _guess(evidence) if widely else _likeness(over, wrong, count, judged)
        like = SHAPE if like == LOBE else like
        at_edge = " at edges" if (np.abs(over[wrong]) == 4).mean() > 0.5 else ""
        by = f"{abs(result.point):.2g}" if linear else f"{abs(result.point):.0f} of 255"
        told = f" over by up to {by}{at_edge}, worst {result.point_at}, limit {limits.point:g}"
        if slivers:
            told = f" changed as slivers may change them, limit {most_slight(result):.0f}"
        reasons.append(f"{count} pixel{'' if count == 1 else 's'}{told}: looks like {like}")
    elif result.holes > _HOLES:
        reasons.append(
            f"{result.holes} pixels with less than a quarter of the light around them, limit "
            f"{_HOLES}: looks like missing pixels"
        )
    factor = FOREIGN if result.foreign else 1.0
    if result.blocks:
        mean, limit = (
            (f"{_signed(100.0 * result.block)} %", f"{100.0 * limits.block:g} %")
            if linear
            else (f"{_signed(result.block)} of 255", f"{limits.block:g}")
        )
        explained = blocks(cells(wrong.astype(np.float32)))[
            np.abs(np.nan_to_num(evidence.channels)) > limits.block
        ].all()
        guess = _guess(evidence)
        if guess != EXPOSURE and count and few and (explained or like == SHAPE):
            guess = like
        reasons.append(
            f"block {result.block_at}: mean {mean}, limit {limit}, {result.blocks} of "
            f"{result.blocks_judged} blocks over: looks like {guess}{_estimate(result)}"
        )
    elif changed_alike(result):
        reasons.append(
            f"neighbouring blocks changed alike: trend {result.trend:.2g}, limit "
            f"{factor * limits.trend:g}: looks like {_guess(evidence)}{_estimate(result)}"
        )
    grain, texture = factor * limits.grain, factor * limits.texture
    if not reasons and not BLUR * -grain <= result.grain <= grain:
        amount, limit = (
            (f"{100.0 * result.grain:+.2g} %", f"{100.0 * grain:g} %")
            if linear
            else (f"{result.grain:+.2g} of 255", f"{grain:g}")
        )
        reasons.append(f"grain {amount}, limit {limit}: looks like {_texture(result.grain)}")
    if not reasons and not BLUR * -texture <= result.texture <= texture:
        reasons.append(
            f"texture {100.0 * result.texture:+.2g} %, limit {100.0 * texture:g} %: looks like "
            f"{_texture(result.texture)}"
        )
    x, y = result.shift
    if not reasons and max(abs(x), abs(y)) > limits.shift:
        reasons.append(
            f"shift ({x:.2f}, {y:.2f}) pixels, limit {limits.shift:g}: looks like another camera"
        )
    if result.coverage > limits.coverage:
        reasons.append(
            f"coverage changed on {100.0 * result.coverage:.2g} % of the pixels, limit "
            f"{100.0 * limits.coverage:g} %: looks like another mesh or camera"
        )
    return tuple(reasons)


def most_slight(result: Comparison) -> float:
    """Return how many pixels of an image may be slivers."""
    width, height = result.size
    return _SLIGHT + _SHARE * width * height


def changed_alike(result: Comparison) -> bool:
    """Return whether the trend is over its limit, and no chance."""
    limit = result.limits.trend * (FOREIGN if result.foreign else 1.0)
    return result.trend > limit and result.surety > SURE


def _likeness(over: NDArray[np.int8], wrong: NDArray[np.bool_], count: int, judged: int) -> str:
    """Say what wrong pixels look like."""
    bright = float((over[wrong] > 0).mean())
    touching = (wrong[1:] & wrong[:-1]).sum() + (wrong[:, 1:] & wrong[:, :-1]).sum()
    scattered = touching <= 0.5 * count
    if bright > 0.9:
        at_edge = (np.abs(over[wrong]) == 4).mean() > 0.5
        return "fireflies" if scattered and not at_edge else "false highlights"
    if bright < 0.1 and count < 0.01 * judged:
        return "missing pixels" if scattered else "missing highlights"
    return SHAPE


def _guess(evidence: Evidence) -> str:
    """Say what blocks that changed look like."""
    changes = evidence.change[evidence.changed]
    if not changes.size:
        return SHAPE
    low, middle, high = np.percentile(changes, (10, 50, 90))
    return EXPOSURE if high - low < 0.5 * abs(middle) else LOBE


def _estimate(result: Comparison) -> str:
    """Say by how much the image is brighter, and where it lies."""
    gain = f"gain {1.0 + result.gain:.4g}" if result.encoding == "linear" else ""
    x, y = result.shift
    moved = f"shift ({x:.2g}, {y:.2g})" if max(abs(x), abs(y)) > _SEEN else ""
    said = ", ".join(filter(None, (gain, moved)))
    return f" ({said})" if said else ""


def _texture(change: float) -> str:
    return "noise, other normals or values of fewer bits" if change > 0.0 else "a blur, other maps"


def _signed(value: float) -> str:
    return f"{value:+.2g}" if abs(value) < 10.0 else f"{value:+.0f}"
