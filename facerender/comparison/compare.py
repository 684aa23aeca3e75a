"""Compare two renders: detect broken highlights, and pass differences between drivers.

Images are arrays, frames or files. This module does not use OpenGL. ``sources.CHECKS`` has the
quantity that each check measures. A reason names the failed check, its metric and limit, and a
likely cause. The first reason has the cause that explains most of the change. Changed metadata
replace a cause."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import windows
from facerender.comparison.causes import EXPOSURE, GEOMETRY, LIGHT, Change, cause_of, strips
from facerender.comparison.result import BLUR, HOLES, LIMITS, Comparison
from facerender.comparison.sources import Comparable, as_image, both, decimal, size_of
from facerender.comparison.windows import BLOCK, EDGE, SLIVER, BlockStatistics, Mask, Strip
from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_known, number_of, warn
from facerender.images.files import MAX_BYTES, REFUSED, SUFFIXES, png_bytes
from facerender.images.image import Encoding, ImageData
from facerender.system.files import check_file, write_bytes

# Largest unexplained difference of a single pixel, keyed by the class of the pixel.
_LONE = {
    "linear": {windows.SMOOTH: 0.0, windows.ROUGH: 0.1, EDGE: 0.5},
    "srgb8": {windows.SMOOTH: 0.0, windows.ROUGH: 53.0, EDGE: 90.0},
}
_LONG = 60  # longer values of the metadata are cut to this number of characters
_SEPARATOR = re.compile(r"[;,] (?![^(]*\))")  # of the entries of a metadata value, such as a mesh's
_FIELD = re.compile(r"(\w+)=((?:\([^()]*\)|'[^']*'|[^,()])+)")  # of a value such as Light(m=1)
_Images = tuple[ImageData, ImageData]
SAMPLES = "drivers that place samples differently: compare with one sample"


def reasons_of(
    result: Comparison, over: NDArray[np.int8], statistics: BlockStatistics, images: _Images
) -> tuple[tuple[str, ...], str]:
    """Return the reasons of a difference, and its likely cause, or "metadata". ``over`` is the
    class of each pixel, (H, W), that exceeds the point limit: SLIVER, SMOOTH, ROUGH or EDGE,
    negative if the pixel is too dark; 0 for other pixels."""
    wrong = _wrong(result, over)
    block = _block_change(result, images)
    holes = not wrong.any() and result.holes > HOLES
    subtle = "" if wrong.any() or block or holes else _subtle_change(result)
    limits = result.limits
    uncovered = result.coverage > limits.coverage
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
        return "" if result.scene_changed and likely == cause else f": perhaps {likely}"

    reasons = [f"{block}{because(cause)}{_estimate(result, cause)}"] if block else []
    reasons += [f"{subtle}{because(cause)}"] if subtle else []
    fault = ""
    if wrong.any():
        examined = np.concatenate([wrong[strip] for strip in rows])
        dominant = change.share(examined) > 0.5
        around = windows.filtered(np.where(examined, np.float32(0.0), change.power), np.maximum)
        lonely = np.median((around <= 0.02 * change.power)[examined]) > 0.5  # hardly changed
        fault = _fault(result, over, wrong) if dominant or lonely else ""
        if cause == SAMPLES or (fault == "false highlights" and cause in (LIGHT, EXPOSURE)):
            fault = ""
        failing = np.abs(np.nan_to_num(statistics.channels)) > limits.block
        wrong_sums = windows.block_sums(windows.cell_sums(wrong.astype(np.float32)))
        if fault and block and wrong_sums[failing].all():
            reasons = [f"{block}{because(fault)}{_estimate(result, fault)}"]
        text = f"{_pixels(result, over[wrong])}{because(fault or cause)}"
        reasons.insert(0 if dominant else len(reasons), text)
    elif holes:
        fault = "" if cause == GEOMETRY else "missing pixels"
        lack = "less than a quarter of their neighbours' light or no coverage"
        text = f"holes: {result.holes} pixels have {lack}, limit {HOLES}"
        reasons.append(f"{text}{because(fault or cause)}")
    if uncovered:
        part, limit = decimal(100.0 * result.coverage), decimal(100.0 * limits.coverage, 6)
        reasons.append(
            f"coverage changed on {part} % of the pixels, limit {limit} %{because(cause)}"
        )
    first = f"{reasons[0]}{result.metadata_text}"
    named = fault if fault and f"perhaps {fault}" in first else cause
    return (first, *reasons[1:]), "metadata" if result.scene_changed else named


def changes_of(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Return both texts of all metadata that changed, keyed by name and, for a value such as
    Light(azimuth=1), also by the name of the changed field."""
    changes = {}
    for key, text in one.items():
        if other.get(key, text) == text:
            continue
        a, b = (dict(_FIELD.findall(value)) for value in (text, other[key]))
        if a and b and text.partition("(")[0] == other[key].partition("(")[0]:
            for name in {**a, **b}:
                # A colour of three equal numbers is stated as one number.
                value_a, value_b = (
                    re.sub(r"^\((\S+), \1, \1\)$", r"\1", values.get(name, "default"))[:_LONG]
                    for values in (a, b)
                )
                # 30 equals 30.0: version 0.1.0 stated whole numbers as the user gave them.
                if re.sub(r"\.0\b", "", value_a) != re.sub(r"\.0\b", "", value_b):
                    changes[f"{key} {name}"] = value_a, value_b
        else:
            entries = [_SEPARATOR.split(value) for value in (text, other[key])]
            only_a, only_b = (
                ", ".join(entry for entry in mine if entry not in theirs)[:_LONG] or "none"
                for mine, theirs in (entries, entries[::-1])
            )
            changes[key] = only_a, only_b
    return changes


def _wrong(result: Comparison, over: NDArray[np.int8]) -> Mask:
    """Return a mask of the pixels that fail: clearly different pixels, or too many slivers. A
    single clearly different pixel fails only if its difference exceeds _LONE."""
    classes = np.abs(over)
    lone = result.points and abs(result.point) > _LONE[result.encoding][int(classes.max())]
    if result.points > 1 or lone:
        return classes > SLIVER
    return (classes > 0) & (result.slight > result.sliver_limit)


def _pixels(result: Comparison, over: NDArray[np.int8]) -> str:
    """Describe the wrong pixels; ``over`` has their classes, see :func:`reasons_of`."""
    pixels = f"{len(over)} pixel{' differs' if len(over) == 1 else 's differ'}"
    if (np.abs(over) == SLIVER).any():
        return f"slivers: {pixels} like slivers at edges, limit {result.sliver_limit:.0f}"
    point = abs(result.point)
    amount = decimal(point) if result.encoding == "linear" else f"{point:.0f} of 255"
    at_edge = " at edges" if _at_edge(over) else ""
    limit = decimal(result.limits.point, 6)
    worst = f"{amount}{at_edge}, worst at {result.point_at}, limit {limit}"
    return f"point: {pixels} from the surroundings in the other image by up to {worst}"


def _block_change(result: Comparison, images: _Images) -> str:
    """Describe the blocks over the block limit, or else the trend over its limit; "" if neither."""
    limits = result.limits
    if not result.blocks:
        limit = decimal(result.limit_factor * limits.trend, 6)
        text = f"trend {decimal(result.trend)}, limit {limit}: neighbouring blocks changed alike"
        return text if result.changed_alike else ""
    relative = result.encoding == "linear"
    factor, unit = (100.0, " %") if relative else (1.0, " of 255")
    x, y = result.block_at
    rows, columns = slice(y, y + BLOCK), slice(x, x + BLOCK)
    parts = [[part[:, columns] for part in image.rows(rows)] for image in images]
    full = np.minimum(*(alpha for _, alpha in parts)) >= windows.FULL
    mean_a, mean_b = (color[full].mean(axis=0, dtype=np.float64) for color, _ in parts)
    scale = np.maximum(np.abs(mean_a), windows.FLOOR) if relative else 1.0
    plain = float(max((mean_b - mean_a) / scale, key=abs))  # in the channel that changed most
    mean = f"{decimal(factor * plain, sign=True)}{unit}"
    if abs(plain) <= limits.block:
        remaining = decimal(factor * result.block, sign=True)
        mean += f", or {remaining}{unit} without edges and displacement"
    limit = f"{decimal(factor * limits.block, 6)}{unit * relative}"
    over = f"exceeded by {result.blocks} of {number_of(result.blocks_judged, 'block')}"
    return f"block at {result.block_at}: mean {mean}, limit {limit}, {over}"


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


def _at_edge(over: NDArray[np.int8]) -> bool:
    """Return whether most pixels lie at edges; ``over`` has their classes."""
    return bool((np.abs(over) == EDGE).mean() > 0.5)


def _estimate(result: Comparison, cause: str) -> str:
    """Return the gain as text if it explains the change, or the shift if the geometry changed."""
    x, y = result.shift
    if cause == EXPOSURE and result.encoding == "linear" and abs(result.gain) > 5e-5:
        return f" (gain {round(1.0 + result.gain, 4):g})"
    if cause == GEOMETRY and max(abs(x), abs(y)) > 0.01:
        return f" (shift ({decimal(x)}, {decimal(y)}))"
    return ""


Driver = Literal["auto", "same", "other"]

_LOOSER = 3.0  # standard error added to each block, per unit of block limit above the default


def compare(
    reference: Comparable,
    image: Comparable,
    *,
    point: float | None = None,
    block: float | None = None,
    trend: float | None = None,
    grain: float | None = None,
    texture: float | None = None,
    coverage: float | None = None,
    shift: float | None = None,
    mask: NDArray[Any] | None = None,
    driver: Driver = "auto",
) -> Comparison:
    """Compare an image with its reference.

    Parameters
    ----------
    reference, image : a :class:`Frame`; an array (H, W, 3 or 4) of linear float or 8-bit sRGB with
        coverage as fourth channel; a Pillow image; or the path of a .exr, .npz, .npy, .png, .jpg,
        .webp, .tif, .gif, .bmp or .tga file
    point, block, trend, grain, texture, coverage, shift : limits of the checks, see
        :class:`Limits`; default: :data:`LIMITS` of the images' encoding. Two images that one
        driver drew with float textures pass a block limit of 1e-3
    mask : (H, W), nonzero for pixels that count; default: all pixels count
    driver : "same" or "other": whether one OpenGL driver drew both images; "auto": "same" if the
        images' metadata name one driver or say that all textures were float, or if linear images
        differ without noise between adjacent pixels and at no pixel of an edge; otherwise "other"

    Raises
    ------
    InputError : a file cannot be read; sizes, channels, encodings or colour spaces differ; a pixel
        is not finite; the mask has another size or is 0 everywhere; a limit or driver is invalid
    """
    check_known("driver", driver, get_args(Driver))
    a, b = both(reference, image)
    if jpegs := [data.name for data in (a, b) if data.jpeg]:
        warn(f"{' and '.join(jpegs)}: the losses of JPEG count as differences; save as PNG")
    counts = _counting(mask, a)
    overrides = {"point": point, "block": block, "trend": trend, "grain": grain}
    overrides |= {"texture": texture, "coverage": coverage, "shift": shift}
    changed = {name: limit for name, limit in overrides.items() if limit is not None}
    limits = replace(LIMITS[a.encoding], **changed)
    strip = Strip.of_all(a, b, counts, limits.point)
    statistics = BlockStatistics(
        sums=strip.sums,
        scale=windows.SCALES[a.encoding],
        foreign=_foreign(driver, a.metadata, b.metadata),
        moved=limits.shift,
        allowed=max(a.noise, b.noise) if a.noise != b.noise else 0.0,
        looser=_LOOSER * max(limits.block - LIMITS[a.encoding].block, 0.0),
    )
    if driver == "auto" and statistics.foreign:
        same_edges = not (strip.over.any() or strip.faded)
        statistics = replace(statistics, foreign=not (same_edges and statistics.quiet))
    height, width = counts.shape
    blocks = np.nan_to_num(statistics.channels)
    down, across = np.unravel_index(np.abs(blocks).argmax(), blocks.shape)
    of_pixels = ("point", "point_at", "holes", "largest", "largest_at")
    of_blocks = ("foreign", "trend", "z_score", "grain", "texture", "gain", "shift")
    result = Comparison(
        reasons=(),
        encoding=a.encoding,
        size=(width, height),
        limits=limits,
        points=int(np.count_nonzero(np.abs(strip.over) > SLIVER)),
        slight=int(np.count_nonzero(strip.over)),
        block=float(blocks[down, across]),
        block_at=(int(across) * BLOCK, int(down) * BLOCK),
        blocks=int((np.abs(blocks) > limits.block).sum()),
        blocks_judged=int(statistics.judged.sum()),
        coverage=strip.faded / (width * height),
        mean=strip.total / int(counts.sum()),
        metadata=changes_of(a.metadata, b.metadata),
        **{name: getattr(strip, name) for name in of_pixels},
        **{name: getattr(statistics, name) for name in of_blocks},
    )
    reasons, cause = reasons_of(result, strip.over, statistics, (a, b))
    # Notebooks display a frame of a term with its own colours.
    sources = ((reference, a), (image, b))
    displayed = tuple(frame if isinstance(frame, Frame) else data for frame, data in sources)
    return replace(result, reasons=reasons, cause=cause, images=displayed)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and the result of comparing them: metrics, or an error."""

    name: str
    reference: ImageData | None  # None if the image could not be read
    image: ImageData | None
    comparison: Comparison | None  # metrics; None after an error
    error: str = ""

    def save_heat_map(self, path: str | os.PathLike[str]) -> None:
        """Write the FLIP heat map of the pair as PNG."""
        from facerender.comparison.pictures import MAX_PIXELS, displayed, heat_map

        a, b = self.reference, self.image
        if a is None or b is None or a.pixels.shape[:2] != b.pixels.shape[:2]:
            raise InputError(f"no heat map: {self.error}")
        height, width = a.pixels.shape[:2]
        if height * width > MAX_PIXELS:
            limit = f"at most {MAX_PIXELS}; give smaller images"
            raise InputError(f"no heat map of {width} x {height} pixels: {limit}")
        heat = heat_map(displayed(a) / 255.0, displayed(b) / 255.0)
        write_bytes(path, png_bytes(heat, {}))

    @classmethod
    def of(
        cls,
        name: str,
        reference: Comparable,
        image: Comparable,
        limits: Mapping[Encoding, Mapping[str, float]] = MappingProxyType({}),
        anonymous: bool = False,
        **options: Any,
    ) -> Pair:
        """Compare two images with options of :func:`compare`; ``error`` has the message of an
        ``InputError``. If options are None, ``limits`` apply, keyed by the images' encoding. If
        ``anonymous`` is true, the images lose their names."""
        images: list[ImageData | None] = [None, None]
        failure = ""
        for number, source in enumerate((reference, image)):
            try:
                data = as_image(source, "AB"[number])
                images[number] = data.renamed(f"image {number + 1}") if anonymous else data
            except InputError as error:
                failure = failure or str(error)
        a, b = images
        if a is None or b is None:
            return cls(name, a, b, None, failure)
        try:
            overrides = {key: value for key, value in options.items() if value is not None}
            return cls(name, a, b, compare(a, b, **{**limits.get(a.encoding, {}), **overrides}))
        except InputError as error:
            return cls(name, a, b, None, str(error))

    @property
    def status(self) -> int:
        """0: the same, 1: different, 2: not comparable."""
        return 2 if self.comparison is None else int(not self.comparison.same)

    def as_dict(self) -> dict[str, Any]:
        """Return name, error and all metrics, for JSON."""
        metrics = {} if self.comparison is None else self.comparison.as_dict()
        return {"name": self.name, "error": self.error, **metrics}


def pairs_of(a: str | os.PathLike[str], b: str | os.PathLike[str]) -> list[tuple[str, Path, Path]]:
    """Return name, reference and image of two files, or of each image name in two folders."""
    a, b = Path(a), Path(b)
    if os.path.isdir(a) != os.path.isdir(b):
        check_file(b if os.path.isdir(a) else a, "an image file", MAX_BYTES)
        raise InputError(f"one of {a} and {b} is a folder: give two folders, or two images")
    if not os.path.isdir(a):
        return [(b.name, a, b)]
    names = {
        path.relative_to(folder).as_posix()
        for folder in (a, b)
        for path in folder.rglob("*")
        if path.suffix.lower() in (*SUFFIXES, *REFUSED)
    }
    if not names:
        raise InputError(f"no image in {a} and {b}: give folders of {', '.join(SUFFIXES)} files")
    return [(name, a / name, b / name) for name in sorted(names)]


def _counting(mask: NDArray[Any] | None, image: ImageData) -> Mask:
    """Return a mask of the pixels that count, after checking it against the image."""
    shape = image.pixels.shape[:2]
    counts: Mask = np.ones(shape, dtype=bool) if mask is None else np.asarray(mask) != 0
    if counts.shape != shape:
        size = size_of(counts) if counts.ndim == 2 else f"of shape {counts.shape}"
        raise InputError(f"the mask is {size}, the images are {size_of(image.pixels)} pixels")
    if not counts.any():
        raise InputError("the mask is 0 everywhere: set it to 1 where images are compared")
    return counts


def _foreign(driver: Driver, a: Mapping[str, str], b: Mapping[str, str]) -> bool:
    """Return whether images with these metadata may differ as images of different drivers do."""
    if driver != "auto":
        return driver == "other"
    if "GL_RENDERER" in a and all(a.get(k) == b.get(k) for k in ("GL_RENDERER", "GL_VERSION")):
        return False
    # Drivers filter 8-bit textures differently; images without such textures differ less.
    return any(metadata.get("textures") != "float" for metadata in (a, b))
