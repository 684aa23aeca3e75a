"""Presets: factors of materials under a name. ``loading/conventions.py`` gives parts presets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

from facerender.errors import InputError, check_known, shown
from facerender.scenes.material import Material

CORNEA = 1.336  # index of the aqueous; one surface stands for cornea and aqueous
TEAR = 1.337  # index of the tear film
_ENAMEL, _KERATIN = 1.62, 1.55


def reflectance(index: float) -> float:
    """Return the Fresnel reflectance at normal incidence, seen from air, of an index of refraction
    (at least 1)."""
    return ((index - 1.0) / (index + 1.0)) ** 2


# The fields that every preset sets: these values, unless the preset has its own.
COMMON: dict[str, Any] = {
    field.name: field.default
    for field in fields(Material)
    if field.name in ("ks", "kd", "second_slope", "lobe_weight", "alpha", "opacity")
    or field.name in ("transmission", "refraction", "emissive")
}
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
    "opacity": (
        "alpha blend or mask",
        lambda material: material.alpha != "opaque" or material.transmission > 0.0,
    ),
    "refraction": ("transmission", lambda material: material.transmission > 0.0),
}


def preset(name: Any) -> Mapping[str, Any]:
    """Return the fields of a preset; raise InputError if the name is unknown."""
    check_known("preset", name, PRESETS)
    return PRESETS[name]


def changed(material: Material, table: Mapping[str, Any]) -> Material:
    """Return a material with the values of a table.

    A new ``m`` also removes the roughness map. A preset does not tint an albedo map, and does not
    change how an opacity map is used.

    Parameters
    ----------
    table : fields of :class:`Material`, and ``preset``, whose fields apply first

    Raises
    ------
    InputError : the preset is unknown, a value is outside its range, or the table has both ``m``
        and ``roughness_map``
    """
    values = dict(table)
    if "m" in values and values.get("roughness_map") is not None:
        pair = f"m = {shown(values['m'])} and roughness_map"
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
    return material.with_values(**values)


def without_effect(
    table: Mapping[str, Any], old: Sequence[Material], new: Sequence[Material]
) -> Iterator[str]:
    """Yield the names of the changed fields that have no effect, with the reason.

    table, old, new : changes as in :func:`changed`, and the materials before and after
    """
    for name, (needed, has) in _NEEDED.items():
        differs = name in table and any(table[name] != getattr(material, name) for material in old)
        if differs and not any(map(has, new)):
            yield f"{name} = {shown(table[name])} has no effect without {needed}"
