"""Compare two renders: detect broken highlights, and pass differences between drivers.

Images are arrays, frames or files. This module does not use OpenGL. The checks detect:

point      a few pixels that differ more than their neighbourhood explains
block      a changed mean of 16 x 16 pixels
trend      many blocks that changed slightly and in the same direction
grain      more or less noise between adjacent pixels
texture    more or less fine detail
coverage   another mesh or camera
shift      another camera
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.blocks import BLOCK, SCALES, BlockStatistics, BlockSums
from facerender.comparison.neighbourhoods import (
    EDGE,
    FULL,
    MARGIN,
    ROUGH,
    SLIVER,
    SLIVERS,
    SMOOTH,
    Float,
    Mask,
    difference,
    excess,
    filtered,
    gaps,
    holes,
    shrunk,
)
from facerender.comparison.result import LIMITS, Comparison, Limits
from facerender.comparison.sources import Comparable, alike, as_image, check_finite, size_of
from facerender.comparison.verdict import changes_of, reasons_of
from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_known, warn
from facerender.images.decode import MAX_BYTES
from facerender.images.image import Encoding, ImageData
from facerender.images.read import REFUSED, SUFFIXES
from facerender.system.files import check_file

Driver = Literal["auto", "same", "other"]

FADED = 0.2  # smallest change of a pixel's coverage that counts
_STRIP = 1 << 18  # pixels that are compared at once, so that they fit the processor's cache
_LOOSER = 3.0  # standard error added to each block, per unit of block limit above the default
_HALO = 8  # rows above and below a strip, with which the strip's pixels are also compared


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
    a, b = alike(as_image(reference, "A"), as_image(image, "B"))
    check_finite(a)
    check_finite(b)
    if jpegs := [data.name for data in (a, b) if data.jpeg]:
        warn(f"{' and '.join(jpegs)}: the losses of JPEG count as differences; save as PNG")
    counts = None if mask is None else _counting(mask, a)
    overrides = {"point": point, "block": block, "trend": trend, "grain": grain}
    overrides |= {"texture": texture, "coverage": coverage, "shift": shift}
    changed = {name: limit for name, limit in overrides.items() if limit is not None}
    limits = replace(LIMITS[a.encoding], **changed)
    strip = _Strip.of_all(a, b, counts, limits)
    statistics = BlockStatistics(
        sums=strip.sums,
        scale=SCALES[a.encoding],
        foreign=_foreign(driver, (a, b)),
        moved=limits.shift,
        allowed=max(a.noise, b.noise) if a.noise != b.noise else 0.0,
        looser=_LOOSER * max(limits.block - LIMITS[a.encoding].block, 0.0),
    )
    if driver == "auto" and statistics.foreign:
        same_edges = not (strip.over.any() or strip.faded)
        statistics = replace(statistics, foreign=not (same_edges and statistics.quiet))
    result = _result(a, counts, limits, strip, statistics)
    result = replace(result, metadata=changes_of(a.metadata, b.metadata))
    displayed = tuple(
        source if isinstance(source, Frame) else image
        for source, image in ((reference, a), (image, b))
    )
    reasons, cause = reasons_of(result, strip.over, statistics, (a, b))
    return replace(result, reasons=reasons, cause=cause, images=displayed)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and the result of comparing them: metrics, or an error."""

    name: str
    reference: ImageData | None  # None if the image could not be read
    image: ImageData | None
    comparison: Comparison | None  # metrics; None after an error
    error: str = ""

    @classmethod
    def of(
        cls,
        name: str,
        reference: Comparable,
        image: Comparable,
        limits: Mapping[Encoding, Mapping[str, float]] = MappingProxyType({}),
        **options: Any,
    ) -> Pair:
        """Compare two images; store the message of an ``InputError`` in ``error``.

        limits : limits for options that are None, keyed by the images' encoding
        options : options of :func:`compare`
        """
        images: list[ImageData | None] = [None, None]
        failure = ""
        for number, source in enumerate((reference, image)):
            try:
                images[number] = as_image(source, "AB"[number])
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
    """Return name, reference and image of two files, or of each image name in two folders.

    Raises
    ------
    InputError : one path is a file and the other a folder, or the folders contain no image
    """
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


def _result(
    image: ImageData, counts: Mask | None, limits: Limits, strip: _Strip, stats: BlockStatistics
) -> Comparison:
    """Return all metrics, without reasons; ``counts`` is the mask of the compared pixels."""
    height, width = image.pixels.shape[:2]
    counted = width * height if counts is None else int(counts.sum())
    blocks = np.nan_to_num(stats.channels)
    down, across = np.unravel_index(np.abs(blocks).argmax(), blocks.shape)
    return Comparison(
        reasons=(),
        encoding=image.encoding,
        size=(width, height),
        limits=limits,
        foreign=stats.foreign,
        point=strip.excess,
        point_at=strip.at,
        points=int(np.count_nonzero(np.abs(strip.over) > SLIVER)),
        slight=int(np.count_nonzero(strip.over)),
        holes=strip.holes,
        block=float(blocks[down, across]),
        block_at=(int(across) * BLOCK, int(down) * BLOCK),
        blocks=int((np.abs(blocks) > limits.block).sum()),
        blocks_judged=int(stats.judged.sum()),
        trend=stats.trend,
        z_score=stats.z_score,
        grain=stats.grain,
        texture=stats.texture,
        gain=stats.gain,
        shift=stats.shift,
        coverage=strip.faded / (width * height),
        largest=strip.largest,
        largest_at=strip.largest_at,
        mean=strip.total / counted,
    )


@dataclass(frozen=True)
class _Strip:
    """Metrics of some rows of two images."""

    sums: BlockSums
    over: NDArray[np.int8]  # (H, W), class of each pixel, see :func:`verdict.reasons_of`
    worst: float  # the largest unexplained difference of a pixel, minus the effect of a sliver
    excess: float  # reported difference of the worst pixel
    at: tuple[int, int]  # its position (x, y)
    holes: int  # number of dark pixels with bright neighbours in the other image
    faded: int  # number of pixels whose coverage changed
    largest: float  # maximum of the pixels' absolute differences, in the worst channel
    total: float  # their sum
    largest_at: tuple[int, int]

    @classmethod
    def of_all(cls, a: ImageData, b: ImageData, counts: Mask | None, limits: Limits) -> _Strip:
        """Return the metrics of all rows, computed strip by strip in threads."""
        height, width = a.pixels.shape[:2]
        step = max(_STRIP // width // BLOCK, 1) * BLOCK

        def strip_at(top: int) -> _Strip:
            return cls.of(a, b, counts, slice(top, min(top + step, height)), limits)

        with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
            strips = list(pool.map(strip_at, range(0, height, step)))
        farthest = max(strips, key=lambda strip: strip.largest)
        return replace(
            max(strips, key=lambda strip: strip.worst),
            sums=BlockSums.joined([strip.sums for strip in strips]),
            over=np.concatenate([strip.over for strip in strips]),
            holes=sum(strip.holes for strip in strips),
            faded=sum(strip.faded for strip in strips),
            largest=farthest.largest,
            largest_at=farthest.largest_at,
            total=sum(strip.total for strip in strips),
        )

    @classmethod
    def of(
        cls, a: ImageData, b: ImageData, counts: Mask | None, rows: slice, limits: Limits
    ) -> _Strip:
        """Return the metrics of ``rows``; ``counts`` is the mask of the whole images."""
        outer = slice(max(rows.start - _HALO, 0), min(rows.stop + _HALO, a.pixels.shape[0]))
        inner = slice(rows.start - outer.start, rows.stop - outer.start)
        (color_a, alpha_a), (color_b, alpha_b) = a.rows(outer), b.rows(outer)
        relative = a.encoding == "linear"
        counted = np.ones(alpha_a.shape, dtype=bool) if counts is None else counts[outer]
        full = (alpha_a >= FULL) & (alpha_b >= FULL)
        all_full = bool(full.all())
        covered = None if all_full else full
        differences = excess(color_a, color_b, covered, limits.point, relative)
        black = holes(color_a, color_b, covered, relative)
        if not all_full:
            black |= gaps(alpha_a, alpha_b)
        value = np.where(counted, differences.value, np.float32(0.0))[inner]
        slack = differences.slack[inner]
        beyond = np.where(value != 0.0, np.abs(value) - slack, np.float32(0.0))
        sliver = SLIVERS[a.encoding]
        # The first condition that holds gives the class of a pixel.
        conditions = [np.abs(value) <= limits.point, beyond <= limits.point]
        conditions += [slack >= np.float32(sliver.edge), slack > 0.25 * sliver.rough]
        classes = np.sign(value) * np.select(conditions, [0, SLIVER, EDGE, ROUGH], SMOOTH)
        row, column = np.unravel_index(beyond.argmax(), beyond.shape)
        worst = max(beyond[row, column], 0.0)
        worst = abs(value[row, column]) if worst > limits.point else worst
        inside = shrunk(full & counted, 0 if all_full and counts is None else MARGIN)
        faded = 0 if all_full else _faded(alpha_a, alpha_b, counted, inner)
        magnitude = difference(color_a[inner], color_b[inner]) * counted[inner]
        down, right = np.unravel_index(magnitude.argmax(), magnitude.shape)
        return cls(
            BlockSums.of(color_a, color_b, inside, inner, SCALES[a.encoding]),
            classes.astype(np.int8),
            float(beyond[row, column]),
            float(np.copysign(worst, value[row, column])),
            (int(column), rows.start + int(row)),
            int((black & counted)[inner].sum()),
            faded,
            float(magnitude[down, right]),
            float(magnitude.sum(dtype=np.float64)),
            (int(right), rows.start + int(down)),
        )


def _faded(a: Float, b: Float, counted: Mask, rows: slice) -> int:
    """Return the number of pixels whose coverage crossed 0.5, or lies more than FADED outside the
    range of the neighbourhood in the other image."""
    changed = (a >= 0.5) != (b >= 0.5)
    for x, y in ((a, b), (b, a)):
        low, high = (filtered(x, choose) for choose in (np.minimum, np.maximum))
        changed |= (y - high > FADED) | (low - y > FADED)
    return int((changed & counted)[rows].sum())


def _counting(mask: NDArray[Any], image: ImageData) -> Mask:
    """Return a mask as booleans, after checking it against the image."""
    counts: Mask = np.asarray(mask) != 0
    if counts.shape != image.pixels.shape[:2]:
        size = size_of(counts) if counts.ndim == 2 else f"of shape {counts.shape}"
        raise InputError(f"the mask is {size}, the images are {size_of(image.pixels)} pixels")
    if not counts.any():
        raise InputError("the mask is 0 everywhere: set it to 1 where images are compared")
    return counts


def _foreign(driver: Driver, images: tuple[ImageData, ImageData]) -> bool:
    """Return whether the images may differ as images of different drivers do.

    Drivers filter 8-bit textures differently. Images without such textures differ less.
    """
    if driver != "auto":
        return driver == "other"
    driver_a, driver_b = (
        [image.metadata.get(name) for name in ("GL_RENDERER", "GL_VERSION")] for image in images
    )
    named = driver_a == driver_b and driver_a[0] is not None
    return not named and any(image.metadata.get("textures") != "float" for image in images)
