"""Reader of measure.json, which ``facerender measure`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facerender.errors import InputError
from facerender.measure.measurement import (
    MODELS,
    SCHEMA,
    Costs,
    DisplayError,
    Environment,
    Errors,
    ImageError,
    MeasuredVariant,
    Measurement,
    PartSetting,
    SampleSetting,
    Settings,
)
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant, of_model


def measurement_of(content: Mapping[str, Any]) -> Measurement:
    """Return the measurement from the data of :meth:`Measurement.as_dict`.

    Raises
    ------
    InputError : another schema, or a variant that this version does not have
    """
    if content["schema"] != SCHEMA:
        raise InputError(
            f"the measurement's schema is {content['schema']!r}, not {SCHEMA!r}; measure again"
        )
    curves = dict(content["curves"])
    return Measurement(
        environment=Environment(**content["environment"]),
        settings=Settings(**content["settings"] | {"size": tuple(content["settings"]["size"])}),
        variants=[_measured_variant(row) for row in content["variants"]],
        samples=[_sample_setting(row) for row in content.get("samples", [])],
        degrees=curves.pop("degrees"),
        curves=curves,
        not_measured=content["not_measured"],
        skin=[_part_setting(row) for row in content.get("skin", ())],
    )


def _measured_variant(row: Mapping[str, Any]) -> MeasuredVariant:
    cost, error = row["cost"], row["error"]
    return MeasuredVariant(
        _variant(row["model"], row["name"]),
        Costs(
            lobe_ns=cost["lobe_ns"] and Interval(**cost["lobe_ns"]),
            term_ns=Interval(**cost["term_ns"]),
            frame_ms=cost["frame_ms"] and Interval(**cost["frame_ms"]),
        ),
        Errors(error["lobe"], error["brdf"], error["image"] and ImageError(**error["image"])),
    )


def _sample_setting(row: Mapping[str, Any]) -> SampleSetting:
    errors = DisplayError(**row["silhouette"]), DisplayError(**row["inside"])
    return SampleSetting(row["samples"], Interval(**row["time"]), *errors, row["shading_rate"])


def _part_setting(row: Mapping[str, Any]) -> PartSetting:
    error = DisplayError(**row["error"])
    return PartSetting(row["part"], row["setting"], Interval(**row["time"]), error)


def _variant(model: str, name: str) -> Variant:
    for variant in (variant for known in MODELS for variant in of_model(known)):
        if (variant.model, variant.name) == (model, name):
            return variant
    raise InputError(f"unknown variant {name!r} of {model!r} in the measurement; measure again")
