"""The error budget of a plan: parse budgets, measure and format errors. No OpenGL here."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from facerender.comparison import pictures
from facerender.comparison.windows import FLOOR
from facerender.errors import InputError
from facerender.images.image import linear_to_srgb
from facerender.values.fields import EXPOSURES

Unit = Literal["display", "relative", "flip"]
Float = NDArray[np.float64]

# Upper bound of the error that float32 and the driver's rounding add to the float64 error.
ROUNDING: dict[Unit, float] = {"display": 0.05 / 255.0, "relative": 5e-4, "flip": 1e-3}

# Factor and format of an error as text.
_TEXTS = {"display": (255.0, "{}/255"), "relative": (100.0, "{} %"), "flip": (1.0, "FLIP {}")}

_GIVEN = re.compile(r"([-+.\deE]+|[-+]?(?:nan|inf))\s*(?:/\s*([.\deE+]+)|(%)|(flip))?", re.I)


@dataclass(frozen=True)
class Budget:
    """An error limit for all pixels, or for a fraction of the pixels."""

    limit: float  # largest error, >= 0, expressed in ``unit``
    # "display": fraction of the range from black to white in sRGB encoding, before rounding to
    # 8-bit levels. "relative": fraction of the reference's linear radiance (at least 0.01). "flip":
    # FLIP (Andersson et al. 2020) of the displayed image.
    unit: Unit = "display"
    exposure: float = 0.0  # of the displayed image, in stops
    within: float = 1.0  # fraction of each image's covered pixels that must meet it, in (0, 1]

    @classmethod
    def parse(cls, given: str | float, exposure: float = 0.0, within: str | float = 1.0) -> Budget:
        """Parse a budget.

        given : "1/255", "0.5%" or "0.02 flip"; a number is a fraction of the display's range
        within : fraction of the pixels, such as "99.9%" or 0.999
        """
        number = str(within).strip()
        try:
            fraction = float(Decimal(number.removesuffix("%")) / (100 if "%" in number else 1))
        except ArithmeticError:
            fraction = 0.0
        if not 0.0 < fraction <= 1.0:
            remedy = "give a fraction of the pixels such as 99.9% or 0.999"
            raise InputError(f"within {within}: {remedy}")
        EXPOSURES.check("exposure", exposure)
        remedy = "give a fraction of the display's range such as 1/255, 0.5%, or 0.02 flip"
        match = _GIVEN.fullmatch(str(given).strip())
        try:
            if match is None:
                raise ValueError
            numerator, denominator = float(match[1]), float(match[2] or 1.0)
            limit = numerator / denominator
        except (ValueError, ZeroDivisionError):
            raise InputError(f"budget {given!r} has an unknown unit: {remedy}") from None
        if not 0.0 <= limit < math.inf:
            fault = "is negative" if limit < 0.0 else "is not a finite number"
            raise InputError(f"budget {given} {fault}: {remedy}")
        if isinstance(given, str) and numerator and not any(match.groups()[1:]):
            raise InputError(f"budget {given!r} has no unit: {remedy}")
        if match[3]:
            return cls(limit / 100.0, "relative", exposure, fraction)
        return cls(limit, "flip" if match[4] else "display", exposure, fraction)

    def errors(self, image: Float, reference: Float) -> Float:
        """Return the error of each pixel, (H, W), in its worst channel; the images are linear."""
        if self.unit == "relative":
            relative = np.abs(image - reference) / np.maximum(reference, FLOOR)
            return np.asarray(relative.max(axis=-1))
        displayed, expected = (linear_to_srgb(x * 2.0**self.exposure) for x in (image, reference))
        if self.unit == "display":
            return np.asarray(np.abs(displayed - expected).max(axis=-1))
        return pictures.flip_errors(expected, displayed)

    def spared(self, covered: int) -> int:
        """Return the number of an image's covered pixels that may exceed the limit."""
        return covered - math.ceil(Fraction(str(self.within)) * covered)

    @property
    def fraction(self) -> str:
        """:attr:`within` as text, such as "99.9 %"."""
        return f"{100.0 * self.within:.6g} %"

    def text(self, error: float) -> str:
        """Return an error as text, in the budget's unit."""
        if not math.isfinite(error):
            return "infinity"
        scale, form = _TEXTS[self.unit]
        value = scale * error
        return form.format("<0.001" if 0.0 < value < 0.001 else f"{value:.3g}")


def highest_but(errors: Float, spared: int) -> float:
    """Return the largest error after removing the ``spared`` largest errors; 0 if none is left. NaN
    counts as the largest error."""
    counted = errors.size - spared
    return float(np.partition(errors, counted - 1, axis=None)[counted - 1]) if counted > 0 else 0.0
