"""Pictures of several images: sheets, and the difference of two images in colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import visualization
from facerender.comparison.sources import Comparable, as_image, check_alike, check_finite
from facerender.drawing.frame import Frame
from facerender.errors import InputError, check_range, shown
from facerender.images.image import ImageData
from facerender.images.sheet import arranged
from facerender.images.srgb import srgb_to_linear

if TYPE_CHECKING:
    from PIL.Image import Image

GAINS = (1e-3, 1e9)


def difference(reference: Comparable, image: Comparable, *, gain: float | None = None) -> Frame:
    """Return the signed difference of two images as a picture: orange where ``image`` is brighter,
    blue where it is darker, black where both are equal.

    Each pixel shows the channel that differs most. Violet marks changed coverage with equal colour.

    Parameters
    ----------
    reference, image : as in :func:`compare`
    gain : factor of a linear colour scale, in [1e-3, 1e9]. A difference of 1/gain, or of 255/gain
        8-bit levels, has the full colour. Default: a logarithmic scale, as in the report of
        ``facerender compare``, on which the largest difference has the full colour

    Returns
    -------
    Frame : its ``metadata["difference"]`` has the largest difference and its unit

    Raises
    ------
    InputError : a file cannot be read; sizes, channels, encodings or colour spaces differ; a pixel
        is not finite; gain is outside its range
    """
    if gain is not None:
        check_range("gain", gain, *GAINS)
    a, b = as_image(reference, "A"), as_image(image, "B")
    check_alike(a, b)
    for each in (a, b):
        check_finite(each)
    pixels, largest = visualization.difference(a, b, gain)
    unit = "radiance" if a.encoding == "linear" else "8-bit levels"
    return _frame(pixels, {"difference": f"at most {largest:.3g} {unit}"})


def sheet(
    images: Iterable[Comparable | Image],
    titles: Sequence[str] | None = None,
    columns: int | None = None,
) -> Frame:
    """Return one picture with several images side by side. Transparent images lie on black.

    Parameters
    ----------
    images : images of one size: frames, arrays, Pillow images or paths, as in :func:`compare`
    titles : one text for each image; default: no titles
    columns : number of images in a row; default: all, at most four

    Raises
    ------
    InputError : there is no image; the sizes differ; a file cannot be read; the number of titles
        or of columns is invalid; the sheet is too large
    """
    if not isinstance(images, Iterable) or isinstance(images, np.ndarray | str):
        raise InputError(f"images = {shown(images)}: give a list of images")
    cells = [_displayed(each, f"image {number}") for number, each in enumerate(images, 1)]
    if not cells:
        raise InputError("a sheet of 0 images: give at least one")
    for number, cell in enumerate(cells, 1):
        if cell.shape != cells[0].shape:
            sizes = (f"{width} x {height}" for height, width, _ in (cell.shape, cells[0].shape))
            raise InputError(
                f"image {number} is {' pixels, image 1 is '.join(sizes)}: give images of one size"
            )
    texts = () if titles is None else (titles,) if isinstance(titles, str) else tuple(titles)
    if not all(isinstance(each, str) for each in texts):
        raise InputError(f"titles = {shown(titles)}: give a list of texts")
    if titles is not None and len(texts) != len(cells):
        raise InputError(f"{len(texts)} titles for {len(cells)} images: give one for each image")
    if columns is not None:
        if isinstance(columns, bool) or not isinstance(columns, int):
            raise InputError(f"columns = {shown(columns)}: give a whole number")
        check_range("columns", columns, 1, len(cells))
    return _frame(arranged(cells, texts, columns), {})


def side_by_side(reference: Comparable, image: Comparable) -> Frame:
    """Return a sheet of A, B and their difference. For parameters see :func:`difference`."""
    a, b = (
        each if isinstance(each, Frame) else as_image(each, name)
        for each, name in ((reference, "A"), (image, "B"))
    )
    apart = difference(a, b)
    scale = apart.metadata["difference"]
    return sheet([a, b, apart], ["A", "B", f"B brighter: orange, darker: blue; {scale}"])


def _displayed(source: Comparable | Image, name: str) -> NDArray[np.uint8]:
    """Return an image as 8-bit sRGB (H, W, 3). A frame of a term has the colours of its PNG."""
    if not isinstance(source, Frame):
        return visualization.displayed(as_image(source, name))
    pixels = source.srgb8()
    return visualization.displayed(ImageData(pixels, "srgb8", name))


def _frame(pixels: NDArray[np.uint8], metadata: dict[str, str]) -> Frame:
    """Return 8-bit sRGB pixels (H, W, 3) as an opaque frame, whose ``srgb8()`` are these pixels."""
    radiance = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    linear = np.ones((*pixels.shape[:2], 4), dtype=np.float32)
    linear[..., :3] = radiance[pixels]
    return Frame(linear, None, False, metadata)
