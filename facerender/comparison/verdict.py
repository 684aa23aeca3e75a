"""Reasons of a difference as text: the failed check, its metric and limit, and a likely cause.

The first reason has the cause that explains most of the change. Changed metadata replace a cause.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.blocks import BLOCK, FLOOR, BlockStatistics, block_sums, cell_sums
from facerender.comparison.causes import EXPOSURE, GEOMETRY, LIGHT, Change, cause_of, strips
from facerender.comparison.checks import decimal
from facerender.comparison.neighbourhoods import EDGE, FULL, ROUGH, SLIVER, SMOOTH, Mask, filtered
from facerender.comparison.result import BLUR, HOLES, Comparison
from facerender.errors import number_of
from facerender.images.image import ImageData

# Largest unexplained difference of a single pixel, keyed by the class of the pixel.
_LONE = {
    "linear": {SMOOTH: 0.0, ROUGH: 0.1, EDGE: 0.5},
    "srgb8": {SMOOTH: 0.0, ROUGH: 53.0, EDGE: 90.0},
}
_LONG = 60  # longer values of the metadata are cut to this number of characters
_SEPARATOR = re.compile(r"[;,] (?![^(]*\))")  # of the entries of a metadata value, such as a mesh's
_FIELD = re.compile(r"(\w+)=((?:\([^()]*\)|'[^']*'|[^,()])+)")  # of a value such as Light(m=1)
SAMPLES = "drivers that place samples differently: compare with one sample"


def reasons_of(
    result: Comparison,
    over: NDArray[np.int8],
    statistics: BlockStatistics,
    images: tuple[ImageData, ImageData],
) -> tuple[tuple[str, ...], str]:
    """Return the reasons of a difference, and its likely cause, or "metadata".

    over : (H, W), class of each pixel that exceeds the point limit: SLIVER, SMOOTH, ROUGH or EDGE,
        negative if the pixel is too dark. Other pixels: 0
    images : reference and image, whose pixels and metadata reveal the cause
    """
    wrong = _wrong(result, over)
    block = _block_change(result, images)
    holes = not wrong.any() and result.holes > HOLES
    subtle = "" if wrong.any() or block or holes else _subtle_change(result)
    uncovered = result.coverage > result.limits.coverage
    if not (wrong.any() or block or holes or subtle or uncovered):
        return (), ""
    height, width = over.shape
    rows = strips(height, width, result.point_at[1], result.block_at[1])
    change = Change.between(*images, rows)
    cause = GEOMETRY if uncovered else cause_of(change)
    several = all(image.metadata.get("samples", "1") != "1" for image in images)
    affected = uncovered or "texture" in subtle or (wrong.any() and _at_edge(over[wrong]))
    if several and "GL_RENDERER" in result.metadata and affected:
        cause = SAMPLES

    def because(likely: str) -> str:
        explained = result.scene_changed and likely == cause
        return "" if explained else f": perhaps {likely}"

    reasons = [f"{block}{because(cause)}{_estimate(result, cause)}"] if block else []
    reasons += [f"{subtle}{because(cause)}"] if subtle else []
    fault = ""
    if wrong.any():
        examined = np.concatenate([wrong[strip] for strip in rows])
        dominant = change.share(examined) > 0.5
        fault = _fault(result, over, wrong) if dominant or _lonely(change, examined) else ""
        if cause == SAMPLES or (fault == "false highlights" and cause in (LIGHT, EXPOSURE)):
            fault = ""
        failing = np.abs(np.nan_to_num(statistics.channels)) > result.limits.block
        wrong_sums = block_sums(cell_sums(wrong.astype(np.float32)))
        if fault and block and wrong_sums[failing].all():
            reasons = [f"{block}{because(fault)}{_estimate(result, fault)}"]
        text = f"{_pixels(result, over[wrong])}{because(fault or cause)}"
        reasons.insert(0 if dominant else len(reasons), text)
    elif holes:
        fault = "" if cause == GEOMETRY else "missing pixels"
        reasons.append(
            f"holes: {result.holes} pixels have less than a quarter of their neighbours' light or "
            f"no coverage, limit {HOLES}{because(fault or cause)}"
        )
    if uncovered:
        reasons.append(
            f"coverage changed on {decimal(100.0 * result.coverage)} % of the pixels, limit "
            f"{decimal(100.0 * result.limits.coverage, 6)} %{because(cause)}"
        )
    first = f"{reasons[0]}{result.facts}"
    named = fault if fault and f"perhaps {fault}" in first else cause
    return (first, *reasons[1:]), "metadata" if result.scene_changed else named


def changes_of(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return both texts of all metadata that changed, keyed by name and, for a value such as
    Light(azimuth=1), also by the name of the changed field."""
    changes = {}
    for key in one:
        if other.get(key, one[key]) == one[key]:
            continue
        fields = [dict(_FIELD.findall(text)) for text in (one[key], other[key])]
        kinds = {text.partition("(")[0] for text in (one[key], other[key])}
        if len(kinds) > 1 or not all(fields):
            changes[key] = _apart(one[key], other[key]), _apart(other[key], one[key])
            continue
        for name in dict.fromkeys([*fields[0], *fields[1]]):
            values = [_plain(image_fields.get(name, "default")) for image_fields in fields]
            if values[0] != values[1]:
                changes[f"{key} {name}"] = values[0], values[1]
    return changes


def _plain(value: str) -> str:
    """Return one number in place of three equal ones."""
    return re.sub(r"^\((\S+), \1, \1\)$", r"\1", value)[:_LONG]


def _apart(value: str, counterpart: str) -> str:
    """Return the beginning of a value, without the entries that another value has too."""
    entries = _SEPARATOR.split(counterpart)
    text = ", ".join(entry for entry in _SEPARATOR.split(value) if entry not in entries)
    return text[:_LONG] or "none"


def _wrong(result: Comparison, over: NDArray[np.int8]) -> Mask:
    """Return a mask of the pixels that fail: clearly different pixels, or too many slivers.

    A single clearly different pixel fails only if its difference exceeds _LONE.
    """
    place = np.abs(over)
    lone = result.points and abs(result.point) > _LONE[result.encoding][int(place.max())]
    if result.points > 1 or lone:
        return place > SLIVER
    return (place > 0) & (result.slight > result.sliver_limit)


def _pixels(result: Comparison, over: NDArray[np.int8]) -> str:
    """Describe the wrong pixels; ``over`` has their classes, see :func:`reasons_of`."""
    pixels = f"{len(over)} pixel{' differs' if len(over) == 1 else 's differ'}"
    if (np.abs(over) == SLIVER).any():
        return f"slivers: {pixels} like slivers at edges, limit {result.sliver_limit:.0f}"
    point = abs(result.point)
    amount = decimal(point) if result.encoding == "linear" else f"{point:.0f} of 255"
    at_edge = " at edges" if _at_edge(over) else ""
    return (
        f"point: {pixels} from the surroundings in the other image by up to {amount}{at_edge}, "
        f"worst at {result.point_at}, limit {decimal(result.limits.point, 6)}"
    )


def _block_change(result: Comparison, images: tuple[ImageData, ImageData]) -> str:
    """Describe the blocks over the block limit, or else the trend over its limit; "" if neither."""
    limits = result.limits
    if not result.blocks:
        limit = decimal(result.limit_factor * limits.trend, 6)
        text = f"trend {decimal(result.trend)}, limit {limit}: neighbouring blocks changed alike"
        return text if result.changed_alike else ""
    relative = result.encoding == "linear"
    factor, unit = (100.0, " %") if relative else (1.0, " of 255")
    plain = _mean_change(result, images)
    mean = f"{decimal(factor * plain, sign=True)}{unit}"
    if abs(plain) <= limits.block:
        remaining = decimal(factor * result.block, sign=True)
        mean += f", or {remaining}{unit} without edges and displacement"
    return (
        f"block at {result.block_at}: mean {mean}, limit "
        f"{decimal(factor * limits.block, 6)}{unit * relative}, "
        f"exceeded by {result.blocks} of {number_of(result.blocks_judged, 'block')}"
    )


def _mean_change(result: Comparison, images: tuple[ImageData, ImageData]) -> float:
    """Return the change of the mean of the worst block's covered pixels, in the worst channel: a
    fraction of the mean, or 8-bit levels."""
    x, y = result.block_at
    parts = [image.rows(slice(y, y + BLOCK)) for image in images]
    full = np.minimum(*(alpha[:, x : x + BLOCK] for _, alpha in parts)) >= FULL
    mean_a, mean_b = (
        color[:, x : x + BLOCK][full].mean(axis=0, dtype=np.float64) for color, _ in parts
    )
    change = mean_b - mean_a
    if result.encoding == "linear":
        change /= np.maximum(np.abs(mean_a), FLOOR)
    return float(max(change, key=abs))


def _subtle_change(result: Comparison) -> str:
    """Describe a failure of the checks of grain, texture and shift; "" if there is none. Other
    changes cause these failures too, so they are reported only if no other check fails."""
    limits, factor = result.limits, result.limit_factor
    grain, texture = factor * limits.grain, factor * limits.texture
    if not BLUR * -grain <= result.grain <= grain:
        scale, unit = (100.0, " %") if result.encoding == "linear" else (1.0, "")
        change = f"{decimal(scale * result.grain, sign=True)}{unit or ' of 255'}"
        return f"grain {change}, limit {decimal(scale * grain, 6)}{unit}"
    if not BLUR * -texture <= result.texture <= texture:
        change = decimal(100.0 * result.texture, sign=True)
        return f"texture {change} %, limit {decimal(100.0 * texture, 6)} %"
    x, y = result.shift
    moved = max(abs(x), abs(y)) > limits.shift
    return f"shift ({x:.2f}, {y:.2f}) pixels, limit {limits.shift:g}" if moved else ""


def _fault(result: Comparison, over: NDArray[np.int8], wrong: Mask) -> str:
    """Return the name of the fault of a few wrong pixels; "" if they have none in common."""
    count, judged = wrong.sum(), result.blocks_judged * BLOCK**2
    if count > 0.1 * judged > 0:
        return ""
    bright = (over[wrong] > 0).mean()
    touching = (wrong[1:] & wrong[:-1]).sum() + (wrong[:, 1:] & wrong[:, :-1]).sum()
    scattered = touching <= 0.5 * count
    if bright > 0.9:
        return "fireflies" if scattered and not _at_edge(over[wrong]) else "false highlights"
    if bright < 0.1 and count < 0.01 * judged:
        return "missing pixels" if scattered else GEOMETRY
    return ""


def _lonely(change: Change, wrong: Mask) -> bool:
    """Return whether the pixels around most wrong pixels hardly changed."""
    surroundings = filtered(np.where(wrong, np.float32(0.0), change.power), np.maximum)
    return bool(np.median((surroundings <= 0.02 * change.power)[wrong]) > 0.5)


def _at_edge(over: NDArray[np.int8]) -> bool:
    """Return whether most pixels lie at edges; ``over`` has their classes."""
    return bool((np.abs(over) == EDGE).mean() > 0.5)


def _estimate(result: Comparison, cause: str) -> str:
    """Return the image's gain as text if one factor explains the change, and its shift if the mesh
    or the camera may have changed."""
    x, y = result.shift
    linear = result.encoding == "linear"
    if cause == EXPOSURE and linear and abs(result.gain) > 5e-5:
        return f" (gain {round(1.0 + result.gain, 4):g})"
    if cause == GEOMETRY and max(abs(x), abs(y)) > 0.01:
        return f" (shift ({decimal(x)}, {decimal(y)}))"
    return ""
