"""The shading of a scene: the specular term of its lights, and the features that are left out.
Shadings convert to and from TOML and JSON. ``glsl/code.py`` generates the GLSL of the terms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cached_property
from operator import index
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from facerender.errors import InputError, quoted
from facerender.material import WEIGHTS
from facerender.terms.lobe import SLOPES, AnyLobe, GPower, lobe_entry
from facerender.terms.model import FRESNEL, MASKING, MODELS, Model
from facerender.values.fields import (
    SWITCH,
    Choice,
    IntegerRange,
    Limits,
    build,
    field,
    plain,
    record,
)
from facerender.values.vectors import Float

S = TypeVar("S")

OUTSIDE = ("error", "exact")
DIFFUSE = ("lambert", "coupled")
SMALL_SLOPE = 0.2  # Lowest m at which the exact lobe is accurate without FR_SMALL_SLOPE.
SCATTER_SAMPLES = (0, 8, 16, 32, 64)


class _Lobes(Limits):
    """A name of the registry, a :class:`GPower`, or a table of the fields of a GPower."""

    def check(self, name: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            return build(GPower, value, name)
        lobe_entry(value)
        return value


class _Even(IntegerRange):
    def check(self, name: str, value: Any) -> Any:
        if value not in self or value % 2:
            raise InputError(f"{name} = {quoted(value)}: give an even number up to {self.high:g}")
        return int(value)


class _Indices(Limits):
    """Indices of lights, each once, in any order."""

    def check(self, name: str, value: Any) -> Any:
        try:
            indices = {index(light) for light in value if not isinstance(light, bool)}
            if len(indices) < len(value):
                raise TypeError
        except TypeError:
            remedy = "give a list of whole numbers, each once"
            raise InputError(f"{name} = {quoted(value)}: {remedy}") from None
        return tuple(sorted(indices))  # equal shadings share compiled frames


@record()
class Term:
    """A specular term. Only Cook-Torrance has a Fresnel and a masking term."""

    model: str = field(
        Choice(MODELS),
        "cook-torrance",
        "specular model",
        "ward-printed is Ward as published by Romanyuk et al. (2020)",
    )
    lobe: AnyLobe = field(
        _Lobes(),
        "exact",
        "exact lobe, or an approximation",
        "facerender measure prints their errors",
    )
    fresnel: str = field(
        Choice(FRESNEL, "Fresnel term"), "schlick", "Fresnel term of Cook-Torrance"
    )
    masking: str = field(
        Choice(MASKING, "masking term"), "v-cavity", "masking term of Cook-Torrance"
    )
    m: float | None = field(
        SLOPES,
        None,
        "RMS slope that replaces the m of all materials; None for the m of each material",
    )
    small_slope: bool | None = field(
        SWITCH,
        None,
        "whether to compute the exact lobe accurately for small angles; None: only if m is below "
        f"{SMALL_SLOPE}",
    )

    def __post_init__(self) -> None:
        for noun, name in (("Fresnel", "fresnel"), ("masking", "masking")):
            if not self.entry.factors and (value := getattr(self, name)) != getattr(Term, name):
                raise InputError(f"{self.model} has no {noun} term: leave {quoted(value)} out")

    @property
    def entry(self) -> Model:
        """The registry entry of the model."""
        return MODELS[self.model]

    def for_slopes(self, smallest: float, largest: float, outside: str = "error") -> Term:
        """Return the term for a material: this term, or a copy of it with the exact lobe.

        smallest, largest : range of the material's m
        outside : beyond the lobe's domain, "error" raises InputError, "exact" takes the exact lobe
        """
        slopes = self.slope(smallest), self.slope(largest)
        lobe, k = lobe_entry(self.lobe), self.entry.k
        if outside == "exact" and self.lobe != "exact" and not lobe.belongs(slopes, k).all():
            return replace(self, lobe="exact").for_slopes(smallest, largest)
        lobe.check(slopes, k)
        return self

    def slope(self, m: S) -> S | float:
        """Return the constant m of the term, if it has one, otherwise the m of the material."""
        return m if self.m is None else self.m

    def second(self, factor: float) -> Term:
        """Return the term of a second lobe, whose m is `factor` times the m of the first lobe."""
        return self if self.m is None else replace(self, m=self.m * factor)

    def keeps_small_slopes(self, smallest_m: float) -> bool:
        """Return whether the exact lobe is accurate for small angles, for a material's lowest m."""
        if self.small_slope is not None:
            return self.small_slope
        return self.slope(smallest_m) < SMALL_SLOPE

    def brdf(self, n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, f0: float) -> Float:
        """Evaluate the BRDF of the term in float64, in 1/sr; see ``terms/model.py``. A constant m
        of the term replaces `m`.

        Raises
        ------
        InputError : a vector that is not a unit vector, or a value outside its domain
        """
        arguments, lobe = (n, l, v, self.slope(m)), self.lobe
        if not self.entry.factors:  # The factor f0 makes all models equal where n = l = v.
            return np.asarray(f0 * self.entry.evaluate(*arguments, lobe=lobe))
        factors = {"fresnel_term": self.fresnel, "masking_term": self.masking}
        return self.entry.evaluate(*arguments, f0, lobe=lobe, **factors)


@record()
class Shading(Term):
    """The specular term of the lights, and the features that are left out of a scene.

    slope_filter and area lights do not widen the lobe of a term with a constant m. The coupled
    diffuse term assumes Cook-Torrance with the exact lobe, Schlick's Fresnel term and V-cavity
    masking."""

    outside: str = field(
        Choice(OUTSIDE),
        "error",
        "action if m is outside the lobe's valid range: stop with an error, or use the exact lobe",
    )
    ks: float | None = field(
        WEIGHTS,
        None,
        "one specular weight that replaces the weights of materials and specular maps",
    )
    normal_map: bool = field(SWITCH, True, "whether to use normal maps")
    ambient: bool = field(SWITCH, True, "whether to use ambient light")
    two_lobes: bool = field(SWITCH, True, "whether to use the second lobe of a material, too")
    slope_filter: bool = field(
        SWITCH,
        True,
        "specular antialiasing: widen the lobe by normal-map slopes smaller than a pixel",
    )
    environment: bool = field(SWITCH, True, "whether to use environment maps")
    diffuse: str = field(
        Choice(DIFFUSE, "diffuse term"),
        "lambert",
        "diffuse term",
        "coupled reduces the diffuse light by the light that the specular term reflects",
    )
    scatter_samples: int = field(
        Choice(SCATTER_SAMPLES),
        16,
        "subsurface samples per pixel",
        "0 disables subsurface scattering",
    )
    environment_samples: int = field(
        _Even(0, 4096),
        32,
        "directions of the environment map that each lobe reflects, an even number",
        "0 disables the specular reflection of the environment",
    )
    environment_lights: int = field(
        IntegerRange(0, 16),
        8,
        "lights that stand for the environment map's bright areas and cast shadows",
        "0 omits the shadows of the environment",
    )
    specular_lights: tuple[int, ...] | None = field(
        _Indices(), None, "indices of the lights with a specular term; None for all"
    )
    shadow_lights: tuple[int, ...] | None = field(
        _Indices(),
        None,
        "indices of the lights whose shadows are drawn; None for all lights that cast shadows",
    )

    # Programs and prices are keyed by the term: shadings that differ in features share it.
    @cached_property
    def term(self) -> Term:
        """The specular term of all lights."""
        return Term(**{f.name: getattr(self, f.name) for f in fields(Term)})

    def replace(self, **changes: Any) -> Shading:
        """Return a copy with changed parameters."""
        return replace(self, **changes)

    def shines(self, light: int) -> bool:
        """Return whether the light with this index has a specular term."""
        return self.specular_lights is None or light in self.specular_lights

    def check_lights(self, count: int) -> None:
        """Raise InputError if the shading names a light that a scene with `count` lights lacks."""
        for name in ("specular_lights", "shadow_lights"):
            for light in getattr(self, name) or ():
                if not 0 <= light < count:
                    problem = f"{name} names light {light}"
                    raise InputError(f"{problem}: the scene has {count}, counted from 0")

    def as_dict(self) -> dict[str, Any]:
        """Return the values that differ from the defaults, as plain data for TOML and JSON."""
        return plain(self, changed=True)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Shading:
        """Return the shading that a table from :meth:`as_dict` describes. Raises InputError for an
        unknown key, or a value outside its domain."""
        return build(cls, table, "shading")
