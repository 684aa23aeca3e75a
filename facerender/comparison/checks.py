"""The checks of a comparison as text: the quantity that each limit bounds, and its unit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facerender.images.image import Encoding


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

    def sentence(self, limit: float, encoding: Encoding) -> str:
        """Return the meaning of a limit."""
        return f"The {self.quantity} may be at most {self.amount(limit, encoding, remark=True)}."


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
