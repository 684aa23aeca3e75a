"""Builds the JSON Schema of a job table's rows from dataclasses, ranges and registered terms."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from facerender.batch.jobs import ID, OUTPUTS, TABLE_KINDS
from facerender.loading.source import NORMAL_MAP_Y
from facerender.scenes.camera import AZIMUTHS_BY_NAME, DISTORTIONS, Camera
from facerender.scenes.file import ImageSettings
from facerender.scenes.light import LIGHT_TEXTS, LIGHTS
from facerender.scenes.material import MAPS, Material
from facerender.scenes.presets import PRESETS
from facerender.scenes.scene import Scene
from facerender.scenes.vectors import SHAPE_WEIGHTS, Vector
from facerender.shading import DIFFUSE, OUTSIDE, SCATTER_SAMPLES, Shading, Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, GPower
from facerender.terms.ranges import (
    EXPOSURES,
    IntegerRange,
    Range,
    SizeRange,
    VectorRange,
    range_of,
    ranges_of,
)
from facerender.terms.scattering import MOST, PROFILES, Gaussians

Schema = dict[str, Any]

_TYPES: dict[Any, str] = {float: "number", int: "integer", bool: "boolean", str: "string"}


def schema() -> Schema:
    """Return the JSON Schema (draft 2020-12) of a row, with nested tables or dotted keys."""
    text = {"type": "string"}
    tables = {name: _table(name, kind) for name, kind in TABLE_KINDS.items()}
    lights = tables.pop("lights")
    tables |= {name: {"anyOf": [text, tables[name]]} for name in ("mesh", "environment", "camera")}
    for name in ("ambient", "background"):
        tables[name] = _default(_of_range(range_of(Scene, name)), getattr(Scene, name))
    tables["background"]["anyOf"].insert(0, {"const": "none"})
    tables |= {"lights": _lights(lights), "parts": _parts(), "shading": _shading()}
    tables["landmarks"] = {"type": "string", "description": "JSON file of landmarks"}
    outputs = {"type": "array", "items": _enum(OUTPUTS), "minItems": 1, "uniqueItems": True}
    properties: dict[str, Schema] = {
        "id": {
            "anyOf": [{"type": "integer"}, {"type": "string", "pattern": f"^({ID}|.*[{{].*)$"}],
            "description": "name of the job's files; fields: {number:08d}, {mesh.stem}, {KEY}",
            "default": "{number:08d}",
        },
        "outputs": _default({"anyOf": [outputs, _NAMES_AS_TEXT]}, [OUTPUTS[0]]),
        "exposure": _default(_of_range(EXPOSURES), 0.0),
        "scene": {"type": "string", "description": "scene file; values of the row override it"},
        "meta": {"type": "object", "description": "values that the job's record repeats"},
    }
    dotted = {
        f"^{key}$": subschema
        for name, table in tables.items()
        for key, subschema in _dotted(name, table)
        if key != name
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A row of a table of jobs",
        **_object(properties | tables),
        "patternProperties": dotted | {r"^meta\.": {}},
    }


def _lights(table: Schema) -> Schema:
    text = {"type": "string", "description": LIGHT_TEXTS, "examples": [*LIGHTS]}
    names = [
        next(n for n, named_light in LIGHTS.items() if named_light == light)
        for light in Scene.lights
    ]
    return _default({"anyOf": [text, _array({"anyOf": [text, table]})]}, names)


def _parts() -> Schema:
    factors = _fields("material", Material)
    table = _object({"preset": _enum(PRESETS)} | _without_defaults(factors))
    return {
        "type": "object",
        "patternProperties": {"^[^.]+$": table},
        "additionalProperties": table,  # names with dots, which a dotted key cannot have
        "default": {},
    }


def _without_defaults(properties: Mapping[str, Schema]) -> dict[str, Schema]:
    return {
        name: {key: subschema[key] for key in subschema if key != "default"}
        for name, subschema in properties.items()
    }


def _shading() -> Schema:
    terms = _fields("shading", Term)
    # No defaults: a field that a light lacks gets the value that applies to all lights.
    lights = _object(_without_defaults(terms))
    parameters = inspect.signature(Shading).parameters.values()
    defaults = {
        parameter.name: parameter.default for parameter in parameters if parameter.name not in terms
    }
    del defaults["term"], defaults["lights"]
    properties = _properties(
        "shading", get_type_hints(Shading.__init__), defaults, ranges_of(Shading)
    )
    by_light = {
        "type": "object",
        "patternProperties": {"^[0-9]+$": lights},
        "additionalProperties": False,
        "default": {},
    }
    return _object(terms | properties | {"lights": by_light})


def _table(name: str, kind: Any) -> Schema:
    required = [field.name for field in fields(kind) if field.default is MISSING]
    return _object(_fields(name, kind)) | ({"required": required} if required else {})


def _fields(table: str, kind: Any) -> dict[str, Schema]:
    hints = get_type_hints(kind, localns={"Gaussians": Gaussians})
    without = MAPS if kind is Material else ()
    defaults = {field.name: field.default for field in fields(kind) if field.name not in without}
    return _properties(table, hints, defaults, ranges_of(kind))


def _properties(
    table: str, hints: Mapping[str, Any], defaults: Mapping[str, Any], ranges: Mapping[str, Range]
) -> dict[str, Schema]:
    properties = {}
    for name, default in defaults.items():
        if (subschema := _SPECIAL.get(f"{table}.{name}")) is None:
            subschema = _of_range(ranges[name]) if name in ranges else _of_type(hints[name])
        properties[name] = _default(subschema, default)
    return properties


def _object(properties: dict[str, Schema]) -> Schema:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _array(items: Schema, count: int | None = None) -> Schema:
    exactly = {} if count is None else {"minItems": count, "maxItems": count}
    return {"type": "array", "items": items, **exactly}


def _enum(values: Iterable[Any]) -> Schema:
    return {"enum": [*values]}


def _default(subschema: Schema, value: Any) -> Schema:
    if value is MISSING or value is None:
        return dict(subschema)
    return subschema | {"default": list(value) if isinstance(value, tuple) else value}


def _of_range(limits: Range) -> Schema:
    """Return the schema of the numbers in a range."""
    number: Schema = {"type": "integer" if isinstance(limits, IntegerRange) else "number"}
    for name, end in (("minimum", limits.low), ("maximum", limits.high)):
        if math.isfinite(end):
            number[name] = int(end) if abs(end) < 2**53 and end == int(end) else end
    if isinstance(limits, SizeRange):
        return _array(number, 2)
    return _vector(number) if isinstance(limits, VectorRange) else number


def _of_type(hint: Any) -> Schema:
    """Return the JSON Schema of the plain data that represent values of a Python type.

    Raises
    ------
    TypeError : the type is unknown
    """
    if hint in _TYPES:
        return {"type": _TYPES[hint]}
    if hint == Vector:
        return _vector({"type": "number"})
    origin, inner = get_origin(hint), [arg for arg in get_args(hint) if arg is not type(None)]
    if origin is Literal:
        return _enum(inner)
    if origin in (Union, types.UnionType):
        options = [_of_type(option) for option in inner]
        return options[0] if len(options) == 1 else {"anyOf": options}
    if origin in (tuple, list, Sequence):
        several = inner[-1:] == [...] or len(inner) == 1
        return _array(_of_type(inner[0]), None if several else len(inner))
    raise TypeError(f"no schema for {hint!r}: add one to _SPECIAL")


def _vector(number: Schema) -> Schema:
    return {"anyOf": [number, _array(number, 3)]}


def _dotted(key: str, subschema: Schema) -> Iterator[tuple[str, Schema]]:
    """Yield a pair for each dotted key of a value: the key's regular expression and its schema."""
    yield key, subschema
    for branch in subschema.get("anyOf", [subschema]):
        for name, inner in branch.get("properties", {}).items():
            yield from _dotted(rf"{key}\.{name}", inner)
        for pattern, inner in branch.get("patternProperties", {}).items():
            yield from _dotted(rf"{key}\.{pattern.strip('^$')}", inner)
        if "items" in branch:
            max_items = branch.get("maxItems", 11)
            index = f"[0-{max_items - 1}]" if max_items <= 10 else "[0-9]+"
            yield from _dotted(rf"{key}\.{index}", branch["items"])


_NAMES_AS_TEXT: Schema = {"type": "string", "description": "comma-separated names"}
_NAMES: Schema = {"anyOf": [_array({"type": "string"}), _NAMES_AS_TEXT]}
_INDICES: Schema = _array({"type": "integer", "minimum": 0}) | {"uniqueItems": True}
_SIZE = _of_range(range_of(ImageSettings, "size"))
_ROW_OF_3, _ROW_OF_4 = (_array({"type": "number"}, count) for count in (3, 4))
_GAUSSIAN = _array({"type": "number", "minimum": 0}, 4)

# Fields whose valid values do not follow from their types and ranges.
_SPECIAL: dict[str, Schema] = {
    "mesh.parts": _NAMES,
    "mesh.hide": _NAMES,
    "mesh.normal_map_y": _enum(NORMAL_MAP_Y),
    "camera.azimuth": {"anyOf": [_of_range(range_of(Camera, "azimuth")), _enum(AZIMUTHS_BY_NAME)]},
    "camera.extrinsics": _array(_ROW_OF_4, 3),
    "camera.intrinsics": _array(_ROW_OF_3, 3),
    "camera.distortion": {"anyOf": [_array({"type": "number"}, count) for count in DISTORTIONS]},
    "material.second_uv": _array(_enum(MAPS)),
    "material.scattering": {
        "anyOf": [
            _enum([*PROFILES, "none"]),
            _array(_GAUSSIAN) | {"minItems": 1, "maxItems": MOST},
        ]
    },
    "shading.model": _enum(MODELS),
    "shading.lobe": {"anyOf": [_enum(LOBES)]},
    "shading.fresnel": _enum(FRESNEL),
    "shading.masking": _enum(MASKING),
    "shading.outside": _enum(OUTSIDE),
    "shading.diffuse": _enum(DIFFUSE),
    "shading.scatter_samples": _enum(SCATTER_SAMPLES),
    "shading.environment_samples": {
        **_of_range(range_of(Shading, "environment_samples")),
        "multipleOf": 2,
    },
    "shading.specular_lights": _INDICES,
    "shading.shadow_lights": _INDICES,
    "shading.frontal_lights": _INDICES,
    **{
        f"{table}.weights": {
            "type": "object",
            "patternProperties": {"^[^.]+$": _of_range(SHAPE_WEIGHTS)},
            "additionalProperties": _of_range(SHAPE_WEIGHTS),
        }
        for table in ("pose", "before")
    },
    "planned.sizes": _array(_SIZE) | {"minItems": 1},
    "planned.samples": {"type": "integer", "minimum": 1},
    "image.size": {
        "anyOf": [_SIZE, _SIZE["items"], {"type": "string", "pattern": "^[0-9]+(x[0-9]+)?$"}]
    },
}
_SPECIAL["shading.lobe"]["anyOf"].append(_table("lobe", GPower))
