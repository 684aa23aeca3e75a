"""What a program is compiled with: the reflectance model, its lobe and its Fresnel term, and the
GLSL that selects them. Nothing here needs OpenGL; lights and maps are the renderer's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from numpy.typing import ArrayLike

from facerender import brdf, lobes
from facerender.brdf import Fresnel
from facerender.errors import InputError
from facerender.lobes import Lobe

Model = Literal["cook-torrance", "ward", "ward-printed"]

MODELS: tuple[Model, ...] = ("cook-torrance", "ward", "ward-printed")
FRESNEL_TERMS: tuple[Fresnel, ...] = ("schlick", "dielectric")


@dataclass(frozen=True)
class Shading:
    """Choice of specular terms.

    Parameters
    ----------
    model : "cook-torrance", "ward", or "ward-printed" (as Romanyuk et al. 2020 print it)
    lobe : "exact", "cosine", "d4", "d8" or "d16"
    fresnel : "schlick" or "dielectric"; Cook-Torrance only, since Ward has no Fresnel term

    Raises
    ------
    InputError : an unknown name
    """

    model: Model = "cook-torrance"
    lobe: Lobe = "exact"
    fresnel: Fresnel = "schlick"

    def __post_init__(self) -> None:
        for kind, value, known in (
            ("model", self.model, MODELS),
            ("lobe", self.lobe, lobes.NAMES),
            ("Fresnel term", self.fresnel, FRESNEL_TERMS),
        ):
            if value not in known:
                raise InputError(f"unknown {kind} {value!r}; known: {', '.join(known)}")
        if self.model != "cook-torrance" and self.fresnel != "schlick":
            raise InputError(f"{self.model} has no Fresnel term: leave {self.fresnel!r} out")

    @property
    def k(self) -> int:
        """The power of 1/cos γ in the model's lobe."""
        return brdf.K_COOK_TORRANCE if self.model == "cook-torrance" else brdf.K_WARD

    def check_slope(self, m: ArrayLike) -> None:
        """Raise InputError when m lies outside the domain of the lobe in this model."""
        lobes.check_slope(m, self.lobe, self.k)

    @property
    def glsl(self) -> str:
        """The lines that make ``SPECULAR_BRDF(n, l, v, m, f0)`` this choice.

        Ward has no Fresnel term: its reflectance is f0, so that both models agree where
        normal, light and eye coincide.
        """
        name = self.model.replace("-", "_")
        cook_torrance = self.model == "cook-torrance"
        call = f"fr_{name}(n, l, v, m, f0)" if cook_torrance else f"(f0 * fr_{name}(n, l, v, m))"
        return (
            f"#define FR_LOBE FR_LOBE_{self.lobe.upper()}\n"
            f"#define FR_FRESNEL FR_FRESNEL_{self.fresnel.upper()}\n"
            f'#include "facerender/{name}.glsl"\n'
            f"#define SPECULAR_BRDF(n, l, v, m, f0) {call}\n"
        )
