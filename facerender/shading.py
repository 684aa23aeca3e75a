"""What a program is compiled with: the reflectance model, its lobe and its Fresnel term, and the
GLSL that selects them. Nothing here needs OpenGL; lights and maps are the renderer's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender import brdf, lobes
from facerender.brdf import Fresnel
from facerender.errors import InputError
from facerender.lobes import Lobe

Model = Literal["cook-torrance", "ward", "ward-printed"]
Outside = Literal["error", "exact"]

MODELS: tuple[Model, ...] = ("cook-torrance", "ward", "ward-printed")
FRESNEL_TERMS: tuple[Fresnel, ...] = ("schlick", "dielectric")
SMALL_SLOPE = 0.2  # from here on the exact lobe is accurate without FR_SMALL_SLOPE
OUTSIDE: tuple[Outside, ...] = ("error", "exact")


def lobe_macro(lobe: Lobe) -> str:
    """Return the value of FR_LOBE that stands for a lobe."""
    return f"FR_LOBE_{lobe.upper().replace('-', '_')}"


def choose_lobe(lobe: Lobe) -> str:
    """Return the line of GLSL that makes ``fr_lobe`` this lobe."""
    return f"#define FR_LOBE {lobe_macro(lobe)}\n"


@dataclass(frozen=True)
class Shading:
    """Choice of specular terms.

    Parameters
    ----------
    model : "cook-torrance", "ward", or "ward-printed" (as Romanyuk et al. 2020 print it)
    lobe : "exact", "fitted", "fitted-fine", "cosine", "d4", "d8" or "d16"
    fresnel : "schlick" or "dielectric"; Cook-Torrance only, since Ward has no Fresnel term
    outside : what a material gets whose m leaves the domain of the lobe: "error", or "exact" for
        the exact lobe in its place

    Raises
    ------
    InputError : an unknown name
    """

    model: Model = "cook-torrance"
    lobe: Lobe = "exact"
    fresnel: Fresnel = "schlick"
    outside: Outside = "error"

    def __post_init__(self) -> None:
        for kind, value, known in (
            ("model", self.model, MODELS),
            ("lobe", self.lobe, lobes.NAMES),
            ("Fresnel term", self.fresnel, FRESNEL_TERMS),
            ("choice outside the domain", self.outside, OUTSIDE),
        ):
            if value not in known:
                raise InputError(f"unknown {kind} {value!r}; known: {', '.join(known)}")
        if self.model != "cook-torrance" and self.fresnel != "schlick":
            raise InputError(f"{self.model} has no Fresnel term: leave {self.fresnel!r} out")

    @property
    def k(self) -> int:
        """The power of 1/cos γ in the model's lobe."""
        return brdf.K_COOK_TORRANCE if self.model == "cook-torrance" else brdf.K_WARD

    def for_slopes(self, smallest: float, largest: float) -> Shading:
        """Return the choice for a material with these slopes: this one, or with the exact lobe.

        Raises
        ------
        InputError : m leaves the domain of the lobe, and ``outside`` is "error"
        """
        slopes = (smallest, largest)
        if lobes.in_domain(slopes, self.lobe, self.k).all():
            return self
        if self.outside == "exact" and self.lobe != "exact":
            return replace(self, lobe="exact").for_slopes(smallest, largest)
        lobes.check_slope(slopes, self.lobe, self.k)
        return self

    def brdf(
        self, n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, f0: float
    ) -> NDArray[np.float64]:
        """Evaluate in float64 what ``SPECULAR_BRDF`` is in GLSL, in 1/sr; see ``brdf.py``.

        Ward has no Fresnel term: its reflectance is f0, so that both models agree where
        normal, light and eye coincide.

        Raises
        ------
        InputError : a vector that is no unit vector, or a value outside its domain
        """
        if self.model == "cook-torrance":
            return brdf.cook_torrance(n, l, v, m, f0, lobe=self.lobe, fresnel_term=self.fresnel)
        ward = brdf.ward if self.model == "ward" else brdf.ward_printed
        return f0 * ward(n, l, v, m, lobe=self.lobe)

    def glsl(self, smallest_m: float) -> str:
        """Return what makes ``SPECULAR_BRDF(n, l, v, m, f0)`` this choice, for m >= smallest_m."""
        name = self.model.replace("-", "_")
        cook_torrance = self.model == "cook-torrance"
        call = f"fr_{name}(n, l, v, m, f0)" if cook_torrance else f"(f0 * fr_{name}(n, l, v, m))"
        plain = self.lobe == "exact" and smallest_m >= SMALL_SLOPE
        small = "#define FR_SMALL_SLOPE 0\n" if plain else ""
        return (
            f"{choose_lobe(self.lobe)}{small}"
            f"#define FR_FRESNEL FR_FRESNEL_{self.fresnel.upper()}\n"
            f'#include "facerender/{name}.glsl"\n'
            f"#define SPECULAR_BRDF(n, l, v, m, f0) {call}\n"
        )
