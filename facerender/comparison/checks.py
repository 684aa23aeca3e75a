"""The checks of a comparison as text: the quantity that each limit bounds, and its unit."""

from __future__ import annotations

from typing import NamedTuple

from facerender.images.image import Encoding


class Check(NamedTuple):
    """A check as text.

    Attributes
    ----------
    quantity : noun phrase for the measured quantity
    linear, srgb8 : unit in linear images and in 8-bit images. The first word is the unit, "%" for a
        fraction; a remark may follow
    """

    quantity: str
    linear: str = ""
    srgb8: str = ""

    def amount(self, value: float, encoding: Encoding, remark: bool = False) -> str:
        """Return a value with its unit, such as "0.5 %"."""
        unit = self.linear if encoding == "linear" else self.srgb8
        text = number(100.0 * value if unit.startswith("%") else value)
        word, _, more = unit.partition(" ")
        word = word.removesuffix("s") if text == "1" else word
        return f"{text} {word} {more if remark else ''}".rstrip()

    def sentence(self, limit: float, encoding: Encoding) -> str:
        """Return the meaning of a limit."""
        return f"The {self.quantity} may be at most {self.amount(limit, encoding, remark=True)}."


CHECKS = {
    "point": Check(
        "difference of a pixel that the pixels around it do not explain", "radiance", "levels"
    ),
    "slivers": Check(
        "number of pixels over the limit of point, slivers at edges included",
        *("pixels (50 and 1 in 10,000)", "pixels (50 and 1 in 10,000)"),
    ),
    "block": Check("change of the mean of a block of 16 x 16 pixels", "% of this mean", "levels"),
    "trend": Check("mean product of adjacent blocks' changes in units of the standard errors"),
    "grain": Check("noise added or lost between adjacent pixels", "% of a pixel's level", "levels"),
    "texture": Check(
        "variance between adjacent pixels that was added or lost",
        *("% of this variance", "% of this variance"),
    ),
    "shift": Check("displacement of the whole image", "pixels", "pixels"),
    "coverage": Check(
        "number of pixels whose coverage changed", *("% of all pixels", "% of all pixels")
    ),
}


def number(value: float) -> str:
    """Return a number with three significant digits."""
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"
