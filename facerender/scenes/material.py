"""Reflectance of a part of a mesh: factors, and the maps that they multiply."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

from facerender.errors import InputError, shown
from facerender.scenes.texture import MOST_TEXELS, Texture, pack
from facerender.scenes.vectors import COLORS, HIGHEST, Vector
from facerender.shading import WEIGHTS
from facerender.terms.lobe import MIN_SLOPE, SLOPES
from facerender.terms.ranges import FRACTION, Range, check_fields, ranged

if TYPE_CHECKING:
    from facerender.terms.scattering import Gaussians

SKIN_ALBEDO: Vector = (0.48, 0.28, 0.21)  # linear; where a mesh brings no colour of its own


Alpha = Literal["opaque", "mask", "blend"]

PROPERTY_MAPS = ("occlusion_map", "roughness_map", "specular_map")  # in red, green and blue of one
MAPS = (
    *("albedo_map", "normal_map", "roughness_map", "specular_map", "occlusion_map"),
    *("lobe_map", "opacity_map", "emissive_map"),
)
MAX_NORMAL_STRENGTH = 100.0


@dataclass(frozen=True)
class Material:
    """Reflectance of a part: factors, and the maps that they multiply.

    Parameters
    ----------
    albedo : linear RGB
    m : rms slope of the microfacets, in [1e-4, 2], where there is no roughness map
    roughness_factor : in [0, 1], of the roughness map: m is (factor times texel)^2, as in glTF
    f0 : Fresnel reflectance at normal incidence, in [0, 1)
    ks, kd : specular and diffuse weights, >= 0. 1 is a bare dielectric; 0.18, from GPU Gems 3
        chapter 14, suits powdered skin
    second_slope, lobe_weight : of a second lobe, the factor on m, in [0.01, 100], and the fraction
        of the first lobe, in [0, 1]; with 1 for either there is one lobe
    albedo_map, normal_map, roughness_map, specular_map, occlusion_map : textures or None; only the
        albedo is sRGB-encoded; green of the normal map points up; occlusion dims ambient light
    lobe_map : texture or None; its red multiplies the fraction of the second lobe, 1 - lobe_weight:
        white where sweat or oil is, black where there is none
    scattering : how light enters and leaves beside: "skin", or Gaussians, each as its variance in
        mm^2 and its weights of red, green and blue, which add up to 1 at most; what they lack to 1
        leaves where it enters. None or "none" for a surface that does not scatter
    alpha : what the opacity does: nothing ("opaque"); cut away what is below ``alpha_cutoff``
        ("mask"); show what lies behind ("blend"): such a part is drawn after all others, casts no
        shadow, and does not scatter
    opacity : in [0, 1]
    alpha_cutoff : >= 0; above the opacity nothing is left
    opacity_map : grey texture or None, which multiplies the opacity
    emissive : linear radiance, >= 0, that the part gives off itself; it lights nothing else
    emissive_map : texture or None, sRGB-encoded, which multiplies it
    normal_strength : factor on x and y of the normal map's texels, in [0, 100]
    occlusion_strength : fraction of the occlusion map, in [0, 1]: 1 + strength (texel - 1) counts
    second_uv : names of the maps that lie by the part's second texture coordinates
    """

    albedo: Vector = ranged(COLORS, SKIN_ALBEDO)
    m: float = ranged(SLOPES, 0.3)
    roughness_factor: float = ranged(FRACTION, 1.0)
    f0: float = ranged(Range(0.0, 0.999), 0.028)
    ks: float = ranged(WEIGHTS, 1.0)
    kd: float = ranged(WEIGHTS, 1.0)
    second_slope: float = ranged(Range(0.01, 100.0), 1.0)
    lobe_weight: float = ranged(FRACTION, 1.0)
    albedo_map: Texture | None = None
    normal_map: Texture | None = None
    roughness_map: Texture | None = None
    specular_map: Texture | None = None
    occlusion_map: Texture | None = None
    lobe_map: Texture | None = None
    scattering: str | Gaussians | None = None
    alpha: Alpha = "opaque"
    opacity: float = ranged(FRACTION, 1.0)
    alpha_cutoff: float = ranged(Range(0.0, HIGHEST), 0.5)
    opacity_map: Texture | None = None
    emissive: Vector = ranged(COLORS, (0.0, 0.0, 0.0))
    emissive_map: Texture | None = None
    normal_strength: float = ranged(Range(0.0, MAX_NORMAL_STRENGTH), 1.0)
    occlusion_strength: float = ranged(FRACTION, 1.0)
    second_uv: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        if self.two_lobes and self.roughness_map is None:
            SLOPES.check("m times second_slope", self.m * self.second_slope)
        if not (isinstance(self.alpha, str) and self.alpha in get_args(Alpha)):
            raise InputError(
                f"unknown alpha {shown(self.alpha)}; known: {', '.join(get_args(Alpha))}"
            )
        names = self.second_uv
        if not isinstance(names, tuple | list) or any(each not in MAPS for each in names):
            raise InputError(f"second_uv = {shown(names)}: give some of {', '.join(MAPS)}")
        object.__setattr__(self, "second_uv", tuple(names))
        for name in MAPS:
            value = getattr(self, name)
            if value is not None and not isinstance(value, Texture):
                raise InputError(
                    f"{name} = {shown(value)}: give facerender.Texture.open(FILE) or None"
                )
        if self.scattering is not None:
            from facerender.terms.scattering import profile_of

            none = isinstance(self.scattering, str) and self.scattering == "none"
            own = None if none else profile_of(self.scattering)
            object.__setattr__(self, "scattering", own)

    def __getstate__(self) -> dict[str, Any]:
        """Pickles no more than the parameters."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def two_lobes(self) -> bool:
        """Whether there is a second lobe that differs from the first."""
        return self.second_slope != 1.0 and self.lobe_weight < 1.0

    def with_second(self, low: float, high: float) -> tuple[float, float]:
        """Return the smallest and largest slope of the lobes, of those of the first."""
        if not self.two_lobes:
            return low, high
        second = (max(end * self.second_slope, MIN_SLOPE) for end in (low, high))
        ends = (low, high, *second)
        return min(ends), max(ends)

    @cached_property
    def slopes(self) -> tuple[float, float]:
        """The smallest and largest m of all lobes, of the roughness map if there is one, which is
        then decoded."""
        if self.roughness_map is None:
            return self.with_second(self.m, self.m)
        packed = self.property_map
        texels = packed.ends()[:, 1] if packed else self.roughness_map.ends()[:, 0]
        ends = (self.roughness_factor * float(end) / 255.0 for end in texels)
        low, high = (max(end**2, MIN_SLOPE) for end in ends)
        return self.with_second(low, high)

    @cached_property
    def property_map(self) -> Texture | None:
        """Occlusion, roughness and specular weight as one texture, so that one fetch serves; None
        where there are none, and where they stay apart: they are sampled in several ways, or by
        several texture coordinates."""
        return pack(*self.properties) if self.packs else None

    @property
    def properties(self) -> tuple[Texture | None, Texture | None, Texture | None]:
        """What one texture may hold: see PROPERTY_MAPS."""
        return self.occlusion_map, self.roughness_map, self.specular_map

    @property
    def packs(self) -> bool:
        """Whether there is a property map."""
        pairs = zip(PROPERTY_MAPS, self.properties, strict=True)
        return len({(name in self.second_uv, m.sampling) for name, m in pairs if m}) == 1

    def by_second(self, name: str) -> bool:
        """Tell whether a map, or "property_map", lies by the part's second texture coordinates."""
        names = PROPERTY_MAPS if name == "property_map" else (name,)
        return any(each in self.second_uv and getattr(self, each) is not None for each in names)

    @cached_property
    def solid(self) -> bool:
        """Whether the opacity, whose map is then decoded, changes nothing of what is drawn."""
        if self.alpha == "opaque":
            return True
        least = 1.0
        if self.opacity_map is not None:
            least = float(self.opacity_map.ends()[0, 0]) / 255.0
        return self.opacity * least >= (1.0 if self.alpha == "blend" else self.alpha_cutoff)


def check_maps(name: str, materials: Sequence[Material]) -> None:
    """Raise InputError where the maps of a mesh have more than MOST_TEXELS together."""
    maps: set[Texture | None] = set()
    for each in materials:
        names = set(MAPS) - set(PROPERTY_MAPS) | {"property_map"} if each.packs else MAPS
        maps.update(getattr(each, name) for name in names)
    if (total := sum(math.prod(texture.size) for texture in maps if texture)) > MOST_TEXELS:
        raise InputError(
            f"the maps of {name} have {total / 1e6:.0f} million texels together, of "
            f"{MOST_TEXELS / 1e6:.0f} at most: make them smaller"
        )
