"""The JSON Schema of a row of a job table, made of the dataclasses and the registry."""

from __future__ import annotations

import inspect
import types
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, fields
from typing import Any, Union, get_args, get_origin, get_type_hints

from facerender.batch.jobs import EXPOSURE_LIMITS, ID, LIMITS, PASSES
from facerender.job import ImageSettings, MeshFile
from facerender.loading.source import NORMAL_MAP_Y
from facerender.scenes.camera import FRAMES, Camera
from facerender.scenes.file import EnvironmentFile
from facerender.scenes.light import LIGHTS, Light
from facerender.scenes.material import MAPS, Alpha, Material
from facerender.scenes.scene import Scene
from facerender.scenes.vectors import Vector
from facerender.shading import (
    DIFFUSE,
    MAX_ENVIRONMENT_SAMPLES,
    OUTSIDE,
    SCATTER_SAMPLES,
    Shading,
    Term,
)
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, GPower
from facerender.terms.scattering import MOST, PROFILES, Gaussians

Schema = dict[str, Any]

_TYPES: dict[Any, str] = {float: "number", int: "integer", bool: "boolean", str: "string"}
_POSITIVE: Schema = {"type": "number", "minimum": 0}
_NUMBER: Schema = {"type": "number"}


def schema() -> Schema:
    """Return the JSON Schema, draft 2020-12, of a row: nested tables, or dotted keys."""
    tables: dict[str, Schema] = {
        "mesh": {"anyOf": [{"type": "string"}, _table("mesh", MeshFile)]},
        "material": _table("material", Material, MAPS),
        "camera": _table("camera", Camera),
        "lights": _lights(),
        "environment": {"anyOf": [{"type": "string"}, _table("environment", EnvironmentFile)]},
        "ambient": _vector(_POSITIVE) | {"default": _data(Scene.ambient)},
        "background": {
            "anyOf": [{"const": "none"}, *_vector(_POSITIVE)["anyOf"]],
            "default": _data(Scene.background),
        },
        "shading": _shading(),
        "image": _table("image", ImageSettings),
    }
    low, high = EXPOSURE_LIMITS
    names: Schema = {"enum": [*PASSES]}
    own: dict[str, Schema] = {
        "id": {
            "anyOf": [{"type": "integer"}, {"type": "string", "pattern": f"^({ID}|.*[{{].*)$"}],
            "description": "names the job's files; may hold {number:08d}, {mesh.stem}, {KEY}",
            "default": "{number:08d}",
        },
        "passes": {
            "anyOf": [
                {"type": "array", "items": names, "minItems": 1, "uniqueItems": True},
                {"type": "string", "description": "names with commas between"},
            ],
            "default": [PASSES[0]],
        },
        "exposure": {"type": "number", "minimum": low, "maximum": high, "default": 0.0},
    }
    dotted = {
        f"^{key}$": each
        for name, table in tables.items()
        for key, each in _dotted(name, table)
        if key != name
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A row of a table of jobs",
        "type": "object",
        "properties": own | tables,
        "patternProperties": dotted,
        "additionalProperties": False,
    }


def _lights() -> Schema:
    text = {
        "type": "string",
        "description": "a name, AZIMUTH,ELEVATION[,IRRADIANCE] or point:X,Y,Z[,IRRADIANCE], and "
        "behind it ,radius=DEGREES and ,shadow",
        "examples": [*LIGHTS],
    }
    each = {"anyOf": [text, _table("lights", Light)]}
    names = [next(n for n, known in LIGHTS.items() if known == light) for light in Scene.lights]
    return {"anyOf": [text, {"type": "array", "items": each}], "default": names}


def _shading() -> Schema:
    hints = get_type_hints(Shading.__init__)
    terms = {each.name: each.default for each in fields(Term)}
    properties = {}
    for name, parameter in inspect.signature(Shading).parameters.items():
        if name not in ("term", "lights"):
            default = terms.get(name, parameter.default)
            properties[name] = _field(f"shading.{name}", hints[name], default)
    own = _table("shading", Term)
    for each in own["properties"].values():
        each.pop("default", None)  # that of the shading counts
    properties["lights"] = {
        "type": "object",
        "patternProperties": {"^[0-9]+$": own},
        "additionalProperties": False,
        "default": {},
    }
    return _object(properties)


def _table(name: str, kind: Any, without: Sequence[str] = ()) -> Schema:
    hints = get_type_hints(kind, localns={"Gaussians": Gaussians})
    told = _object(
        {
            each.name: _field(f"{name}.{each.name}", hints[each.name], each.default)
            for each in fields(kind)
            if each.name not in without
        }
    )
    needed = [each.name for each in fields(kind) if each.default is MISSING]
    return told | ({"required": needed} if needed else {})


def _object(properties: dict[str, Schema]) -> Schema:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _field(name: str, hint: Any, default: Any) -> Schema:
    told = dict(_SPECIAL[name]) if name in _SPECIAL else _of_type(hint)
    table, _, key = name.partition(".")
    if key in LIMITS.get(table, {}) and name not in _SPECIAL:
        low, high = LIMITS[table][key]
        told |= {"minimum": low} | ({"maximum": high} if high < 2**63 else {})
    return told if default in (MISSING, None) else told | {"default": _data(default)}


def _of_type(hint: Any) -> Schema:
    """Return what a type admits of plain data.

    Raises
    ------
    TypeError : a type of which that is not known
    """
    if hint in _TYPES:
        return {"type": _TYPES[hint]}
    if hint == Vector:
        return _vector(_NUMBER)
    origin, inner = get_origin(hint), [each for each in get_args(hint) if each is not type(None)]
    if origin in (Union, types.UnionType):
        options = [_of_type(each) for each in inner]
        if {"type": "number"} in options:
            options = [each for each in options if each != {"type": "integer"}]
        return options[0] if len(options) == 1 else {"anyOf": options}
    if origin in (tuple, list, Sequence):
        if inner[-1:] == [...] or len(inner) == 1:
            return {"type": "array", "items": _of_type(inner[0])}
        count = len(inner)
        return {"type": "array", "items": _of_type(inner[0])} | _exactly(count)
    raise TypeError(f"no schema is known of {hint!r}: say it in _SPECIAL")


def _exactly(count: int) -> Schema:
    return {"minItems": count, "maxItems": count}


def _vector(number: Schema) -> Schema:
    return {"anyOf": [number, {"type": "array", "items": number, **_exactly(3)}]}


def _rows(columns: int) -> Schema:
    row = {"type": "array", "items": _NUMBER, **_exactly(columns)}
    return {"type": "array", "items": row, **_exactly(3)}


def _data(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _dotted(key: str, told: Schema) -> Iterator[tuple[str, Schema]]:
    """Yield what dotted keys admit, each as a regular expression."""
    yield key, told
    for each in told.get("anyOf", [told]):
        for name, inner in each.get("properties", {}).items():
            yield from _dotted(rf"{key}\.{name}", inner)
        for pattern, inner in each.get("patternProperties", {}).items():
            yield from _dotted(rf"{key}\.{pattern.strip('^$')}", inner)
        if "items" in each:
            most = each.get("maxItems", 11)
            place = f"[0-{most - 1}]" if most <= 10 else "[0-9]+"
            yield from _dotted(rf"{key}\.{place}", each["items"])


_side = {
    "type": "integer",
    **dict(zip(("minimum", "maximum"), LIMITS["image"]["size"], strict=True)),
}
_names: Schema = {
    "anyOf": [
        {"type": "array", "items": {"type": "string"}},
        {"type": "string", "description": "names with commas between"},
    ]
}
_indices: Schema = {
    "type": "array",
    "items": {"type": "integer", "minimum": 0},
    "uniqueItems": True,
}

# What types do not tell.
_SPECIAL: dict[str, Schema] = {
    "mesh.parts": _names,
    "mesh.hide": _names,
    "mesh.normal_map_y": {"enum": [*NORMAL_MAP_Y]},
    "camera.frame": {"enum": [*FRAMES]},
    "camera.extrinsics": _rows(4),
    "camera.intrinsics": _rows(3),
    "camera.size": {"type": "array", "items": {"type": "integer", "minimum": 1}, **_exactly(2)},
    "lights.irradiance": _vector(_POSITIVE),
    "material.albedo": _vector(_POSITIVE),
    "material.alpha": {"enum": [*get_args(Alpha)]},
    "material.emissive": _vector(_POSITIVE),
    "material.second_uv": {"type": "array", "items": {"enum": [*MAPS]}},
    "material.scattering": {
        "anyOf": [
            {"enum": [*PROFILES, "none"]},
            {
                "type": "array",
                "items": {"type": "array", "items": _POSITIVE, **_exactly(4)},
                "minItems": 1,
                "maxItems": MOST,
            },
        ]
    },
    "shading.model": {"enum": [*MODELS]},
    "lobe.g": {"type": "integer", "minimum": 1, "maximum": 31},
    "lobe.factor": {"type": "number", "exclusiveMinimum": 0},
    "shading.fresnel": {"enum": [*FRESNEL]},
    "shading.masking": {"enum": [*MASKING]},
    "shading.outside": {"enum": [*OUTSIDE]},
    "shading.diffuse": {"enum": [*DIFFUSE]},
    "shading.scatter_samples": {"enum": [*SCATTER_SAMPLES]},
    "shading.environment_samples": {
        "type": "integer",
        "minimum": 0,
        "maximum": MAX_ENVIRONMENT_SAMPLES,
        "multipleOf": 2,
    },
    "shading.specular_lights": _indices,
    "shading.shadow_lights": _indices,
    "shading.frontal_lights": _indices,
    "shading.lights": {},
    "image.size": {
        "anyOf": [
            {"type": "array", "items": _side, **_exactly(2)},
            _side,
            {"type": "string", "pattern": "^[0-9]+(x[0-9]+)?$"},
        ]
    },
}
_SPECIAL["shading.lobe"] = {"anyOf": [{"enum": [*LOBES]}, _table("lobe", GPower)]}
