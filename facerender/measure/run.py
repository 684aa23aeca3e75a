"""Runs the measurements of ``facerender measure``.

``measurement.py`` defines the records, ``report.py`` writes the files.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from facerender import __version__
from facerender.drawing.context import Backend, create_context
from facerender.drawing.prepare import start_maps
from facerender.images.srgb import encode_srgb8
from facerender.measure import error
from facerender.measure.measurement import (
    MAGNIFIED,
    MODELS,
    BySlope,
    MeasuredVariant,
    Measurement,
    Settings,
    Triptych,
)
from facerender.pricing import cost
from facerender.pricing.interval import Interval
from facerender.pricing.variants import Variant, lobe_terms, of_model, terms
from facerender.scenes.camera import Camera
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.shading import SMALL_SLOPE, Shading
from facerender.system.progress import Progress, no_progress
from facerender.terms import LOBES

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
    start_maps(plain)
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
    reference, images, image_errors = error.image_errors(scene, shadings, size, backend, others)
    image_error = dict(zip([*rendered, *undrawn], image_errors, strict=True))
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
            encode_srgb8(exact),
            encode_srgb8(image),
            encode_srgb8(MAGNIFIED * np.abs(image - exact)),
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
    errors = [
        (None, None)
        if (variant.plain and m < SMALL_SLOPE) or not _inside(variant, m)
        else _errors_of(variant.shading, m)
        for m in slopes
    ]
    names = [f"{m:g}" for m in slopes]
    lobe, brdf = (dict(zip(names, column, strict=True)) for column in zip(*errors, strict=True))
    return lobe, brdf


@cache
def _errors_of(shading: Shading, m: float) -> tuple[float, float]:
    lobe = np.abs(error.lobe_error(shading.term.lobe, m, shading.term.entry.k)).max()
    return 100.0 * float(lobe), 100.0 * error.brdf_error(shading, m)
