"""The measurements of ``facerender measure``: their records, JSON
(docs/measurements/measure-schema.md) and errors against exact float64 values. ``report.py`` writes
the files."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__, lobes
from facerender.comparison import pictures
from facerender.comparison.windows import (
    BLOCK,
    FLOOR,
    FULL,
    block_sums,
    cell_sums,
    filtered,
    shrunk,
)
from facerender.drawing.context import Backend, create_context
from facerender.drawing.prepare import resolved_parts, start_maps
from facerender.drawing.reference import shade
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.image import encode_srgb8
from facerender.lobes import AnyLobe
from facerender.mesh.mesh import Mesh
from facerender.pricing import cost
from facerender.pricing.cost import PRINTED, Interval, Variant, lobe_terms, of_model, terms
from facerender.scene.camera import Camera
from facerender.scene.scene import Scene
from facerender.scene.shading import SMALL_SLOPE, Shading
from facerender.system.process import Progress, no_progress
from facerender.terms import LOBES

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
    """A variant with its costs, which are None if not measured, and its errors. The largest errors
    of lobe and BRDF are in percent, keyed by m, and None if m is outside the domain."""

    variant: Variant
    lobe_ns: Interval | None  # of the lobe alone
    term_ns: Interval  # of the whole term
    frame_ms: Interval | None
    lobe_error: BySlope
    brdf_error: BySlope
    image_error: ImageError | None  # at the m of the settings; None if no image was drawn

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
    """Three images side by side, 8-bit sRGB (H, 3 W, 3): with the exact lobe in float64, with
    ``lobe`` as OpenGL draws it, and the difference of the linear images times ``MAGNIFIED``."""

    model: str
    lobe: str
    pixels: NDArray[np.uint8]


@dataclass(frozen=True)
class Measurement:
    """All results of a measurement except the images."""

    environment: Mapping[str, Any]  # date, versions, OpenGL driver and processor
    settings: Settings
    variants: Sequence[MeasuredVariant]
    not_measured: Sequence[str]  # missing results, with the reasons

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


Array = NDArray[np.float64]


def lobe_error(name: AnyLobe, m: float, k: int, degrees: Array | None = None) -> Array:
    """Return a lobe minus the exact lobe (peak 1), at angles γ between normal and half vector.

    Parameters
    ----------
    m : roughness, in the domain of the lobe
    k : power of the cosine in the lobe's formula: 4 for Cook-Torrance, 0 for Ward
    degrees : angles in degrees, (N,); None: 0 to 90 in steps of 0.01

    Raises
    ------
    InputError : m is outside the domain of the lobe
    """
    angles = np.linspace(0.0, 90.0, 9001) if degrees is None else degrees
    c = np.cos(np.radians(angles)).clip(0.0, 1.0)
    return lobes.lobe(name, c, m, k) - lobes.exact(c, m, k)


def brdf_error(shading: Shading, m: float, f0: float = 0.028, count: int = 24) -> float:
    """Return the largest error of the BRDF times N.L, relative to the largest exact product.

    Both maxima are over all directions. Light and camera each take `count` polar angles from 0 to
    89 degrees; the light also takes 2 `count` azimuths from 0 to 180 degrees.

    Raises
    ------
    InputError : m is outside the domain of the lobe
    """
    theta = np.radians(np.linspace(0.0, 89.0, count))
    phi = np.linspace(0.0, np.pi, 2 * count)
    l = _from_angles(theta[:, None, None], phi)
    v = _from_angles(theta[:, None], np.pi)
    n = np.array([0.0, 0.0, 1.0])
    exact = shading.replace(lobe="exact")
    values, expected = (s.term.brdf(n, l, v, m, f0) * l[..., 2] for s in (shading, exact))
    return float(np.abs(values - expected).max() / expected.max())


def _from_angles(theta: Array, phi: Array | float) -> Array:
    sine = np.sin(theta)
    x, y, z = np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), np.cos(theta))
    return np.stack([x, y, z], axis=-1)


def image_errors(
    scene: Scene,
    shadings: Sequence[Shading],
    size: tuple[int, int],
    backend: Backend = "auto",
    undrawn: Sequence[Shading] = (),
) -> tuple[Array, list[NDArray[np.float32]], list[ImageError]]:
    """Draw a scene with each shading, one sample per pixel, and compare the images with float64.

    Return the float64 reference, the OpenGL images and the errors. The reference uses
    `shadings[0]`, but with the exact lobe. The errors of `undrawn`, which OpenGL cannot draw, come
    last; their images are float64, too.

    Raises
    ------
    ContextError : no OpenGL context
    InputError : the scene cannot be drawn with one of the shadings
    """
    scene = replace(scene, background=None)
    exact = shadings[0].replace(lobe="exact")
    with Renderer(size, samples=1, backend=backend) as renderer:
        gbuffer = renderer.gbuffer(scene, exact)
        reference = shade(gbuffer, scene, exact)
        images = [renderer.render(scene, shading).linear[..., :3] for shading in shadings]
    covered = gbuffer.coverage > 0.0
    compared: list[NDArray[np.floating]] = [*images]
    compared += [shade(gbuffer, scene, shading) for shading in undrawn]
    errors = [image_error(image, reference, covered) for image in compared]
    return reference, images, errors


def image_error(
    image: NDArray[np.floating], reference: Array, covered: NDArray[np.bool_]
) -> ImageError:
    """Compare a linear image (H, W, 3) with its reference over the covered pixels (H, W)."""
    relative = np.abs(image - reference)[covered] / np.maximum(reference[covered], 0.01)
    displayed, expected = encode_srgb8(image), encode_srgb8(reference.astype(np.float32))
    steps = np.abs(displayed.astype(int) - expected)[covered].max(axis=-1)
    flip_error = None
    with suppress(InputError):  # the package for FLIP may be missing
        flip_error = float(pictures.flip_errors(expected / 255.0, displayed / 255.0).mean())
    return ImageError(
        point=point_error(image, reference),
        block=block_error(image, reference, covered.astype(np.float64)),
        largest=float(relative.max()),
        percentile=float(np.quantile(relative.max(axis=-1), 0.999)),
        steps=int(steps.max()),
        steps_percentile=float(np.quantile(steps, 0.999)),
        flip=flip_error,
    )


def point_error(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Return the largest distance from a pixel of one image (H, W, 3) to the range of 3 x 3 pixels
    in the other image."""
    worst = 0.0
    for x, y in ((a, b), (b, a)):
        beyond = np.maximum(y - filtered(x, np.maximum), filtered(x, np.minimum) - y)
        worst = max(worst, float(beyond.max()))
    return worst


def block_error(
    a: NDArray[np.floating], reference: NDArray[np.floating], coverage: NDArray[np.floating]
) -> float:
    """Return the largest error of the mean of a block of 16 x 16 pixels, relative to max(mean of
    the reference, 0.01).

    Parameters
    ----------
    a, reference : linear images, (H, W, 3)
    coverage : (H, W) in [0, 1]. Pixels count if all pixels within a distance of 3 are fully
        covered; blocks count if they contain at least 64 such pixels
    """
    inside = shrunk(coverage >= FULL, 3)
    count = block_sums(cell_sums(inside))
    worst = 0.0
    for channel in range(3):
        x, y = reference[..., channel], a[..., channel]
        divisor = np.maximum(
            block_sums(cell_sums(np.abs(x) * inside)), FLOOR * np.maximum(count, 1.0)
        )
        change = np.abs(block_sums(cell_sums((y - x) * inside))) / divisor
        worst = max(worst, float(change[count >= BLOCK**2 // 4].max(initial=0.0)))
    return worst


# Errors of lobe and BRDF are measured at these values of m and at the roughness of the skin.
SLOPES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def measure(
    mesh: Mesh,
    m: float = 0.3,
    quick: bool = False,
    backend: Backend = "auto",
    progress: Progress = no_progress,
) -> tuple[Measurement, list[Triptych]]:
    """Measure cost and error of all variants.

    Parameters
    ----------
    mesh : mesh for the cost of a frame and the error of an image
    m : roughness of the skin, in [1e-4, 2]; see :meth:`facerender.Mesh.with_skin`
    quick : whether to use smaller images and fewer repeats, and skip the cost of lobes alone

    Raises
    ------
    ContextError : there is no OpenGL context
    InputError : m is outside its range, or a map is damaged
    """
    size, repeats = ((256, 256), 7) if quick else ((512, 512), 21)
    plain = mesh.with_skin(m=m)
    start_maps(resolved_parts(plain))
    scene = Scene(plain, Camera(azimuth=-35.0, elevation=4.0))
    settings = Settings(mesh.name, m, size, repeats, quick)
    measured: list[MeasuredVariant] = []
    triptychs: list[Triptych] = []
    for model in MODELS:
        rows, images = _model(model, scene, settings, backend, progress)
        measured += rows
        triptychs += images
    not_measured = []
    if any(row.image_error and row.image_error.flip is None for row in measured):
        not_measured.append("FLIP needs flip-evaluator: pip install 'facerender[measure]'")
    return Measurement(environment(backend), settings, measured, not_measured), triptychs


def _model(
    model: str, scene: Scene, settings: Settings, backend: Backend, progress: Progress
) -> tuple[list[MeasuredVariant], list[Triptych]]:
    """Measure all variants of a model."""

    def step(name: str) -> Callable[[float], object]:
        return partial(progress, f"{model}: {name}")

    m, size, repeats = settings.m, settings.size, settings.repeats
    term_ns = cost.by_slope(terms(model), cost.OF_VECTORS, repeats, backend, step("terms"))
    lobe_ns: dict[str, Interval] = {}
    if not settings.quick:
        lobe_ns = cost.by_slope(lobe_terms(model), cost.OF_COSINE, repeats, backend, step("lobes"))
    inside = [variant for variant in of_model(model) if _inside(variant, m)]
    rendered = [variant for variant in inside if variant.standard]
    undrawn = [variant for variant in inside if variant.unclamped]
    # The slope filter is off, since it may raise m above the lobe's domain. The m of other parts
    # than the skin may be outside.
    shadings, others = (
        [replace(variant.shading, slope_filter=False, outside="exact") for variant in variants]
        for variants in (rendered, undrawn)
    )
    frames = cost.frames(scene, shadings, size, repeats, backend, step("frames"))
    frame_ms = dict(zip(rendered, frames, strict=True))
    reference, images, drawn_errors = image_errors(scene, shadings, size, backend, others)
    image_error = dict(zip([*rendered, *undrawn], drawn_errors, strict=True))
    measured = [
        MeasuredVariant(
            variant,
            lobe_ns.get(variant.name),
            term_ns[variant.name],
            frame_ms.get(variant),
            *_errors(variant, sorted({*SLOPES, m})),
            image_error.get(variant),
        )
        for variant in of_model(model)
        if not variant.plain or m >= SMALL_SLOPE
    ]
    exact = reference.astype(np.float32)
    triptychs = [
        Triptych(
            model,
            variant.lobe,
            encode_srgb8(np.hstack([exact, image, MAGNIFIED * np.abs(image - exact)])),
        )
        for variant, image in zip(rendered, images, strict=True)
        if variant.lobe != "exact"
    ]
    return measured, triptychs


def environment(backend: Backend = "auto") -> dict[str, Any]:
    """Return the conditions of a measurement: OpenGL driver, processor, versions, date."""
    context = create_context(backend)
    context.release()
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "facerender": __version__,
        "GL_RENDERER": context.renderer,
        "GL_VERSION": context.version,
        "software": context.software,
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _inside(variant: Variant, m: float) -> bool:
    """Return whether m is in the domain of the variant's lobe."""
    return bool(LOBES[variant.lobe].belongs(m, variant.k).all())


def _errors(variant: Variant, slopes: Sequence[float]) -> tuple[BySlope, BySlope]:
    """Return the largest errors of lobe and BRDF in percent; None if m is outside the domain."""
    errors = {
        f"{m:g}": (None, None)
        if (variant.plain and m < SMALL_SLOPE) or not _inside(variant, m)
        else _errors_of(variant.shading, m)
        for m in slopes
    }
    lobe, brdf = ({m: pair[i] for m, pair in errors.items()} for i in (0, 1))
    return lobe, brdf


@cache
def _errors_of(shading: Shading, m: float) -> tuple[float, float]:
    lobe = np.abs(lobe_error(shading.term.lobe, m, shading.term.entry.k)).max()
    return 100.0 * float(lobe), 100.0 * brdf_error(shading, m)
