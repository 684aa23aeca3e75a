"""Pictures of several images: sheets, and the difference of two images in colours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import visualization
from facerender.comparison.checks import decimal
from facerender.comparison.sources import Comparable, alike, as_image, check_finite
from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_range, shown
from facerender.images.image import ImageData
from facerender.images.sheet import arranged
from facerender.images.srgb import encode_srgb8, srgb_to_linear

if TYPE_CHECKING:
    from PIL.Image import Image

GAINS = (1e-3, 1e9)
_FITTED = 99.0  # percentile of the differences that is white, so that few outliers do not count
_NEGLIGIBLE = 1e-3  # smallest difference that counts for the percentile, relative to the largest
# Colours of the differences -1, -1/2, 0, 1/2 and 1, in units of the difference that is white.
_COLORS = (
    *((222, 240, 255), visualization.DARKER, (0, 0, 0)),
    *(visualization.BRIGHTER, (255, 240, 222)),
)
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
    a, b = alike(as_image(reference, "A"), as_image(image, "B"))
    for data in (a, b):
        check_finite(data)
    signed = visualization.signed_difference(a, b)
    full = 1.0 if a.encoding == "linear" else 255.0
    if gain is None:
        gain = min(max(full / (_fitted(np.abs(signed)) or full), GAINS[0]), GAINS[1])
    white = full / gain
    steps = np.arange(-_STEPS, _STEPS + 1) / _STEPS
    channels = srgb_to_linear(np.array(_COLORS) / 255.0).T
    ramp = [np.interp(steps, (-1.0, -0.5, 0.0, 0.5, 1.0), channel) for channel in channels]
    colors = encode_srgb8(np.stack(ramp, axis=-1).astype(np.float32))
    pixels = np.empty((*signed.shape, 3), dtype=np.uint8)
    for rows in visualization.strips(a):
        level = np.round(np.clip(signed[rows] / white, -1.0, 1.0) * _STEPS).astype(int)
        pixels[rows] = colors[level + _STEPS]
        uncovered = visualization.other_coverage(a, b, rows)
        pixels[rows][uncovered & (level == 0)] = visualization.UNCOVERED
    unit = "" if a.encoding == "linear" else "/255"
    frame = _frame(
        pixels, {"difference": f"B - A: orange +, blue -, white = {decimal(white, 3)}{unit}"}
    )
    return _Difference(**vars(frame), pair=(a, b), gain=gain if signed.any() else math.inf)


@dataclass(frozen=True, eq=False, repr=False)
class _Difference(Frame):
    """A difference with its images, and with its gain; equal images have an infinite gain."""

    pair: tuple[ImageData, ImageData]
    gain: float


def _fitted(differences: NDArray[np.float32]) -> float:
    """Return the difference that is white in a picture of absolute differences; 0 if all are 0."""
    counted = differences[differences > _NEGLIGIBLE * differences.max()]
    return float(np.percentile(counted, _FITTED)) if counted.size else 0.0


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
    if not isinstance(images, Iterable) or isinstance(images, np.ndarray | str):
        raise InputError(f"images = {shown(images)}: give a list of images")
    images = list(images)
    differences = {n: image for n, image in enumerate(images) if isinstance(image, _Difference)}
    gain = min((frame.gain for frame in differences.values()), default=math.inf)
    scaled = {
        n: frame if frame.gain == gain else difference(*frame.pair, gain=gain)
        for n, frame in differences.items()
    }
    images = [scaled.get(n, image) for n, image in enumerate(images)]
    cells = [_displayed(source, f"image {number}") for number, source in enumerate(images, 1)]
    if not cells:
        raise InputError("a sheet of 0 images: give at least one")
    for number, cell in enumerate(cells, 1):
        if cell.shape != cells[0].shape:
            sizes = (f"{width} x {height}" for height, width, _ in (cell.shape, cells[0].shape))
            raise InputError(
                f"image {number} is {' pixels, image 1 is '.join(sizes)}: give images of one size"
            )
    if titles is None:
        titles = [e.metadata.get("difference", "") if isinstance(e, Frame) else "" for e in images]
    texts = [titles] if isinstance(titles, str) else [*titles]
    if not all(isinstance(text, str) for text in texts):
        raise InputError(f"titles = {shown(titles)}: give a list of texts")
    if len(texts) != len(cells):
        raise InputError(f"titles: {len(texts)}, images: {len(cells)}; give one for each image")
    for n, frame in scaled.items():
        title = frame.metadata["difference"]
        text = texts[n].replace(differences[n].metadata["difference"], title)
        scale = title.rpartition(", ")[2]
        texts[n] = text if scale in text or not text else f"{text}, {scale}"
    if columns is not None:
        if isinstance(columns, bool) or not isinstance(columns, int):
            raise InputError(f"columns = {shown(columns)}: give a whole number")
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


def _displayed(source: Comparable | Image, name: str) -> NDArray[np.uint8]:
    """Return an image as 8-bit sRGB (H, W, 3). A frame of a term has the colours of its PNG."""
    if isinstance(source, Frame):
        return visualization.displayed(ImageData(source.srgb8(), "srgb8", name))
    return visualization.displayed(as_image(source, name))


def _frame(pixels: NDArray[np.uint8], metadata: dict[str, str]) -> Frame:
    """Return 8-bit sRGB pixels (H, W, 3) as an opaque frame, whose ``srgb8()`` are these pixels."""
    radiance = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    linear = np.ones((*pixels.shape[:2], 4), dtype=np.float32)
    linear[..., :3] = radiance[pixels]
    return Frame(linear, None, False, metadata)
