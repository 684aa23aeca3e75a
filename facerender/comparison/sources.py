"""Images that are compared: sources, checks of a pair, and the quantities that limits bound."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.frame import Frame
from facerender.errors import InputError, number_of
from facerender.images.files import image_from_pillow, read_image
from facerender.images.image import Encoding, ImageData, image_from_array

if TYPE_CHECKING:
    from PIL.Image import Image


def decimal(value: float, digits: int = 2, sign: bool = False) -> str:
    """Return a number with ``digits`` or more significant digits and without an exponent."""
    digits = max(digits, len(f"{abs(value):.0f}"))
    return np.format_float_positional(
        float(value), digits, unique=False, fractional=False, trim="-", sign=sign
    )


class Check(NamedTuple):
    """A check as text."""

    quantity: str  # noun phrase for the measured quantity
    unit: str = ""  # unit, "%" for a fraction, and a remark on the limit
    levels: str = ""  # unit and remark in 8-bit images; "" if they are the same

    def amount(self, value: float, encoding: Encoding, remark: bool = False) -> str:
        """Return a value with its unit, such as "0.5 %"."""
        unit, _, note = ((encoding == "srgb8" and self.levels) or self.unit).partition(" ")
        value = 100.0 * value if unit == "%" else value
        text = decimal(value, 3)
        unit = unit.removesuffix("s") if text == "1" else unit
        return f"{text} {unit} {note if remark else ''}".rstrip()


CHECKS = {
    "point": Check(
        "difference of a pixel that the pixels around it do not explain",
        "radiance (more at a lone pixel in texture or at an edge)",
        "levels (more at a lone pixel in texture or at an edge)",
    ),
    "slivers": Check(
        "number of pixels over the limit of point, including slivers at edges",
        "pixels (50 and 1 in 10,000)",
    ),
    "holes": Check(
        "number of pixels with less than a quarter of their neighbours' light or no coverage",
        "pixels",
    ),
    "block": Check("change of the mean of a block of 16 x 16 pixels", "% of this mean", "levels"),
    "trend": Check("mean product of adjacent blocks' changes in units of the standard errors"),
    "grain": Check("noise added or lost between adjacent pixels", "% of a pixel's level", "levels"),
    "texture": Check(
        "variance between adjacent pixels that was added or lost", "% of the variance"
    ),
    "coverage": Check("number of pixels whose coverage changed", "% of all pixels"),
    "shift": Check("displacement of the whole image", "pixels"),
}


HIGHEST = 1e30  # largest valid value: sums and differences of larger values may overflow

Comparable: TypeAlias = "ImageData | Frame | NDArray[Any] | Image | str | os.PathLike[str]"


def as_image(source: Comparable, name: str) -> ImageData:
    """Return the image data of any source; ``name`` is for messages."""
    if isinstance(source, ImageData):
        return source
    if isinstance(source, Frame):
        return ImageData(source.linear, "linear", name, source.metadata)
    if isinstance(source, (str, os.PathLike)):
        return read_image(source)
    if not isinstance(source, np.ndarray):
        from PIL import Image

        if isinstance(source, Image.Image):
            return image_from_pillow(source, name)
    return image_from_array(np.asarray(source), name)


def both(reference: Comparable, image: Comparable) -> tuple[ImageData, ImageData]:
    """Return the image data of two sources, A and B, with equal channels: without an alpha that
    only one has and that is 1 everywhere. Refuse images that cannot be compared."""
    a, b = as_image(reference, "A"), as_image(image, "B")
    if a.pixels.shape[:2] != b.pixels.shape[:2]:
        sizes = f"{a.name} is {size_of(a.pixels)}, {b.name} is {size_of(b.pixels)} pixels"
        raise InputError(f"{sizes}: render both at one size")
    if a.encoding != b.encoding:
        names = {"linear": "linear float", "srgb8": "8-bit sRGB"}
        encodings = f"{a.name} is {names[a.encoding]}, {b.name} is {names[b.encoding]}"
        raise InputError(f"{encodings}: give two images of one encoding")
    if a.pixels.shape[2] != b.pixels.shape[2]:
        full = 255 if a.encoding == "srgb8" else 1
        a, b = (
            replace(x, pixels=x.pixels[..., :-1])
            if x.pixels.shape[2] % 2 == 0 and (x.pixels[..., -1] == full).all()
            else x
            for x in (a, b)
        )
    if a.pixels.shape[2] != b.pixels.shape[2]:
        counts = (f"{x.name} has {number_of(x.pixels.shape[2], 'channel')}" for x in (a, b))
        grey = len({x.pixels.shape[2] > 2 for x in (a, b)}) > 1
        remedy = "save both as RGB" if grey else "save both with alpha, or both without"
        raise InputError(f"{', '.join(counts)}: {remedy}")
    if a.color_space != b.color_space:
        spaces = (f"{x.name} is in colour space {x.color_space or '(unnamed)'}" for x in (a, b))
        raise InputError(f"{', '.join(spaces)}: convert one")
    for data in (a, b) if a.encoding == "linear" else ():
        good = np.abs(data.pixels) <= np.float32(HIGHEST)  # a half float cannot represent HIGHEST
        if good.all():
            continue
        row, column, channel = np.unravel_index(int(good.argmin()), good.shape)
        nans, infinite = (int(test(data.pixels).sum()) for test in (np.isnan, np.isinf))
        values = f"{nans} NaN and {number_of(infinite, 'infinite value')}"
        if not nans + infinite:
            values = f"values beyond {HIGHEST:g}"
        first = f"the first at pixel ({column}, {row}), channel {channel}"
        raise InputError(f"{data.name} holds {values}, {first}: repair its renderer")
    return a, b


def size_of(pixels: NDArray[Any]) -> str:
    """Return width and height of an image for a message."""
    return f"{pixels.shape[1]} x {pixels.shape[0]}"
