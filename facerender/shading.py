"""What a program is compiled with: the reflectance model, its lobe, Fresnel and masking terms, what
it leaves out, and the GLSL that selects them. Nothing here needs OpenGL; lights and maps are the
renderer's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from operator import index
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender import brdf, lobes
from facerender.brdf import Fresnel, Masking
from facerender.errors import InputError, check_range
from facerender.lobes import AnyLobe, GPower

if TYPE_CHECKING:
    from facerender.scenes.mesh import Mesh
    from facerender.scenes.scene import Scene

Model = Literal["cook-torrance", "ward", "ward-printed"]
Outside = Literal["error", "exact"]

MODELS: tuple[Model, ...] = ("cook-torrance", "ward", "ward-printed")
FRESNEL_TERMS: tuple[Fresnel, ...] = ("schlick", "dielectric", "constant")
MASKING_TERMS: tuple[Masking, ...] = ("v-cavity", "kelemen", "none")
MAX_WEIGHT = 1e6
SMALL_SLOPE = 0.2  # from here on the exact lobe is accurate without FR_SMALL_SLOPE
OUTSIDE: tuple[Outside, ...] = ("error", "exact")

_MOST_SIMPLIFIED = 64  # of one mesh
_simplified: WeakKeyDictionary[Mesh, dict[tuple[Any, ...], Mesh]] = WeakKeyDictionary()


def lobe_macros(lobe: AnyLobe) -> dict[str, str]:
    """Return the macros that make ``fr_lobe`` this lobe."""
    if isinstance(lobe, GPower):
        offset = f" - {float(lobe.offset)}" if lobe.offset else ""
        return {
            "FR_LOBE": "FR_LOBE_G_POWER",
            "FR_G": str(lobe.g),
            "FR_STEEPNESS(m, k)": f"({float(lobe.factor)} / ((m) * (m)){offset})",
        }
    return {"FR_LOBE": f"FR_LOBE_{lobe.upper().replace('-', '_')}"}


def defines(macros: dict[str, str]) -> str:
    """Return the lines of GLSL that define macros."""
    return "".join(f"#define {name} {value}\n" for name, value in macros.items())


def _indices(name: str, lights: Any) -> tuple[int, ...]:
    try:
        found = [index(light) for light in lights if not isinstance(light, bool)]
        if len(set(found)) < len(lights):
            raise TypeError
    except TypeError:
        raise InputError(f"{name} = {lights!r}: give a list of whole numbers, each once") from None
    return tuple(found)


@dataclass(frozen=True)
class Shading:
    """Choice of specular terms, and of what is left out of a scene.

    Parameters
    ----------
    model : "cook-torrance", "ward", or "ward-printed" (as Romanyuk et al. 2020 print it)
    lobe : "exact", "fitted", "fitted-fine", "cosine", "d4", "d8", "d16", or a
        :class:`facerender.lobes.GPower`
    fresnel : "schlick", "dielectric" or "constant" (f0 alone); Cook-Torrance only, since Ward has
        no Fresnel term
    masking : "v-cavity", "kelemen" or "none"; Cook-Torrance only as well
    outside : what a material gets whose m leaves the domain of the lobe: "error", or "exact" for
        the exact lobe in its place
    small_slope : keep the digits of small angles in the exact lobe; None for as m needs it
    m : one rms slope for the whole mesh in place of its own and of roughness maps, as a constant of
        the program; None for the materials' own
    ks : one specular weight in place of the materials' and of specular maps
    normal_map, ambient : whether they count
    specular_lights : indices in the scene of the lights that have a specular term; None for all
    frontal_lights : indices of those among them that stand on the eye's side, where Fresnel is f0
        and nothing is masked: their term has neither; Cook-Torrance only

    Raises
    ------
    InputError : an unknown name
    """

    model: Model = "cook-torrance"
    lobe: AnyLobe = "exact"
    fresnel: Fresnel = "schlick"
    outside: Outside = "error"
    masking: Masking = "v-cavity"
    small_slope: bool | None = None
    m: float | None = None
    ks: float | None = None
    normal_map: bool = True
    ambient: bool = True
    specular_lights: tuple[int, ...] | None = None
    frontal_lights: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.lobe, GPower) and self.lobe not in lobes.NAMES:
            raise InputError(f"unknown lobe {self.lobe!r}; known: {', '.join(lobes.NAMES)}")
        for kind, value, known in (
            ("model", self.model, MODELS),
            ("Fresnel term", self.fresnel, FRESNEL_TERMS),
            ("masking term", self.masking, MASKING_TERMS),
            ("choice outside the domain", self.outside, OUTSIDE),
        ):
            if value not in known:
                raise InputError(f"unknown {kind} {value!r}; known: {', '.join(known)}")
        if self.model != "cook-torrance" and self.fresnel != "schlick":
            raise InputError(f"{self.model} has no Fresnel term: leave {self.fresnel!r} out")
        if self.model != "cook-torrance" and self.masking != "v-cavity":
            raise InputError(f"{self.model} has no masking term: leave {self.masking!r} out")
        if self.model != "cook-torrance" and self.frontal_lights:
            raise InputError(f"{self.model} has no other term for frontal_lights: leave them out")
        for name in ("normal_map", "ambient", "small_slope"):
            value = getattr(self, name)
            if not isinstance(value, bool) and (name != "small_slope" or value is not None):
                raise InputError(f"{name} = {value!r}: give true or false")
        for name in ("specular_lights", "frontal_lights"):
            if (lights := getattr(self, name)) is not None:
                object.__setattr__(self, name, _indices(name, lights))
        if self.m is not None:
            check_range("m", self.m, lobes.MIN_SLOPE, lobes.MAX_SLOPE)
        if self.ks is not None:
            check_range("ks", self.ks, 0.0, MAX_WEIGHT)

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

    def as_dict(self) -> dict[str, Any]:
        """Return the fields that are not the default, as TOML and JSON hold them."""
        kept = {
            each.name: getattr(self, each.name)
            for each in fields(self)
            if getattr(self, each.name) != each.default
        }
        if isinstance(self.lobe, GPower):
            kept["lobe"] = asdict(self.lobe)
        for name in ("specular_lights", "frontal_lights"):
            if name in kept:
                kept[name] = list(kept[name])
        return kept

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Shading:
        """Return the shading that :meth:`as_dict` gave.

        Raises
        ------
        InputError : an unknown key or a value outside its domain
        """
        if not isinstance(table, Mapping):
            raise InputError(f"shading = {table!r}: give a table")
        known = [each.name for each in fields(cls)]
        if unknown := sorted(set(table) - set(known)):
            raise InputError(f"unknown key {unknown[0]!r} in shading; known: {', '.join(known)}")
        values = dict(table)
        if isinstance(lobe := values.get("lobe"), dict):
            try:
                values["lobe"] = GPower(**lobe)
            except TypeError:
                raise InputError(f"lobe = {lobe!r}: give a name, or g, factor, offset") from None
        return cls(**values)

    def shines(self, light: int) -> bool:
        """Tell whether the light of this index has a specular term."""
        return self.specular_lights is None or light in self.specular_lights

    @property
    def frontal(self) -> Shading:
        """The choice with the terms of ``frontal_lights`` for all lights."""
        return replace(self, fresnel="constant", masking="none", frontal_lights=())

    def simplify(self, scene: Scene) -> Scene:
        """Return the scene without the maps and the ambient light that this choice leaves out.

        The same mesh gives the same simplified mesh again, so that a renderer keeps its maps.

        Raises
        ------
        InputError : m or ks outside its domain, a light that the scene does not have
        """
        for name in ("specular_lights", "frontal_lights"):
            for light in getattr(self, name) or ():
                if not 0 <= light < len(scene.lights):
                    raise InputError(
                        f"{name} names light {light}: the scene has {len(scene.lights)}, counted "
                        "from 0"
                    )
        changes: dict[str, Any] = {}
        if self.m is not None:
            changes["m"] = self.m
        if self.ks is not None:
            changes |= {"ks": self.ks, "specular_map": None}
        if not self.normal_map:
            changes["normal_map"] = None
        if not self.ambient:
            scene = replace(scene, ambient=0.0)
            changes["occlusion_map"] = None
        if not changes:
            return scene
        known = _simplified.setdefault(scene.mesh, {})
        key = tuple(changes.items())
        if key not in known:
            if len(known) >= _MOST_SIMPLIFIED:
                del known[next(iter(known))]
            known[key] = scene.mesh.with_material(**changes)
        return replace(scene, mesh=known[key])

    def brdf(
        self, n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, f0: float
    ) -> NDArray[np.float64]:
        """Evaluate in float64 what ``SPECULAR_BRDF`` is in GLSL, in 1/sr; see ``brdf.py``.

        Ward has no Fresnel term: its reflectance is f0, so that both models agree where
        normal, light and eye coincide. m is the caller's, also where the choice has one of its own,
        which GLSL and the G-buffer take in its place.

        Raises
        ------
        InputError : a vector that is no unit vector, or a value outside its domain
        """
        if self.model == "cook-torrance":
            return brdf.cook_torrance(
                n,
                l,
                v,
                m,
                f0,
                lobe=self.lobe,
                fresnel_term=self.fresnel,
                masking_term=self.masking,
            )
        ward = brdf.ward if self.model == "ward" else brdf.ward_printed
        return f0 * ward(n, l, v, m, lobe=self.lobe)

    def macros(self, smallest_m: float) -> dict[str, str]:
        """Return the macros of the library that make this choice, for m >= smallest_m where it has
        none of its own."""
        macros = lobe_macros(self.lobe)
        if self.lobe == "exact":
            small = self.small_slope
            if small is None:
                small = (smallest_m if self.m is None else self.m) < SMALL_SLOPE
            if not small:
                macros["FR_SMALL_SLOPE"] = "0"
        if self.model == "cook-torrance":
            macros["FR_FRESNEL"] = f"FR_FRESNEL_{self.fresnel.upper()}"
            macros["FR_MASKING"] = f"FR_MASKING_{self.masking.upper().replace('-', '_')}"
        if self.m is not None:
            macros["FR_SLOPE(m)"] = repr(float(self.m))
        return macros

    @property
    def calls(self) -> tuple[str, str]:
        """GLSL of the specular term and of that of frontal lights, in 1/sr, of n, l, v, m, f0."""
        name = f"fr_{self.model.replace('-', '_')}"
        if self.model != "cook-torrance":
            return (f"(f0 * {name}(n, l, v, m))",) * 2
        frontal = f"{name}_terms(n, l, v, m, f0, FR_FRESNEL_CONSTANT, FR_MASKING_NONE)"
        return f"{name}(n, l, v, m, f0)", frontal

    def glsl(self, smallest_m: float) -> str:
        """Return what makes ``SPECULAR_BRDF(n, l, v, m, f0)`` this choice, for m >= smallest_m, and
        ``FRONTAL_BRDF`` that of frontal lights."""
        specular, frontal = self.calls
        return (
            f"{defines(self.macros(smallest_m))}"
            f'#include "facerender/{self.model.replace("-", "_")}.glsl"\n'
            f"#define SPECULAR_BRDF(n, l, v, m, f0) {specular}\n"
            f"#define FRONTAL_BRDF(n, l, v, m, f0) {frontal}\n"
        )
