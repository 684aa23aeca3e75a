"""Materials: the reflectance factors and the maps of a part, and presets of factors under a name.

``loading/conventions.py`` gives parts presets."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

from facerender.errors import InputError, check_known, quoted
from facerender.terms.lobe import MIN_SLOPE, SLOPES
from facerender.texture.texture import MAX_TEXELS, Texture, pack
from facerender.values.fields import (
    FRACTION,
    SWITCH,
    Choice,
    Instance,
    Limits,
    Range,
    build,
    field,
    record,
)
from facerender.values.vectors import COLORS, MAX_RADIANCE, Vector, numbers_in

if TYPE_CHECKING:
    from facerender.terms.transport import Gaussians

SKIN_ALBEDO: Vector = (0.48, 0.28, 0.21)  # linear RGB; default of meshes without colours

Alpha = Literal["opaque", "mask", "blend"]

# Maps that can be packed in the red, green and blue channels of one texture.
PROPERTY_MAPS = ("occlusion_map", "roughness_map", "specular_map")
MAPS = (
    *("albedo_map", "normal_map", "roughness_map", "specular_map", "occlusion_map"),
    *("lobe_map", "opacity_map", "emissive_map"),
)
MAX_NORMAL_STRENGTH = 100.0
# Specular and diffuse weights. Their products with any radiance stay within float32.
WEIGHTS = Range(0.0, 1e6)
# Maps are objects: scene files and tables change factors, MeshFile has the image files.
_TEXTURE = Instance(Texture, "facerender.Texture.open(FILE) or None")


# A mesh file may set some factors; the default of the record then does not apply.
def _or_file(default: float) -> str:
    return f"{default:g} or the mesh file's"


@dataclass(frozen=True)
class _MapNames(Limits):
    """Names of maps, in a list or in a text with commas, as ``--part`` has them."""

    def check(self, name: str, value: Any) -> Any:
        names = value.split(",") if isinstance(value, str) else value
        if not isinstance(names, tuple | list) or any(n not in MAPS for n in names):
            raise InputError(f"{name} = {quoted(names)}: give some of {', '.join(MAPS)}")
        return tuple(names)


class _Profiles(Limits):
    """The name of a scattering profile, or its Gaussians; "none" stands for None."""

    def check(self, name: str, value: Any) -> Any:
        if isinstance(value, str) and value == "none":
            return None
        # Most materials do not scatter, and need no import.
        from facerender.terms.transport import profile_of

        return profile_of(value)


@record()
class Material:
    """Reflectance of a part: factors and maps.

    Parameters
    ----------
    albedo_map, normal_map, roughness_map, specular_map, occlusion_map : textures or None. Of these,
        only the albedo map is sRGB-encoded. Albedo map and specular map multiply albedo and ks. The
        normal map has green pointing up. The occlusion map dims ambient light.
    lobe_map : texture or None. The red channel multiplies 1 - lobe_weight, the second lobe's
        fraction of ks: white for sweat or oil, black for dry skin.
    opacity_map : grey texture or None; multiplies the opacity
    emissive_map : sRGB-encoded texture or None; multiplies emissive
    """

    albedo: Vector = field(
        COLORS, SKIN_ALBEDO, "fraction of light that is reflected diffusely, linear RGB"
    )
    m: float = field(
        SLOPES, 0.3, "RMS slope of the microfacets", "Replaces the roughness map", _or_file(0.3)
    )
    roughness_factor: float = field(
        FRACTION, 1.0, "factor on the roughness map: m = (factor * texel)^2, as in glTF"
    )
    f0: float = field(
        Range(0.0, 0.999), 0.028, "Fresnel reflectance at normal incidence", unset=_or_file(0.028)
    )
    ks: float = field(
        WEIGHTS,
        1.0,
        "specular weight",
        "1 is a bare dielectric; for powdered skin, GPU Gems 3, chapter 14, has 0.18",
        _or_file(1),
    )
    kd: float = field(WEIGHTS, 1.0, "diffuse weight")
    second_slope: float = field(
        Range(0.01, 100.0), 1.0, "m of a second lobe, as a factor of m", unset="1: one lobe"
    )
    lobe_weight: float = field(
        FRACTION, 1.0, "fraction of the first lobe", "It is a fraction of ks", "1: one lobe"
    )
    albedo_map: Texture | None = field(_TEXTURE, None)
    normal_map: Texture | None = field(_TEXTURE, None)
    roughness_map: Texture | None = field(_TEXTURE, None)
    specular_map: Texture | None = field(_TEXTURE, None)
    occlusion_map: Texture | None = field(_TEXTURE, None)
    lobe_map: Texture | None = field(_TEXTURE, None)
    scattering: str | Gaussians | None = field(
        _Profiles(),
        None,
        "subsurface scattering",
        'Names are "skin" and "none". Gaussians have a variance in mm^2 and weights of red, green '
        "and blue. For each channel the sum of all Gaussians' weights is at most 1; the remaining "
        "light leaves where it enters",
        "none",
    )
    alpha: Alpha = field(
        Choice(get_args(Alpha), "alpha"),
        "opaque",
        "use of the opacity: opaque ignores it; mask discards fragments with an opacity below "
        "``alpha_cutoff``; blend makes the part transparent. A transparent part is drawn after all "
        "other parts, casts no shadow and does not scatter",
    )
    opacity: float = field(FRACTION, 1.0, "opacity of the part; 1 is opaque")
    alpha_cutoff: float = field(
        Range(0.0, MAX_RADIANCE), 0.5, "smallest opacity that the alpha mask draws"
    )
    opacity_map: Texture | None = field(_TEXTURE, None)
    emissive: Vector = field(
        COLORS, (0.0, 0.0, 0.0), "emitted linear radiance; it does not light other surfaces"
    )
    emissive_map: Texture | None = field(_TEXTURE, None)
    unlit: bool = field(
        SWITCH,
        False,
        "whether the albedo is the radiance, whatever the lights, as in KHR_materials_unlit of "
        "glTF. Of the other fields, only opacity and transmission then have an effect",
    )
    normal_strength: float = field(
        Range(0.0, MAX_NORMAL_STRENGTH),
        1.0,
        "factor on the slopes of normal maps",
        unset=_or_file(1),
    )
    occlusion_strength: float = field(
        FRACTION, 1.0, "strength s of the occlusion map: occlusion = 1 + s (texel - 1)"
    )
    second_uv: tuple[str, ...] = field(
        _MapNames(), (), "names of the maps that use the part's second texture coordinates"
    )
    transmission: float = field(
        FRACTION,
        0.0,
        "fraction of the diffuse light that passes through the surface instead, as in "
        "KHR_materials_transmission of glTF. The diffuse term is multiplied by 1 - transmission, "
        "the specular term is not. A part with transmission casts no shadow. With ``refraction`` 1 "
        "it is drawn as a transparent part, whatever ``alpha`` is",
    )
    refraction: float = field(
        Range(1.0, 3.0),
        1.0,
        "index of refraction behind a surface with transmission; 1 is a thin surface, which does "
        "not bend light",
    )
    double_sided: bool | None = field(
        SWITCH,
        None,
        "whether back faces are drawn, as doubleSided of glTF. None: a new mesh sets it to false "
        "if the part belongs to closed surfaces, otherwise to true. Both sides cast shadows",
    )

    def __post_init__(self) -> None:
        if self.two_lobes and self.roughness_map is None:
            # Both factors may be in their ranges, and their product may not.
            SLOPES.check("m times second_slope", self.m * self.second_slope)
        for name in ("albedo_map", "emissive_map"):
            if (texture := getattr(self, name)) is not None:
                object.__setattr__(self, name, texture.in_srgb())

    @cached_property
    def two_lobes(self) -> bool:
        """Whether there is a second lobe that differs from the first."""
        return self.second_slope != 1.0 and self.lobe_weight < 1.0

    def with_second(self, low: float, high: float) -> tuple[float, float]:
        """Return the range of m over both lobes, if m of the first lobe is in [low, high]."""
        if not self.two_lobes:
            return low, high
        slopes = low, high, *(max(end * self.second_slope, MIN_SLOPE) for end in (low, high))
        return min(slopes), max(slopes)

    @cached_property
    def slopes(self) -> tuple[float, float]:
        """Smallest and largest m over both lobes. Decodes the roughness map if there is one."""
        if self.roughness_map is None:
            return self.with_second(self.m, self.m)
        packed = self.property_map
        texels = packed.ends()[:, 1] if packed else self.roughness_map.ends()[:, 0]
        roughness = (self.roughness_factor * float(end) / 255.0 for end in texels)
        low, high = (max(end**2, MIN_SLOPE) for end in roughness)
        return self.with_second(low, high)

    @cached_property
    def property_map(self) -> Texture | None:
        """Occlusion, roughness and specular map packed in one texture, to save texture fetches.
        None without any of these maps, or if they differ in wrap mode, filtering or coordinates.
        Materials with the same maps share this texture.
        """
        return pack(*self.properties) if self.packs else None

    @property
    def properties(self) -> tuple[Texture | None, Texture | None, Texture | None]:
        """The maps named in PROPERTY_MAPS."""
        return self.occlusion_map, self.roughness_map, self.specular_map

    @cached_property
    def packs(self) -> bool:
        """Whether the maps in PROPERTY_MAPS are packed in one texture."""
        pairs = zip(PROPERTY_MAPS, self.properties, strict=True)
        return len({(name in self.second_uv, m.sampling) for name, m in pairs if m}) == 1

    def by_second(self, name: str) -> bool:
        """Return whether a map of MAPS, or "property_map", uses the second texture coordinates."""
        names = PROPERTY_MAPS if name == "property_map" else (name,)
        return any(n in self.second_uv and getattr(self, n) is not None for n in names)

    @cached_property
    def thin(self) -> bool:
        """Whether light passes through the surface without being refracted."""
        return self.transmission > 0.0 and self.refraction == 1.0

    @cached_property
    def refracts(self) -> bool:
        """Whether light passes through the surface and is refracted."""
        return self.transmission > 0.0 and self.refraction > 1.0

    @property
    def emission(self) -> Vector:
        """Emitted radiance; of an unlit surface, the factor on the albedo."""
        return (1.0 - self.transmission,) * 3 if self.unlit else self.emissive

    @cached_property
    def diffuse_weight(self) -> float:
        """Weight of the diffuse term."""
        return 0.0 if self.unlit else self.kd * (1.0 - self.transmission)

    @cached_property
    def solid(self) -> bool:
        """Whether the opacity has no visible effect. Decodes the opacity map if necessary."""
        if self.alpha == "opaque":
            return True
        min_texel = float(self.opacity_map.ends()[0, 0]) / 255.0 if self.opacity_map else 1.0
        return self.opacity * min_texel >= (1.0 if self.alpha == "blend" else self.alpha_cutoff)


def check_maps(name: str, materials: Sequence[Material]) -> None:
    """Raise InputError if the maps of a mesh have more than MAX_TEXELS in total."""
    maps: set[Texture | None] = set()
    for material in materials:
        names = set(MAPS) - set(PROPERTY_MAPS) | {"property_map"} if material.packs else MAPS
        maps.update(getattr(material, name) for name in names)
    if (total := sum(math.prod(texture.size) for texture in maps if texture)) > MAX_TEXELS:
        limit = f"more than {MAX_TEXELS / 1e6:.0f} million: make them smaller"
        raise InputError(f"the maps of {name} have {total / 1e6:.0f} million texels, {limit}")


CORNEA = 1.336  # index of the aqueous; one surface stands for cornea and aqueous
TEAR = 1.337  # index of the tear film
_ENAMEL, _KERATIN = 1.62, 1.55


def reflectance(index: float) -> float:
    """Return the Fresnel reflectance at normal incidence, from air, for an index of at least 1."""
    return ((index - 1.0) / (index + 1.0)) ** 2


# The fields that every preset sets: these values, unless the preset has its own.
_SHARED = "ks kd second_slope lobe_weight alpha opacity emissive unlit transmission refraction"
COMMON: dict[str, Any] = {name: getattr(Material, name) for name in _SHARED.split()}
_LOBES = {"second_slope": 0.333, "lobe_weight": 0.85}
_SPECIFIC: dict[str, dict[str, Any]] = {
    "skin": {"m": 0.3, "f0": 0.028, **_LOBES},
    "lips": {"m": 0.2, "f0": 0.028, **_LOBES, "lobe_weight": 0.6},
    "cornea": {"m": 0.03, "f0": reflectance(CORNEA), "transmission": 1.0, "refraction": CORNEA},
    "tear": {"m": 0.03, "f0": reflectance(TEAR), "transmission": 1.0},
    "sclera": {"albedo": (0.6, 0.55, 0.51), "m": 0.1, "f0": reflectance(TEAR)},
    "iris": {"albedo": (0.15, 0.08, 0.035), "m": 0.3, "f0": 0.028, "ks": 0.0},
    "eye-occlusion": {
        **{"albedo": (0.0, 0.0, 0.0), "m": 0.3, "f0": 0.028, "ks": 0.0, "kd": 0.0},
        **{"alpha": "blend", "opacity": 0.15},
    },
    "lashes": {
        **{"albedo": (0.012, 0.009, 0.007), "m": 0.3, "f0": reflectance(_KERATIN), "ks": 0.2},
        **{"alpha": "blend", "opacity": 0.35},
    },
    "teeth": {"albedo": (0.6, 0.54, 0.44), "m": 0.12, "f0": reflectance(_ENAMEL)},
    "hair-card": {"m": 0.3, "f0": reflectance(_KERATIN), "ks": 0.5, "alpha": "mask"},
}
PRESETS: Mapping[str, Mapping[str, Any]] = {k: {**COMMON, **v} for k, v in _SPECIFIC.items()}

# Fields that need another field: the other field, and whether a material has it.
_NEEDED: Mapping[str, tuple[str, Callable[[Material], bool]]] = {
    "roughness_factor": ("a roughness map", lambda material: material.roughness_map is not None),
    "normal_strength": ("a normal map", lambda material: material.normal_map is not None),
    "occlusion_strength": ("an occlusion map", lambda material: material.occlusion_map is not None),
    "alpha_cutoff": ("alpha mask", lambda material: material.alpha == "mask"),
    "opacity": ("alpha blend or mask", lambda m: m.alpha != "opaque" or m.transmission > 0.0),
    "refraction": ("transmission", lambda material: material.transmission > 0.0),
    **dict.fromkeys(("m", "f0", "ks", "kd"), ("unlit=false", lambda material: not material.unlit)),
}


def preset(name: Any) -> Mapping[str, Any]:
    """Return the fields of a preset; raise InputError if the name is unknown."""
    check_known("preset", name, PRESETS)
    return PRESETS[name]


@dataclass(frozen=True)
class Factors(Limits):
    """A table of fields of :class:`Material` except its maps. The values are converted.

    presets : whether the table may also have ``preset``
    """

    presets: bool = False

    def check(self, name: str, value: Any) -> Any:
        if not isinstance(value, Mapping):
            remedy = "a table of factors, or a preset, such as {'m': 0.3}"
            raise InputError(f"{name} = {quoted(value)}: give {remedy}")
        # Files have no None: the profile is named "none", and double_sided is left out.
        named = {k: "none" if v is None and k == "scattering" else v for k, v in value.items()}
        table = {k: v for k, v in named.items() if v is not None}
        chosen = {"preset": table.pop("preset")} if self.presets and "preset" in table else {}
        base = preset(chosen["preset"]) if chosen else {}
        material = build(Material, {**base, **table}, name)
        # Names stay names: a file states "skin", not the Gaussians of skin.
        converted = {k: v if isinstance(v, str) else getattr(material, k) for k, v in table.items()}
        return converted | chosen


class PartFactors(Limits):
    """Factors of some parts: for each name of parts, which may have wildcards, a table of fields of
    :class:`Material` except its maps, and ``preset``."""

    def check(self, name: str, value: Any) -> Any:
        if not isinstance(value, Mapping):
            remedy = "a table of parts, such as {'lash*': {'preset': 'lashes'}}"
            raise InputError(f"{name} = {quoted(value)}: give {remedy}")
        for pattern in value:
            if not isinstance(pattern, str) or not pattern.strip():
                raise InputError(f"{name} has the key {quoted(pattern)}: give the name of a part")
        return {key: Factors(True).check(f"{name}.{key}", table) for key, table in value.items()}


def parse_part(text: str) -> tuple[str, dict[str, Any]]:
    """Parse the material of parts from the text ``NAME=PRESET``, ``NAME,FIELD=VALUE,...`` or
    ``NAME=PRESET,FIELD=VALUE,...``. A colour is three numbers with commas. Raises InputError if the
    text has another form, or a value is outside its range."""
    first, *words = re.split(",(?=[^,]*=)", text)
    pattern, _, preset = first.partition("=")
    if not pattern or "," in first or not (preset or words):
        forms = "NAME=PRESET or NAME,FIELD=VALUE, such as 'eye*=sclera' or 'lash*,opacity=0.8'"
        raise InputError(f"--part {quoted(text)}: give {forms}; presets: {', '.join(PRESETS)}")
    table: dict[str, Any] = {"preset": preset} if preset else {}
    for word in words:
        name, _, value = word.partition("=")
        numbers = numbers_in(value.split(","))
        number = numbers[0] if len(numbers) == 1 else tuple(numbers) or value
        table[name.strip()] = value == "true" if value in ("true", "false") else number
    return pattern, Factors(True).check(f"--part.{pattern}", table)


def part_text(pattern: str, table: Mapping[str, Any]) -> str:
    """Return the text of the materials of parts that :func:`parse_part` parses."""
    factors = dict(table)
    preset = f"={factors.pop('preset')}" if "preset" in factors else ""
    words = [
        f"{name}={','.join(f'{number:g}' for number in value)}"
        if isinstance(value, tuple | list)
        else f"{name}={str(value).lower() if isinstance(value, bool) else value}"
        for name, value in factors.items()
    ]
    return ",".join([f"{pattern}{preset}", *words])


def changed(material: Material, table: Mapping[str, Any]) -> Material:
    """Return a material with the values of a table.

    A new ``m`` also removes the roughness map. A preset does not tint an albedo map, and does not
    change how an opacity map is used. Raises InputError if the preset is unknown, a value is
    outside its range, or the table has both ``m`` and ``roughness_map``.

    table : fields of :class:`Material`, and ``preset``, whose fields apply first
    """
    values = dict(table)
    if "m" in values and values.get("roughness_map") is not None:
        pair = f"m = {quoted(values['m'])} and roughness_map"
        raise InputError(f"{pair} exclude each other: leave one out")
    if (name := values.pop("preset", None)) is not None:
        preset_fields = dict(preset(name))
        if material.albedo_map is not None:
            preset_fields.pop("albedo", None)
        if material.opacity_map is not None and material.alpha != "opaque":
            del preset_fields["alpha"], preset_fields["opacity"]
        values = preset_fields | values
    if "m" in values:
        values = {"roughness_map": None, **values}
    return replace(material, **values)


def without_effect(
    table: Mapping[str, Any], old: Collection[Material], new: Collection[Material]
) -> Iterator[str]:
    """Yield the names of the changed fields that have no effect, with the reason.

    table, old, new : changes as in :func:`changed`, and the materials before and after
    """
    for name, (needed, has) in _NEEDED.items():
        differs = name in table and any(table[name] != getattr(material, name) for material in old)
        if differs and not any(map(has, new)):
            yield f"{name} = {quoted(table[name])} has no effect without {needed}"
