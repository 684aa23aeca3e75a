"""GLSL of the specular terms and lobes whose cost is measured: the forms as published by Romanyuk
et al. (2020), and the library's forms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.glsl.code import defines, lobe_macros
from facerender.shading import SMALL_SLOPE, Shading
from facerender.terms import LOBES, MODELS

SLOPE = 0.3  # slope m of the priced terms
# A sum of the inputs of a term; the cost of this sum is subtracted from the cost of the term.
INPUTS = "dot(l, v) + n.x + m * f0"

# Titles of the models in Romanyuk et al. (2020), keyed by the model's name.
PRINTED = {model.name: model.title for model in MODELS.values() if model.printed}
# Exact lobes as published by Romanyuk et al. (2020), with E = exp(-tan² γ / m²) and c = cos γ:
# E/c^4 computed from c, and E computed from γ.
_PRINTED_EXACT = {
    "cook-torrance": "exp((c * c - 1.0) / (m * m * c * c)) / (c * c * c * c)",
    "ward": "exp(-tan(acos(c)) * tan(acos(c)) / (m * m))",
}


def printed_lobe(c: ArrayLike, m: ArrayLike, k: int, g: int) -> NDArray[np.float64]:
    """Return D4, D8 or D16 (g = 4, 8, 16) as published by Romanyuk et al. (2020), in float64.

    The formula is ((n/g)(c - 1) + 1)^g with n = 2/m² - k, without a clamp. The peak is 1.
    """
    n = 2.0 / np.asarray(m, np.float64) ** 2 - k
    return np.asarray((n / g * (np.asarray(c) - 1.0) + 1.0) ** g)


PRINTED_D16 = replace(
    LOBES["d16"],
    name="d16 as published",
    evaluate=lambda c, m, k: printed_lobe(c, LOBES["d16"].check(m, k), k, 16),
)


@dataclass(frozen=True)
class Variant:
    """A form of a model's specular term.

    Attributes
    ----------
    model, lobe : name of the model, and name of the lobe
    printed : whether the form is published by Romanyuk et al., not the library's form
    plain : whether the exact lobe omits the extra precision at small angles, which is needed only
        for m < SMALL_SLOPE
    """

    model: str
    lobe: str
    printed: bool = False
    plain: bool = False

    @property
    def name(self) -> str:
        """The label of the variant, unique among the variants of the model."""
        if self.printed:
            return f"printed, {self.lobe}"
        return f"{self.lobe}, m >= {SMALL_SLOPE:g}" if self.plain else self.lobe

    @property
    def standard(self) -> bool:
        """Whether the renderer draws this variant for :attr:`shading`."""
        return not (self.printed or self.plain)

    @property
    def unclamped(self) -> bool:
        """Whether the lobe is a power without a clamp, as published by Romanyuk et al."""
        return self.printed and self.lobe != "exact"

    @property
    def k(self) -> int:
        """The power k of 1/cos γ in the model's lobe."""
        return MODELS[self.model].k

    @property
    def shading(self) -> Shading:
        """A shading with this model and lobe. OpenGL cannot draw it if the lobe is unclamped."""
        return Shading(self.model, PRINTED_D16 if self.unclamped else self.lobe)

    @property
    def term(self) -> tuple[str, str]:
        """GLSL prelude and expression of the whole term, in 1/sr."""
        model = MODELS[self.model]
        call = model.printed if self.printed else model.printed.replace("printed_", "")
        folder = "printed" if self.printed else "facerender"
        small = "#define FR_SMALL_SLOPE 0\n" if self.plain else ""
        return (
            f'{defines(lobe_macros(self.lobe))}{small}#include "{folder}/{model.file}.glsl"',
            call,
        )

    @property
    def lobe_term(self) -> tuple[str, str]:
        """GLSL prelude and expression of the lobe as a function of float c and m; no unit."""
        if self.unclamped:
            power = f"fr_printed_g_power(c, 2.0 / (m * m) - {self.k}.0, 16)"
            return '#include "printed/g_power.glsl"', power
        if self.printed:
            return "", _PRINTED_EXACT[self.model]
        prelude = f'{defines(lobe_macros(self.lobe))}#include "facerender/lobe.glsl"'
        return prelude, f"fr_lobe(c, m, {self.k})"


def of_model(model: str) -> tuple[Variant, ...]:
    """Return the variants of a model, the published variants first."""
    printed = [Variant(model, lobe, printed=True) for lobe in ("exact", "d16")]
    library = [
        Variant(model, lobe, plain=plain)
        for lobe in LOBES
        for plain in ((False, True) if lobe == "exact" else (False,))
    ]
    return *printed, *library


def terms(model: str) -> dict[str, tuple[str, str]]:
    """Return GLSL prelude and expression of each whole term, keyed by the variant's name."""
    return {variant.name: variant.term for variant in of_model(model)}


def lobe_terms(model: str) -> dict[str, tuple[str, str]]:
    """Return GLSL prelude and expression of each lobe, keyed by the variant's name."""
    return {variant.name: variant.lobe_term for variant in of_model(model) if not variant.plain}
