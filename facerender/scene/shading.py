"""The shading of a scene: the specular term of its lights, and the features that are left out.
Shadings convert to and from TOML and JSON. ``glsl/code.py`` generates the GLSL of the terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, asdict, dataclass, field, fields, replace
from operator import index
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_known, check_type, short_repr, shown
from facerender.material import WEIGHTS
from facerender.terms import FRESNEL, MASKING, MODELS, AnyLobe, GPower, Model, lobe_entry
from facerender.terms.lobe import SLOPES, named
from facerender.values.ranges import IntegerRange, check_fields, range_of, ranged

S = TypeVar("S")

OUTSIDE = ("error", "exact")
DIFFUSE = ("lambert", "coupled")
SMALL_SLOPE = 0.2  # Lowest m at which the exact lobe is accurate without FR_SMALL_SLOPE.
SCATTER_SAMPLES = (0, 8, 16, 32, 64)


@dataclass(frozen=True)
class Term:
    """A specular term.

    Parameters
    ----------
    model, lobe, fresnel, masking : names in the registry; defaults "cook-torrance", "exact",
        "schlick", "v-cavity". The lobe may be a :class:`facerender.lobes.GPower`. Only
        Cook-Torrance has a Fresnel and a masking term
    m : RMS slope that replaces the m of all materials; None (default) for the m of each material
    small_slope : whether to compute the exact lobe accurately for small angles; None (default):
        only if m is below 0.2

    Raises
    ------
    InputError : an unknown name, or m outside its domain
    """

    model: str = "cook-torrance"
    lobe: AnyLobe = "exact"
    fresnel: str = "schlick"
    masking: str = "v-cavity"
    m: float | None = ranged(SLOPES, None)
    small_slope: bool | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        lobe_entry(self.lobe)
        model = named("model", MODELS, self.model)
        named("Fresnel term", FRESNEL, self.fresnel)
        named("masking term", MASKING, self.masking)
        for noun, name in (("Fresnel", "fresnel"), ("masking", "masking")):
            if not model.factors and (value := getattr(self, name)) != getattr(Term, name):
                raise InputError(f"{self.model} has no {noun} term: leave {shown(value)} out")
        check_fields(self)

    @property
    def entry(self) -> Model:
        """The registry entry of the model."""
        return MODELS[self.model]

    def for_slopes(self, smallest: float, largest: float, outside: str = "error") -> Term:
        """Return the term for a material: this term, or a copy of it with the exact lobe.

        smallest, largest : range of the material's m
        outside : action if m lies outside the lobe's domain: "error" to raise InputError, or
            "exact" for the exact lobe
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
        """Return whether the exact lobe is computed accurately for small angles, if the lowest m of
        the material is ``smallest_m``."""
        if self.small_slope is not None:
            return self.small_slope
        return self.slope(smallest_m) < SMALL_SLOPE

    def brdf(
        self, n: ArrayLike, l: ArrayLike, v: ArrayLike, m: ArrayLike, f0: float
    ) -> NDArray[np.float64]:
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


class _OfTerm:
    """Default of a parameter: the field of `term` is kept. An instance has it as attribute, because
    :func:`dataclasses.replace` reads the attribute of every parameter."""

    def __repr__(self) -> str:
        return "a field of Shading.term"


_OF_TERM: Any = _OfTerm()


@dataclass(frozen=True)
class Shading:
    """The specular term of the lights, and the features that are left out of a scene.

    Parameters
    ----------
    model, lobe, fresnel, masking, m, small_slope : fields of :class:`Term`, which override the
        fields of ``term``
    term : specular term of all lights; default ``Term()``
    specular_lights : indices of the lights with a specular term; None (default) for all
    shadow_lights : indices of the lights whose shadows are drawn; None (default) for all lights
        that cast shadows
    outside : action if a material's m lies outside the lobe's domain: "error" (default), or "exact"
        for the exact lobe
    ks : one specular weight that replaces the weights of materials and specular maps; default None
    diffuse : "lambert" (default), or "coupled" for the energy-conserving diffuse term, which
        assumes Cook-Torrance with the exact lobe, Schlick's Fresnel term and V-cavity masking
    normal_map : whether to use normal maps, default true
    ambient : whether to use ambient light, default true
    environment : whether to use environment maps, default true
    two_lobes : whether to use both lobes of a material, default true; false for only the first lobe
    environment_samples : number of sampled directions per lobe, an even number up to 4096, default
        32; 0 leaves the specular environment light out
    slope_filter : specular antialiasing of normal maps, default true: widen the lobe by the map's
        slopes that a pixel does not resolve
    scatter_samples : subsurface samples per pixel: 8, 16 (default), 32 or 64; 0 leaves scattering
        out

    slope_filter and area lights do not widen the lobe of a term with a constant m.

    Raises
    ------
    InputError : an unknown name, or a value outside its domain
    """

    term: Term = field(default=Term(), kw_only=True)
    model: InitVar[str] = _OF_TERM
    lobe: InitVar[AnyLobe] = _OF_TERM
    fresnel: InitVar[str] = _OF_TERM
    outside: str = "error"
    masking: InitVar[str] = _OF_TERM
    _: KW_ONLY
    m: InitVar[float | None] = _OF_TERM
    small_slope: InitVar[bool | None] = _OF_TERM
    ks: float | None = ranged(WEIGHTS, None)
    normal_map: bool = True
    ambient: bool = True
    two_lobes: bool = True
    slope_filter: bool = True
    environment: bool = True
    diffuse: str = "lambert"
    scatter_samples: int = 16
    environment_samples: int = ranged(IntegerRange(0, 4096), 32)
    specular_lights: Sequence[int] | None = None
    shadow_lights: Sequence[int] | None = None

    __repr__ = short_repr

    def __post_init__(self, *of_term: Any) -> None:
        check_type("term", self.term, Term, "a Term")
        pairs = zip((field.name for field in fields(Term)), of_term, strict=True)
        if overrides := {name: value for name, value in pairs if value is not _OF_TERM}:
            object.__setattr__(self, "term", replace(self.term, **overrides))
        for name in ("specular_lights", "shadow_lights"):
            if (lights := getattr(self, name)) is not None:
                object.__setattr__(self, name, _indices(name, lights))
        texts = ("outside", "value of outside:", OUTSIDE), ("diffuse", "diffuse term", DIFFUSE)
        for name, noun, choices in texts:
            check_type(name, value := getattr(self, name), str, "a string")
            check_known(noun, value, choices)
        counts = range_of(Shading, "environment_samples")
        if self.environment_samples not in counts or self.environment_samples % 2:
            raise InputError(
                f"environment_samples = {shown(self.environment_samples)}: give an even number up "
                f"to {counts.high:g}"
            )
        check_fields(self)
        count = self.scatter_samples
        if not isinstance(count, int | float) or count is True or count not in SCATTER_SAMPLES:
            words = ", ".join(map(str, SCATTER_SAMPLES))
            raise InputError(f"scatter_samples = {shown(count)}: give one of {words}")

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
                    raise InputError(
                        f"{name} names light {light}: the scene has {count}, counted from 0"
                    )

    def as_dict(self) -> dict[str, Any]:
        """Return the values that differ from the defaults, as plain data for TOML and JSON."""
        values = asdict(self.term) | {name: getattr(self, name) for name in _FIELDS}
        changed = {key: values[key] for key in _KEYS if values[key] != _DEFAULTS[key]}
        return {key: [*v] if isinstance(v, tuple) else v for key, v in changed.items()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Shading:
        """Return the shading that a table from :meth:`as_dict` describes. Raises InputError for an
        unknown key, or a value outside its domain."""
        if not isinstance(table, Mapping):
            raise InputError(f"shading = {shown(table)}: give a table")
        if unknown := sorted(set(table) - set(_KEYS)):
            raise InputError(
                f"unknown key {shown(unknown[0])} in shading; known: {', '.join(_KEYS)}"
            )
        values = dict(table)
        if "lobe" in values:
            values["lobe"] = _lobe(values["lobe"])
        return cls(**values)


_FIELDS = {field.name: field.default for field in fields(Shading)}
# Keys of a shading in TOML and JSON, with their defaults.
_DEFAULTS = asdict(Term()) | _FIELDS
_KEYS = (
    *("model", "lobe", "fresnel", "outside", "masking", "small_slope", "m"),
    *(name for name in _FIELDS if name not in ("term", "outside")),
)


def _indices(name: str, lights: Any) -> tuple[int, ...]:
    try:
        indices = {index(light) for light in lights if not isinstance(light, bool)}
        if len(indices) < len(lights):
            raise TypeError
    except TypeError:
        raise InputError(
            f"{name} = {shown(lights)}: give a list of whole numbers, each once"
        ) from None
    return tuple(sorted(indices))


def _lobe(table: Any) -> Any:
    if not isinstance(table, Mapping):
        return table
    try:
        return GPower(**table)
    except TypeError:
        raise InputError(f"lobe = {shown(table)}: give a name, or g, factor, offset") from None
