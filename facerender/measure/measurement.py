"""Records of ``facerender measure`` and their JSON (docs/measurements/measure-schema.md).

The attributes have the names and units of the JSON, which the schema describes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.pricing.interval import Interval
from facerender.pricing.variants import PRINTED, Variant

SCHEMA = "facerender.measure/2"
MODELS = PRINTED
MAGNIFIED = 8

BySlope = Mapping[str, float | None]  # keyed by m as text, "%g" % m


@dataclass(frozen=True)
class Settings:
    """The settings of a measurement; ``m`` is the roughness of the skin."""

    mesh: str
    m: float
    size: tuple[int, int]
    repeats: int
    quick: bool

    @property
    def slope(self) -> str:
        """m as text, which is the key of m in the errors of lobe and BRDF."""
        return f"{self.m:g}"


@dataclass(frozen=True)
class ImageError:
    """Errors of an image against exact float64 shading of the same G-buffer: fractions and counts,
    never percent. ``flip`` is None without flip-evaluator."""

    point: float
    block: float
    largest: float
    percentile: float
    steps: int
    steps_percentile: float
    flip: float | None


@dataclass(frozen=True)
class MeasuredVariant:
    """A variant with its costs and errors.

    Attributes
    ----------
    lobe_ns, term_ns, frame_ms : costs of the lobe alone, the whole term and a frame; None if not
        measured
    lobe_error, brdf_error : largest errors in percent, keyed by m; None if m is outside the domain
    image_error : error of the image at the m of the settings; None if no image was drawn
    """

    variant: Variant
    lobe_ns: Interval | None
    term_ns: Interval
    frame_ms: Interval | None
    lobe_error: BySlope
    brdf_error: BySlope
    image_error: ImageError | None

    def as_dict(self) -> dict[str, Any]:
        """Return the variant's row of measure.json."""
        values, variant = asdict(self), self.variant
        return {
            **{name: getattr(variant, name) for name in ("model", "name", "lobe")},
            "cost": {name: values[name] for name in ("lobe_ns", "term_ns", "frame_ms")},
            "error": {name: values[f"{name}_error"] for name in ("lobe", "brdf", "image")},
        }


@dataclass(frozen=True, eq=False)
class Triptych:
    """Three images, 8-bit sRGB (H, W, 3): with the exact lobe, with ``lobe``, and their difference.

    The exact image is computed in float64; OpenGL draws the image with ``lobe``. The difference of
    the linear images is multiplied by ``MAGNIFIED``.
    """

    model: str
    lobe: str
    exact: NDArray[np.uint8]
    image: NDArray[np.uint8]
    difference: NDArray[np.uint8]


@dataclass(frozen=True)
class Measurement:
    """All results of a measurement except the images.

    Attributes
    ----------
    environment : date, versions, OpenGL driver and processor
    not_measured : missing results, with the reasons
    """

    environment: Mapping[str, Any]
    settings: Settings
    variants: Sequence[MeasuredVariant]
    not_measured: Sequence[str]

    @property
    def models(self) -> list[str]:
        """The names of the measured models."""
        return [model for model in MODELS if self.of_model(model)]

    def of_model(self, model: str) -> list[MeasuredVariant]:
        """Return the variants of a model."""
        return [measured for measured in self.variants if measured.variant.model == model]

    def as_dict(self) -> dict[str, Any]:
        """Return the content of measure.json."""
        return {
            "schema": SCHEMA,
            "environment": dict(self.environment),
            "settings": asdict(self.settings) | {"size": list(self.settings.size)},
            "variants": [measured.as_dict() for measured in self.variants],
            "not_measured": list(self.not_measured),
        }
