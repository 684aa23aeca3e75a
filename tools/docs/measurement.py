"""Reader of measure.json, which ``facerender measure`` writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facerender.errors import InputError
from facerender.measure.measurement import (
    MODELS,
    SCHEMA,
    ImageError,
    MeasuredVariant,
    Measurement,
    Settings,
)
from facerender.pricing.cost import Interval, Variant, of_model


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
    return Measurement(
        environment=content["environment"],
        settings=Settings(**content["settings"] | {"size": tuple(content["settings"]["size"])}),
        variants=[_measured_variant(row) for row in content["variants"]],
        not_measured=content["not_measured"],
    )


def _measured_variant(row: Mapping[str, Any]) -> MeasuredVariant:
    cost, error = row["cost"], row["error"]
    return MeasuredVariant(
        _variant(row["model"], row["name"]),
        lobe_ns=cost["lobe_ns"] and Interval(**cost["lobe_ns"]),
        term_ns=Interval(**cost["term_ns"]),
        frame_ms=cost["frame_ms"] and Interval(**cost["frame_ms"]),
        lobe_error=error["lobe"],
        brdf_error=error["brdf"],
        image_error=error["image"] and ImageError(**error["image"]),
    )


def _variant(model: str, name: str) -> Variant:
    for variant in (variant for known in MODELS for variant in of_model(known)):
        if (variant.model, variant.name) == (model, name):
            return variant
    raise InputError(f"unknown variant {name!r} of {model!r} in the measurement; measure again")
