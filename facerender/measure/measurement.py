"""What ``facerender measure`` measured, as records, and their JSON, which docs/measure.schema.md
describes. Nothing is measured here, and nothing needs OpenGL."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.pricing.interval import Interval
from facerender.pricing.variants import PRINTED, Variant
from facerender.scenes.scene import ShadingRate

SCHEMA = "facerender.measure/1"
MODELS = PRINTED
MAGNIFIED = 8

BySlope = Mapping[str, float | None]  # the slope as text, "%g" % m
Curves = Mapping[str, Mapping[str, Sequence[float]]]


@dataclass(frozen=True)
class Environment:
    """Where figures come from: date and versions, OpenGL driver, processor; ``software`` where the
    CPU draws, ``cores`` that the process may use."""

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
    """What was asked for: m of the whole mesh, the size of frame and image in pixels, the repeats
    of every measurement of time, and whether less was measured to save time."""

    mesh: str
    m: float
    size: tuple[int, int]
    repeats: int
    quick: bool

    @property
    def slope(self) -> str:
        """The key of m among the errors of lobe and BRDF."""
        return f"{self.m:g}"


@dataclass(frozen=True)
class ImageError:
    """How far an image is from float64 exact shading of the same G-buffer.

    Attributes
    ----------
    point, block : of the linear image; see ``facerender.compare``
    largest, percentile : relative to max(reference, 0.01), the second exceeded by 1 pixel in 1000
    steps, steps_percentile : the same of the displayed image, in steps of 1/255
    flip : mean of FLIP (Andersson et al. 2020) over the image, or None without flip-evaluator
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
    """The cost of a variant: the lobe alone and the whole term in nanoseconds an evaluation, a
    frame in milliseconds; None where it was not measured."""

    lobe_ns: Interval | None
    term_ns: Interval
    frame_ms: Interval | None


@dataclass(frozen=True)
class Errors:
    """What a variant loses: of lobe and BRDF the largest error in percent by slope, None outside
    the domain; of the image at the slope of the settings, None where none was drawn."""

    lobe: BySlope
    brdf: BySlope
    image: ImageError | None


@dataclass(frozen=True)
class MeasuredVariant:
    """A variant with its cost and its error."""

    variant: Variant
    cost: Costs
    error: Errors


@dataclass(frozen=True)
class DisplayError:
    """Errors of the displayed image, as fractions of its range, of the worst channel.

    Attributes
    ----------
    mean, percentile : of the pixels; the percentile is exceeded by one in 100
    over : fraction of the pixels that err by more than 1/255
    """

    mean: float
    percentile: float
    over: float


@dataclass(frozen=True)
class SampleSetting:
    """Cost and error of a number of samples.

    Attributes
    ----------
    samples : per pixel
    time : of a frame with readback, over that of a frame with one sample
    silhouette : of the pixels that the mesh covers in part with 64 samples
    inside : of those that it covers
    shading_rate : see :meth:`facerender.Renderer.render`
    """

    samples: int
    time: Interval
    silhouette: DisplayError
    inside: DisplayError
    shading_rate: ShadingRate = "sample"


@dataclass(frozen=True)
class PartSetting:
    """Cost and error of a setting of a part of skin.

    Attributes
    ----------
    part, setting : names, such as "samples of scattering" and "16"
    time : of a frame with readback, over that of the part's first setting
    error : against its last setting, at pixels that the mesh covers
    """

    part: str
    setting: str
    time: Interval
    error: DisplayError


@dataclass(frozen=True, eq=False)
class Triptych:
    """What is drawn with the exact lobe in float64, what OpenGL draws with this one, and their
    difference ``MAGNIFIED``: 8-bit sRGB (H, W, 3)."""

    model: str
    lobe: str
    exact: NDArray[np.uint8]
    image: NDArray[np.uint8]
    difference: NDArray[np.uint8]


@dataclass(frozen=True)
class Measurement:
    """All of it but the images.

    Attributes
    ----------
    samples : what numbers of samples a pixel cost and lose
    degrees : angles γ of the half vector
    curves : by model, lobe and slope, the lobe less the exact one in percent of the peak, one for
        each angle; a slope outside the domain is left out
    not_measured : what is missing, and why
    skin : what parts of skin cost and lose
    """

    environment: Environment
    settings: Settings
    variants: Sequence[MeasuredVariant]
    samples: Sequence[SampleSetting]
    degrees: Sequence[float]
    curves: Mapping[str, Curves]
    not_measured: Sequence[str]
    skin: Sequence[PartSetting] = ()

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
            **({"samples": [asdict(each) for each in self.samples]} if self.samples else {}),
            **({"skin": [asdict(each) for each in self.skin]} if self.skin else {}),
            "curves": {"degrees": list(self.degrees), **self.curves},
            "not_measured": list(self.not_measured),
        }
