"""Records of ``facerender measure`` and their JSON (docs/measurements/measure-schema.md)."""

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
class Environment:
    """The conditions of a measurement: date, versions, OpenGL driver, processor.

    ``software`` is true if the CPU draws. ``cores`` counts the cores that the process may use.
    """

    date: str
    facerender: str
    GL_RENDERER: str
    GL_VERSION: str
    software: bool
    processor: str
    cores: int
    python: str
    numpy: str


@dataclass(frozen=True)
class Settings:
    """The settings of a measurement.

    Attributes
    ----------
    mesh : name of the mesh
    m : roughness of the skin
    size : width and height of the images in pixels
    repeats : number of repeats of each timing
    quick : whether the measurement was reduced to save time
    """

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
    """Errors of an image against exact float64 shading of the same G-buffer.

    Attributes
    ----------
    point : largest distance in radiance from a pixel of the image or the reference to the range of
        3 x 3 pixels in the other image, see ``error.point_error``
    block : largest error of the mean over 16 x 16 pixels, relative to max(reference mean, 0.01)
    largest : largest error of linear radiance, relative to max(reference, 0.01)
    percentile : 99.9th percentile, over the covered pixels, of the error in ``largest``
    steps : largest error of the displayed image, in 8-bit levels
    steps_percentile : 99.9th percentile of the displayed image's error, in 8-bit levels
    flip : mean FLIP error of the image (Andersson et al. 2020); None without flip-evaluator
    """

    point: float
    block: float
    largest: float
    percentile: float
    steps: int
    steps_percentile: float
    flip: float | None


@dataclass(frozen=True)
class Costs:
    """The costs of a variant; None if not measured.

    Attributes
    ----------
    lobe_ns : time per evaluation of the lobe alone, in ns
    term_ns : time per evaluation of the whole term, in ns
    frame_ms : time per frame, in ms
    """

    lobe_ns: Interval | None
    term_ns: Interval
    frame_ms: Interval | None


@dataclass(frozen=True)
class Errors:
    """The errors of a variant.

    Attributes
    ----------
    lobe : largest error of the lobe in percent, keyed by m; None if m is outside the domain
    brdf : largest error of the BRDF in percent, keyed by m; None if m is outside the domain
    image : error of the image at the m of the settings; None if no image was drawn
    """

    lobe: BySlope
    brdf: BySlope
    image: ImageError | None


@dataclass(frozen=True)
class MeasuredVariant:
    """A variant with its cost and its error."""

    variant: Variant
    cost: Costs
    error: Errors


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
    not_measured : missing results, with the reasons
    """

    environment: Environment
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
            "environment": asdict(self.environment),
            "settings": asdict(self.settings) | {"size": list(self.settings.size)},
            "variants": [
                {
                    "model": measured.variant.model,
                    "name": measured.variant.name,
                    "lobe": measured.variant.lobe,
                    "cost": asdict(measured.cost),
                    "error": asdict(measured.error),
                }
                for measured in self.variants
            ],
            "not_measured": list(self.not_measured),
        }
