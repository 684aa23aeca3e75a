"""Pictures of several images: sheets, the difference of two images in colours, heat maps and FLIP
(Andersson et al. 2020), the difference that an observer sees when two images alternate.

The package flip_evaluator is imported where it is used."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from io import BytesIO
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.comparison.sources import Comparable, as_image, both, decimal
from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_range, quoted
from facerender.images.animation import arranged, text_band
from facerender.images.image import Encoding, ImageData, encode_srgb8, srgb_to_linear

if TYPE_CHECKING:
    from PIL.Image import Image


Pixels = NDArray[np.floating]  # (H, W, 3), sRGB in [0, 1]

PPD = 67.0206  # pixels per degree: 3840 pixels on 0.7 m, viewed from 0.7 m


def flip_errors(reference: Pixels, image: Pixels) -> NDArray[np.float64]:
    """Return the error of each pixel (H, W), in [0, 1]; its mean is the FLIP value of the image."""
    return np.asarray(_evaluate(reference, image, magma=False)[..., 0], dtype=np.float64)


def heat_map(reference: Pixels, image: Pixels, step: int = 1) -> NDArray[np.uint8]:
    """Return the errors as 8-bit colours (H, W, 3), from black through red to pale yellow. If the
    images contain every Nth pixel of larger images, with ``step`` N a pixel is N pixels wide."""
    colors = _evaluate(reference, image, magma=True, **({"ppd": PPD / step} if step > 1 else {}))
    return np.asarray(np.round(255.0 * colors.clip(0.0, 1.0)), dtype=np.uint8)


def check_flip_installed() -> None:
    """Raise InputError if the package flip-evaluator is missing."""
    if find_spec("flip_evaluator") is None:
        raise InputError("FLIP needs pip install 'facerender[measure]'")


def _evaluate(reference: Pixels, image: Pixels, magma: bool, **parameters: float) -> Any:
    check_flip_installed()
    from flip_evaluator import evaluate

    images = (pixels.astype(np.float32) for pixels in (reference, image))
    options = {"applyMagma": magma, "computeMeanError": False, "parameters": parameters}
    return evaluate(*images, "LDR", **options)[0]


MAX_PIXELS = 1 << 24  # largest number of pixels of an image that is displayed
HEAT = 1 << 17  # largest number of pixels of a page's heat map; FLIP takes 1.3 s for 2**20
LEVELS = 32  # number of colours of a difference, for each sign
DARKER, BRIGHTER, UNCOVERED = (74, 163, 255), (255, 148, 41), (190, 70, 255)
# Differences up to which the colour scale is linear.
FLOORS: dict[Encoding, float] = {"linear": 1e-3, "srgb8": 1.0}

_STRIP = 256  # rows that are converted at once

Bytes = NDArray[np.uint8]
Relief = NDArray[np.float64]  # (H, W)


def displayed(image: ImageData) -> Bytes:
    """Return an image as 8-bit sRGB."""
    pixels = np.empty((*image.pixels.shape[:2], 3), dtype=np.uint8)
    for rows in strips(image):
        color, _ = image.rows(rows)
        linear = image.encoding == "linear"
        pixels[rows] = encode_srgb8(color) if linear else np.round(color)
        if linear:
            pixels[rows][~np.isfinite(image.pixels[rows]).all(axis=-1)] = (255, 0, 255)
    return pixels


def thumbnail(image: ImageData, side: int) -> Bytes:
    """Return an image as 8-bit sRGB, scaled to at most ``side`` pixels in width and height."""
    from PIL import Image

    height, width = image.pixels.shape[:2]
    step = max(math.isqrt(height * width // MAX_PIXELS), 1)
    small = Image.fromarray(displayed(replace(image, pixels=image.pixels[::step, ::step])))
    small.thumbnail((side, side))
    return np.asarray(small)


def difference_colours(a: ImageData, b: ImageData) -> tuple[Bytes, float]:
    """Return the signed difference in the worst channel as colours, and the largest difference,
    which has the full colour. The scale is linear up to FLOORS and logarithmic above."""
    floor = FLOORS[a.encoding]
    signed = signed_difference(a, b)
    largest = float(np.abs(signed).max())
    scale = max(largest, floor)
    ramp = np.linspace(0.0, 1.0, LEVELS + 1)[:, None]
    colors = np.round([*(ramp[:0:-1] * DARKER), *(ramp * BRIGHTER)]).astype(np.uint8)
    levels = np.sign(signed) * np.log1p(np.abs(signed) / floor) / np.log1p(scale / floor)
    return _painted(a, b, levels, colors), largest


def _painted(a: ImageData, b: ImageData, levels: NDArray[np.floating], colors: Bytes) -> Bytes:
    """Return levels in [-1, 1] in colours (2 N + 1, 3), and violet if only the coverage differs."""
    pixels = np.empty((*levels.shape, 3), dtype=np.uint8)
    middle = len(colors) // 2
    for rows in strips(a):
        steps = np.round(levels[rows] * middle).astype(int)
        pixels[rows] = colors[steps + middle]
        covered_a, covered_b = (image.rows(rows)[1] >= 0.5 for image in (a, b))
        pixels[rows][(covered_a != covered_b) & (steps == 0)] = UNCOVERED
    return pixels


def signed_difference(a: ImageData, b: ImageData) -> NDArray[np.float32]:
    """Return b - a in the channel that differs most, (H, W)."""
    worst = np.empty(a.pixels.shape[:2], dtype=np.float32)
    for rows in strips(a):
        signed = b.rows(rows)[0] - a.rows(rows)[0]
        channel = np.abs(signed).argmax(axis=-1)[..., None]
        worst[rows] = np.take_along_axis(signed, channel, axis=-1)[..., 0]
    return worst


def strips(image: ImageData) -> Iterator[slice]:
    """Yield the rows of an image in strips, to save memory."""
    for top in range(0, len(image.pixels), _STRIP):
        yield slice(top, top + _STRIP)


def small_heat_map(a: Bytes, b: Bytes) -> Bytes:
    """Return a FLIP heat map of two displayed images, reduced to at most HEAT pixels: to the pixel
    of each cell that differs most, so that no firefly is lost."""
    step = math.ceil(math.sqrt(a[..., 0].size / HEAT))
    differences = np.maximum(a, b) - np.minimum(a, b)
    worst_a, worst_b = _worst(differences.sum(axis=-1, dtype=np.uint16), step, a, b)
    return heat_map(worst_a / 255.0, worst_b / 255.0, step)


def brightest(pixels: Bytes, limit: int) -> Bytes:
    """Reduce an image to at most ``limit`` pixels: to the brightest pixel of each cell."""
    step = math.ceil(math.sqrt(pixels[..., 0].size / limit))
    return _worst(pixels.max(axis=-1), step, pixels)[0]


def _worst(key: NDArray[Any], step: int, *images: Bytes) -> list[Bytes]:
    """Return images (H, W, 3), reduced to the pixel with the largest key (H, W) of each cell."""
    if step == 1:
        return [*images]
    height, width = (-(-side // step) for side in key.shape)
    padding = [(0, height * step - key.shape[0]), (0, width * step - key.shape[1])]

    def cells(pixels: NDArray[Any]) -> NDArray[Any]:
        pad_width = [*padding, *((0, 0) for _ in pixels.shape[2:])]
        padded = np.pad(pixels, pad_width, "edge")
        split = padded.reshape(height, step, width, step, *pixels.shape[2:]).swapaxes(1, 2)
        return split.reshape(height, width, step * step, *pixels.shape[2:])

    indices = cells(key).argmax(axis=-1)[..., None, None]
    return [np.take_along_axis(cells(image), indices, axis=2)[:, :, 0] for image in images]


def lossless(pixels: Bytes) -> tuple[bytes, str]:
    """Return pixels as a lossless file, and its format: WebP, or PNG if a side is too long."""
    from PIL import Image

    buffer, file_format = BytesIO(), "png" if max(pixels.shape) > 16383 else "webp"
    # Pillow's writer of PNG ignores the options of WebP.
    Image.fromarray(pixels).save(buffer, file_format, lossless=True, method=1, quality=0)
    return buffer.getvalue(), file_format


GAINS = (1e-3, 1e9)
_FITTED = 99.0  # percentile of the differences that is white, so that few outliers do not count
_NEGLIGIBLE = 1e-3  # smallest difference that counts for the percentile, relative to the largest
# Colours of the differences -1, -1/2, 0, 1/2 and 1, in units of the difference that is white.
_COLORS = ((222, 240, 255), DARKER, (0, 0, 0), BRIGHTER, (255, 240, 222))
_STEPS = 256  # number of colours of a difference, for each sign


def difference(reference: Comparable, image: Comparable, *, gain: float | None = None) -> Frame:
    """Return the signed difference of two images as a picture: orange where ``image`` is brighter,
    blue where it is darker, black where both are equal.

    Each pixel shows the channel that differs most. The colour scale is linear in light: from black
    to the full colour at half the scale, and to white at its end and above. Violet marks changed
    coverage with equal colour.

    Parameters
    ----------
    reference, image : as in :func:`compare`
    gain : a difference of 1/gain, or of 255/gain 8-bit levels, is white; in [1e-3, 1e9]. Default:
        the 99th percentile of the differences is white, without differences below 1/1000 of the
        largest

    Returns
    -------
    Frame : its ``metadata["difference"]`` is a title that names the scale, such as
        "B - A: orange +, blue -, white = 0.012", or "white = 3/255" for 8-bit images

    Raises
    ------
    InputError : a file cannot be read; sizes, channels, encodings or colour spaces differ; a pixel
        is not finite; gain is outside its range
    """
    if gain is not None:
        check_range("gain", gain, *GAINS)
    a, b = both(reference, image)
    signed = signed_difference(a, b)
    full = 1.0 if a.encoding == "linear" else 255.0
    if gain is None:
        differences = np.abs(signed)
        counted = differences[differences > _NEGLIGIBLE * differences.max()]
        fitted = float(np.percentile(counted, _FITTED)) if counted.size else full
        gain = min(max(full / fitted, GAINS[0]), GAINS[1])
    white = full / gain
    steps = np.arange(-_STEPS, _STEPS + 1) / _STEPS
    channels = srgb_to_linear(np.array(_COLORS) / 255.0).T
    ramp = [np.interp(steps, (-1.0, -0.5, 0.0, 0.5, 1.0), channel) for channel in channels]
    colors = encode_srgb8(np.stack(ramp, axis=-1).astype(np.float32))
    pixels = _painted(a, b, np.clip(signed / white, -1.0, 1.0), colors)
    unit = "" if a.encoding == "linear" else "/255"
    title = f"B - A: orange +, blue -, white = {decimal(white, 3)}{unit}"
    frame = _frame(pixels, {"difference": title})
    return _Difference(**vars(frame), pair=(a, b), gain=gain if signed.any() else math.inf)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class _Difference(Frame):
    """A difference with its images, and with its gain; equal images have an infinite gain."""

    pair: tuple[ImageData, ImageData]
    gain: float


def sheet(
    images: Iterable[Comparable | Image],
    titles: Sequence[str] | None = None,
    columns: int | None = None,
) -> Frame:
    """Return one picture with several images side by side. Transparent images lie on black. All
    differences have the scale of the largest one, which their titles state.

    Parameters
    ----------
    images : images of one size: frames, arrays, Pillow images or paths, as in :func:`compare`
    titles : one text for each image; default: the scale of a :func:`difference`, no other titles
    columns : number of images in a row; default: all, at most four

    Raises
    ------
    InputError : there is no image; the sizes differ; a file cannot be read; the number of titles
        or of columns is invalid; the sheet is too large
    """
    if isinstance(images, np.ndarray | str):  # would be a list of rows, or of letters
        raise InputError(f"images = {quoted(images)}: give a list of images")
    images = list(images)
    differences = {n: image for n, image in enumerate(images) if isinstance(image, _Difference)}
    gain = min((frame.gain for frame in differences.values()), default=math.inf)
    scaled = {
        n: frame if frame.gain == gain else difference(*frame.pair, gain=gain)
        for n, frame in differences.items()
    }
    images = [scaled.get(n, image) for n, image in enumerate(images)]
    cells: list[Bytes] = []
    for number, source in enumerate(images, 1):
        name = f"image {number}"
        if isinstance(source, Frame):  # a frame of a term has the colours of its PNG
            source = ImageData(source.srgb8(), "srgb8", name)
        cells.append(displayed(as_image(source, name)))
    if not cells:
        raise InputError("a sheet of 0 images: give at least one")
    for number, cell in enumerate(cells, 1):
        if cell.shape != cells[0].shape:
            sizes = (f"{width} x {height}" for height, width, _ in (cell.shape, cells[0].shape))
            remedy = "give images of one size"
            raise InputError(f"image {number} is {' pixels, image 1 is '.join(sizes)}: {remedy}")
    if titles is None:
        titles = [e.metadata.get("difference", "") if isinstance(e, Frame) else "" for e in images]
    texts = [titles] if isinstance(titles, str) else [*titles]
    if len(texts) != len(cells):
        raise InputError(f"titles: {len(texts)}, images: {len(cells)}; give one for each image")
    for n, frame in scaled.items():
        title = frame.metadata["difference"]
        text = texts[n].replace(differences[n].metadata["difference"], title)
        scale = title.rpartition(", ")[2]
        texts[n] = text if scale in text or not text else f"{text}, {scale}"
    if columns is not None:
        check_range("columns", columns, 1, len(cells))
    return _frame(arranged(cells, texts, columns), {})


def side_by_side(reference: Comparable, image: Comparable) -> Frame:
    """Return a sheet of A, B and their difference. For parameters see :func:`difference`."""
    a, b = (
        source if isinstance(source, Frame) else as_image(source, name)
        for source, name in ((reference, "A"), (image, "B"))
    )
    frame = difference(a, b)
    return sheet([a, b, frame], ["A", "B", frame.metadata["difference"]])


def _frame(pixels: NDArray[np.uint8], metadata: dict[str, str]) -> Frame:
    """Return 8-bit sRGB pixels (H, W, 3) as an opaque frame, whose ``srgb8()`` are these pixels."""
    radiance = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    linear = np.ones((*pixels.shape[:2], 4), dtype=np.float32)
    linear[..., :3] = radiance[pixels]
    return Frame(linear, None, False, metadata)


_STEEP, _OUTLIERS = 1.5, 0.02  # slope of surfaces that do not face the camera; percent of pixels
OUTWARDS, INWARDS = (214, 47, 39), (69, 117, 180)  # colours of a surface that moved


def changes(
    pairs: Sequence[tuple[Relief, Relief]],
    images: Sequence[Bytes],
    titles: Sequence[str],
    pixel: float,
    unit: str,
) -> tuple[Bytes, tuple[float, float]]:
    """Return a sheet (H, W, 3) of how far a surface moved between two images each, in colours of
    one scale: red outwards, blue inwards, and the full colour where one image shows a surface, and
    the other shows none nearby. The last cell is the scale. Return also the smallest and the
    largest distance of surfaces that face the camera, without a few outliers.

    pairs : heights (h, w) of the surface before and after, towards the camera; NaN for none
    images : (h, w, 3), whose brightness shades the colours
    pixel, unit : side of a pixel, in the unit of the heights; name of this unit
    """
    moved, low, high = [], 0.0, 0.0
    for before, after in pairs:
        # The distance of two parallel planes is their difference of height times the cosine of
        # their slope. Where one surface hides another, or ends, the nearest point counts.
        slopes = [np.hypot(*np.gradient(relief, pixel)) for relief in (before, after)]
        change = (after - before) / np.hypot(1.0, np.maximum(*slopes))
        vanished = np.isnan(after)
        change[np.isnan(before) & ~vanished], change[vanished & ~np.isnan(before)] = np.inf, -np.inf
        for query, goal, chosen in ((after, before, ~vanished), (before, after, vanished)):
            rows, columns = np.nonzero(chosen & (np.abs(change) > 2.0 * pixel))
            nearest = _nearest(query[rows, columns], rows, columns, goal, pixel)
            far = change[rows, columns]
            change[rows, columns] = np.sign(far) * np.fmin(np.abs(far), nearest)
        facing = change[np.isfinite(change) & (np.fmax(*slopes) < _STEEP)]
        if facing.size:
            ends = np.percentile(facing, (_OUTLIERS, 100.0 - _OUTLIERS)).tolist()
            low, high = min(low, ends[0]), max(high, ends[1])
        moved.append(change)
    largest = max(-low, high, 1e-3 * pixel)
    step = 10.0 ** math.floor(math.log10(largest))
    scale = next(
        step * factor for factor in (1.0, 2.0, 5.0, 10.0) if step * factor >= 0.99 * largest
    )
    cells = []
    for change, image in zip(moved, images, strict=True):
        shade = 0.6 + 0.4 * image.mean(axis=-1, keepdims=True) / 255.0
        cells.append(np.round(shade * _diverging(change / scale)).astype(np.uint8))
    height, width = moved[0].shape
    texts = (f"{scale:g} {unit} outwards", f"{scale / 2:g} {unit}", "0", f"-{scale / 2:g} {unit}")
    bands = []
    for number, text in enumerate((*texts, f"{scale:g} {unit} inwards")):
        label = text_band(text, width)[: height // 5]
        color = np.full((height // 5 - len(label), width, 3), _diverging(np.array(1 - number / 2)))
        bands += [label, color.astype(np.uint8)]
    legend = np.full((height, width, 3), 255, dtype=np.uint8)
    legend[: height // 5 * 5] = np.concatenate(bands)
    return arranged([*cells, legend], [*titles, "scale"]), (low, high)


def _nearest(heights: Relief, rows: Any, columns: Any, relief: Relief, pixel: float) -> Relief:
    """Return the distances (N,) of points at pixels from the nearest point of a relief that lies
    within 1/48 of its height; NaN if there is none."""
    step = max(len(relief) / 48.0 / 8.0, 1.0)
    offsets = np.unique(np.round(step * np.arange(-8, 9)).astype(int))
    padded = np.pad(relief, offsets[-1], constant_values=np.nan)
    nearest = np.full(len(rows), np.nan)
    for down, across in product(offsets, offsets):
        goal = padded[rows + offsets[-1] + down, columns + offsets[-1] + across]
        away = np.hypot(pixel * math.hypot(down, across), goal - heights)
        nearest = np.fmin(nearest, away)
    return nearest


def _diverging(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return colours (..., 3) of values from -1 to 1, with white at 0; NaN is white."""
    ends = np.array([INWARDS, (255, 255, 255), OUTWARDS], dtype=np.float64)
    levels = np.clip(np.nan_to_num(values, posinf=1.0, neginf=-1.0), -1.0, 1.0)
    channels = [np.interp(levels, (-1.0, 0.0, 1.0), channel) for channel in ends.T]
    return np.stack(channels, axis=-1)
