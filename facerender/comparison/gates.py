"""Whether two renders are the same: gates that fail on a broken highlight and pass on what drivers
do differently. Images come from arrays, frames or files; nothing here needs OpenGL.

The point gate takes the largest excess of a pixel over the 3 x 3 neighbourhood in the other
image: it sees a few wrong pixels, and lets edges pass that moved by less than a pixel. At the
silhouette it allows four times as much. The block gate takes the largest change of the mean of
16 x 16 pixels inside the coverage, beyond what a twentieth of a pixel's shift explains: noise
averages out, and a lobe or a weight that changed stays. The third counts pixels whose coverage
changed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_range
from facerender.image import SUFFIXES, Encoding, Picture, picture_of, read_image

BLOCK = 16
MARGIN = 3  # pixels from the edge of the coverage, where a block does not look
# Times the limit of a pixel, at the silhouette: slivers of grazing light come and go there from
# driver to driver, by up to 0.19; the weakest false highlights measured there add 0.25.
SILHOUETTE = 4.0
FADED = 0.2  # excess of coverage that counts as changed
SHIFT = 0.05  # pixels by which drivers may place what they draw differently
FLOOR = 0.01  # radiance below which relative differences are taken of this
FULL = 0.99  # coverage from which a pixel is inside: half floats and filters miss 1
HIGHEST = 1e30  # of values, whose differences and sums are finite then
LEAST = 64  # pixels that a block needs to be judged
_STRIP = 16 * BLOCK  # rows that are compared at once
_HALO = MARGIN + 1  # rows beyond a strip that its pixels are compared with

SHAPE = "another shape, texture or light"

Float = NDArray[np.floating]
Mask = NDArray[np.bool_]
Comparable = Picture | Frame | NDArray[Any] | str | os.PathLike[str]


@dataclass(frozen=True)
class Limits:
    """What two images that count as the same may differ by.

    Attributes
    ----------
    point : excess of a pixel; radiance, or steps of 8 bits. At the silhouette four times as much
    block : change of a block's mean, less what a shift of 0.05 pixels explains; relative to that
        mean, 0.01 at least, or steps
    coverage : share of all pixels whose coverage changed, in [0, 1]
    """

    point: float
    block: float
    coverage: float = 0.005

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_range(f"limit {name}", value, 0.0, HIGHEST)


LIMITS: dict[Encoding, Limits] = {"linear": Limits(0.05, 5e-3), "srgb8": Limits(8.0, 1.0)}
# For float textures and one driver, where rounding is all that may differ.
STRICT = Limits(0.05, 1e-3)


@dataclass(frozen=True)
class Comparison:
    """The figures of every gate, and what they say. Positions are (x, y) from the top left.
    ``bool(comparison)`` is ``comparison.same``.

    Attributes
    ----------
    reasons : why the images differ, in words; empty where they are the same
    encoding : "linear" or "srgb8"; it gives the unit of point and block, as in :class:`Limits`
    limits : that the figures were held against
    point, point_at : excess of the worst pixel, negative where the image is darker, and where
    points : pixels over the limit
    block, block_at : change of the worst block's mean, and its top left pixel
    blocks, blocks_judged : blocks over the limit, and all that have enough pixels
    coverage : share of the pixels whose coverage changed; 0 without an alpha channel
    largest, mean : largest and mean absolute difference of any channel, for information
    """

    reasons: tuple[str, ...]
    encoding: Encoding
    size: tuple[int, int]
    limits: Limits
    point: float
    point_at: tuple[int, int]
    points: int
    block: float
    block_at: tuple[int, int]
    blocks: int
    blocks_judged: int
    coverage: float
    largest: float
    mean: float

    @property
    def same(self) -> bool:
        """Whether every gate was passed."""
        return not self.reasons

    def __bool__(self) -> bool:
        return self.same

    def as_dict(self) -> dict[str, Any]:
        """Return every figure, for JSON."""
        return {"same": self.same, **asdict(self)}

    def __str__(self) -> str:
        unjudged = "" if self.blocks_judged else ", but no block could be judged"
        return "; ".join(self.reasons) or f"same{unjudged}"


def compare(
    reference: Comparable,
    image: Comparable,
    *,
    point: float | None = None,
    block: float | None = None,
    coverage: float | None = None,
    mask: NDArray[Any] | None = None,
) -> Comparison:
    """Compare an image with its reference.

    Parameters
    ----------
    reference, image : a :class:`Frame`; an array (H, W, 3 or 4), linear float or 8-bit sRGB, its
        fourth channel being coverage; or the path of a .exr, .npz, .npy, .png or .jpg file
    point, block, coverage : limits of the gates, see :class:`Limits`; without, those of
        :data:`LIMITS` for the images' encoding. On one driver and with float textures a block limit
        of 1e-3 holds
    mask : (H, W), not 0 where the images count; without, everywhere. Every value must be finite

    Raises
    ------
    InputError : a file that cannot be read; sizes, channels or encodings that differ; a value that
        is not finite, with its place; a limit that is none
    """
    a, b = (as_picture(given, name) for given, name in ((reference, "A"), (image, "B")))
    _check_alike(a, b)
    _check_finite(a)
    _check_finite(b)
    height, width = a.pixels.shape[:2]
    counts = np.ones((height, width), dtype=bool) if mask is None else np.asarray(mask) != 0
    if counts.shape != (height, width):
        size = _size(counts) if counts.ndim == 2 else f"of shape {counts.shape}"
        raise InputError(f"the mask is {size}, the images are {_size(a.pixels)} pixels")
    if not counts.any():
        raise InputError("the mask is 0 everywhere: nothing would be compared")
    given = {"point": point, "block": block, "coverage": coverage}
    said = {name: value for name, value in given.items() if value is not None}
    limits = replace(LIMITS[a.encoding], **said)

    over = np.zeros((height, width), dtype=np.int8)
    full, silhouette = np.zeros((2, height, width), dtype=bool)
    means: list[NDArray[np.float64]] = []
    worst, point_at, excess_there = -1.0, (0, 0), 0.0
    changed, largest, total = 0, 0.0, 0.0
    for top in range(0, height, _STRIP):  # so that only the images themselves take much memory
        rows = slice(top, min(top + _STRIP, height))
        around = slice(max(top - _HALO, 0), min(top + _STRIP + _HALO, height))
        own = slice(top - around.start, rows.stop - around.start)
        (color_a, alpha_a), (color_b, alpha_b) = a.rows(around), b.rows(around)
        counted = counts[around]
        inner = (alpha_a >= FULL) & (alpha_b >= FULL)
        rim = _filtered(inner, np.maximum) & ~_filtered(inner, np.minimum)
        excess = np.where(counted, _excess(color_a, color_b), np.float32(0.0))
        relative = np.abs(excess) / np.where(rim, np.float32(SILHOUETTE), np.float32(1.0))
        change = _block_means(color_a, color_b, inner & counted, a.encoding, SHIFT, own)
        faded = np.abs(_excess(alpha_a[..., None], alpha_b[..., None])) > FADED
        faded |= (alpha_a >= 0.5) != (alpha_b >= 0.5)
        channels = range(color_a.shape[2])
        # Channel by channel: NumPy is slow along a short last axis.
        apart = np.maximum.reduce([np.abs(color_b[..., i] - color_a[..., i]) for i in channels])

        over[rows] = (np.sign(excess) * (relative > limits.point))[own]
        full[rows], silhouette[rows] = inner[own], rim[own]
        means.append(change)
        changed += int((faded & counted)[own].sum())
        difference = apart[own][counted[own]]
        largest = max(largest, float(difference.max(initial=0.0)))
        total += float(difference.sum(dtype=np.float64))
        row, column = np.unravel_index(relative[own].argmax(), relative[own].shape)
        if relative[own][row, column] > worst:
            worst, excess_there = relative[own][row, column], float(excess[own][row, column])
            point_at = int(column), top + int(row)
    blocks = np.concatenate(means)
    across, down = np.unravel_index(np.abs(np.nan_to_num(blocks)).argmax(), blocks.shape)[::-1]
    result = Comparison(
        reasons=(),
        encoding=a.encoding,
        size=(width, height),
        limits=limits,
        point=excess_there,
        point_at=point_at,
        points=int(np.count_nonzero(over)),
        block=float(np.nan_to_num(blocks[down, across])),
        block_at=(int(across) * BLOCK, int(down) * BLOCK),
        blocks=int((np.abs(blocks) > limits.block).sum()),
        blocks_judged=int(np.isfinite(blocks).sum()),
        coverage=changed / (height * width),
        largest=largest,
        mean=total / int(counts.sum()),
    )
    return replace(result, reasons=_reasons(result, over, full, silhouette, blocks))


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images and what comparing them gave: figures, or the error that made it impossible.

    Attributes
    ----------
    name : of the pair
    reference, image : None where it could not be read
    comparison, error : one of the two
    """

    name: str
    reference: Picture | None
    image: Picture | None
    comparison: Comparison | None
    error: str = ""

    @classmethod
    def of(cls, name: str, reference: Comparable, image: Comparable, **options: Any) -> Pair:
        """Compare two images; the options are those of :func:`compare`."""
        pictures: list[Picture | None] = []
        errors = []
        for given, letter in ((reference, "A"), (image, "B")):
            try:
                pictures.append(as_picture(given, letter))
            except InputError as error:
                pictures.append(None)
                errors.append(str(error))
        a, b = pictures
        if a is None or b is None:
            return cls(name, a, b, None, errors[0])
        try:
            return cls(name, a, b, compare(a, b, **options))
        except InputError as error:
            return cls(name, a, b, None, str(error))

    @property
    def status(self) -> int:
        """0 the same, 1 they differ, 2 they cannot be compared."""
        return 2 if self.comparison is None else int(not self.comparison.same)

    def as_dict(self) -> dict[str, Any]:
        """Return name, error and every figure, for JSON."""
        figures = {} if self.comparison is None else self.comparison.as_dict()
        return {"name": self.name, "error": self.error, **figures}


def pairs_of(a: str | os.PathLike[str], b: str | os.PathLike[str]) -> list[tuple[str, Path, Path]]:
    """Return name, reference and image of two files, or of every image in two folders.

    Raises
    ------
    InputError : a file and a folder, or folders without an image
    """
    a, b = Path(a), Path(b)
    if a.is_dir() != b.is_dir():
        raise InputError(f"one of {a} and {b} is a folder: give two folders, or two images")
    if not a.is_dir():
        return [(b.name, a, b)]
    names = {
        path.relative_to(folder).as_posix()
        for folder in (a, b)
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES
    }
    if not names:
        raise InputError(f"no image in {a} and {b}: give folders of {', '.join(SUFFIXES)} files")
    return [(name, a / name, b / name) for name in sorted(names)]


def as_picture(given: Comparable, name: str) -> Picture:
    """Return the image as pixels, whatever it was given as; name serves for errors."""
    if isinstance(given, Picture):
        return given
    if isinstance(given, Frame):
        return Picture(given.linear, "linear", name, given.metadata)
    if isinstance(given, (str, os.PathLike)):
        return read_image(given)
    return picture_of(np.asarray(given), name)


def point_error(a: Float, b: Float) -> float:
    """Return the largest excess of a pixel over the 3 x 3 neighbourhood in the other image, either
    way; a and b are (H, W, 3)."""
    return float(np.abs(_excess(a, b)).max())


def block_error(a: Float, reference: Float, coverage: Float) -> float:
    """Return the largest change of the mean of 16 x 16 pixels, relative to it, or to 0.01.

    Parameters
    ----------
    a, reference : (H, W, 3) linear
    coverage : (H, W) in [0, 1]; only pixels at least 3 inside of full coverage count, and blocks
        with at least 64 of them
    """
    means = _block_means(reference, a, coverage >= FULL, "linear")
    return float(np.abs(np.nan_to_num(means)).max(initial=0.0))


def _check_alike(a: Picture, b: Picture) -> None:
    if a.pixels.shape[:2] != b.pixels.shape[:2]:
        raise InputError(
            f"{a.name} is {_size(a.pixels)}, {b.name} is {_size(b.pixels)} pixels: render both at "
            "one size"
        )
    if a.encoding != b.encoding:
        kinds = {"linear": "linear float", "srgb8": "8-bit sRGB"}
        raise InputError(
            f"{a.name} is {kinds[a.encoding]}, {b.name} is {kinds[b.encoding]}: give two of a kind"
        )
    if a.pixels.shape[2] != b.pixels.shape[2]:
        counts = (f"{x.name} has {x.pixels.shape[2]} channels" for x in (a, b))
        raise InputError(f"{', '.join(counts)}: save both with alpha, or both without")
    if a.color_space != b.color_space:
        spaces = (f"{x.name} is in colour space {x.color_space or 'none named'}" for x in (a, b))
        raise InputError(f"{', '.join(spaces)}: convert one")


def _check_finite(picture: Picture) -> None:
    if picture.encoding == "srgb8":
        return
    good = np.abs(picture.pixels) <= np.float32(HIGHEST)  # which half floats would not hold
    if good.all():
        return
    row, column, channel = np.unravel_index(int(good.argmin()), good.shape)
    nans, infinite = (int(test(picture.pixels).sum()) for test in (np.isnan, np.isinf))
    what = f"{nans} NaN and {infinite} infinite values"
    if not nans + infinite:
        what = f"values beyond {HIGHEST:g}"
    raise InputError(
        f"{picture.name} holds {what}, the first at pixel ({column}, {row}), channel {channel}: "
        "mend what drew it"
    )


def _size(pixels: NDArray[Any]) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]}"


def _filtered(x: NDArray[Any], choose: Callable[..., NDArray[Any]]) -> NDArray[Any]:
    """Apply np.maximum or np.minimum over 3 x 3 pixels, those beyond the border left out."""
    for axis in (0, 1):
        y = np.moveaxis(x, axis, 0)
        x = x.copy()
        z = np.moveaxis(x, axis, 0)
        choose(z[1:], y[:-1], out=z[1:])
        choose(z[:-1], y[1:], out=z[:-1])
    return x


def _excess(a: Float, b: Float) -> Float:
    """Return (H, W): how far the worse channel leaves the neighbourhood in the other image; below 0
    where b is the darker one."""
    result = np.zeros(a.shape[:2], dtype=np.float32)
    for channel in range(a.shape[2]):
        x, y = (np.ascontiguousarray(image[..., channel]) for image in (a, b))
        brighter = np.maximum(y - _filtered(x, np.maximum), _filtered(y, np.minimum) - x)
        darker = np.maximum(x - _filtered(y, np.maximum), _filtered(x, np.minimum) - y)
        worse = np.where(brighter > darker, brighter, -darker)
        worse[np.maximum(brighter, darker) <= 0.0] = 0.0
        result = np.where(np.abs(worse) > np.abs(result), worse, result)
    return result


def _block_means(
    a: Float,
    b: Float,
    covered: Mask,
    encoding: Encoding,
    shift: float = 0.0,
    rows: slice = slice(None),
) -> NDArray[np.float64]:
    """Return how each block's mean changed, in its worst channel; NaN where too few of its pixels
    lie inside the coverage.

    shift : pixels, along rows and columns; what so small a shift explains is taken off
    rows : that count; the others lie around them
    """
    inside = covered
    for _ in range(MARGIN):
        inside = _filtered(inside, np.minimum)
    inside = inside[rows]
    count = _block_sums(inside)
    worst = np.zeros(count.shape)
    for channel in range(a.shape[2]):
        whole = np.ascontiguousarray(a[..., channel])
        x, y = whole[rows], b[rows, :, channel]
        of = np.maximum(count, 1.0)
        if encoding == "linear":
            of = np.maximum(_block_sums(np.abs(x) * inside), FLOOR * of)
        change = _block_sums((y - x) * inside) / of
        if shift:
            slopes = (
                np.diff(whole, axis=axis, append=whole.take([-1], axis))[rows] for axis in (0, 1)
            )
            explained = sum(np.abs(_block_sums(slope * inside)) for slope in slopes)
            change = np.sign(change) * np.maximum(np.abs(change) - shift * explained / of, 0.0)
        worst = np.where(np.abs(change) > np.abs(worst), change, worst)
    worst[count < LEAST] = np.nan
    return worst


def _block_sums(values: NDArray[Any]) -> NDArray[np.float64]:
    height, width = (-(-side // BLOCK) for side in values.shape)
    padding = [(0, height * BLOCK - values.shape[0]), (0, width * BLOCK - values.shape[1])]
    blocks = np.pad(values, padding).reshape(height, BLOCK, width, BLOCK)
    return np.asarray(blocks.sum(axis=(1, 3), dtype=np.float64))


def _reasons(
    result: Comparison, over: NDArray[np.int8], full: Mask, silhouette: Mask, means: Float
) -> tuple[str, ...]:
    """Say why the images differ, and what that looks like.

    over : (H, W), 1 where a pixel is too bright, -1 where it is too dark
    """
    limits = result.limits
    reasons = []
    like = ""
    if result.points:
        wrong = over != 0
        bright = float((over > 0).sum()) / result.points
        grazing = silhouette
        for _ in range(MARGIN - 1):
            grazing = _filtered(grazing, np.maximum)
        at_edge = grazing[wrong].mean() > 0.5
        where = " at the silhouette" if at_edge else ""
        touching = (wrong[1:] & wrong[:-1]).sum() + (wrong[:, 1:] & wrong[:, :-1]).sum()
        scattered = touching <= 0.5 * result.points
        if bright > 0.9:
            like = "fireflies" if scattered and not at_edge else "false highlights"
        elif bright < 0.1 and result.points < 0.01 * full.sum():
            like = "missing pixels" if scattered else "missing highlights"
        else:
            like = SHAPE
        plural = "" if result.points == 1 else "s"
        by = _amount(result.point, result.encoding)
        reasons.append(
            f"{result.points} pixel{plural} over by up to {by}{where}, worst {result.point_at}, "
            f"limit {limits.point:g}: looks like {like}"
        )
    if result.blocks:
        judged = means[np.isfinite(means)]
        low, middle, high = np.percentile(judged, (10, 50, 90))
        explained = _block_sums(over != 0)[np.abs(means) > limits.block].all()
        if abs(middle) > limits.block and high - low < 0.5 * abs(middle):
            guess = "exposure, light or colour space"
        elif result.points and (explained or like == SHAPE):
            guess = like
        else:
            guess = "a lobe or weight change"
        mean, limit = (
            (f"{_signed(100.0 * result.block)} %", f"{100.0 * limits.block:g} %")
            if result.encoding == "linear"
            else (f"{_signed(result.block)} of 255", f"{limits.block:g}")
        )
        reasons.append(
            f"block {result.block_at}: mean {mean}, limit {limit}, {result.blocks} of "
            f"{result.blocks_judged} blocks over: looks like {guess}"
        )
    if result.coverage > limits.coverage:
        reasons.append(
            f"coverage changed on {100.0 * result.coverage:.2g} % of the pixels, limit "
            f"{100.0 * limits.coverage:g} %: looks like another mesh or camera"
        )
    return tuple(reasons)


def _signed(value: float) -> str:
    return f"{value:+.2g}" if abs(value) < 10.0 else f"{value:+.0f}"


def _amount(value: float, encoding: Encoding) -> str:
    return f"{abs(value):.2g}" if encoding == "linear" else f"{abs(value):.0f} of 255"
