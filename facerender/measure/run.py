"""What ``facerender measure`` measures, as one dictionary; ``report.py`` writes it, and
docs/measure.schema.md describes it."""

from __future__ import annotations

import importlib.util
import os
import platform
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import lobes
from facerender._version import __version__
from facerender.drawing.context import Backend, create_context
from facerender.drawing.prepare import start_maps
from facerender.errors import NotMeasured
from facerender.image import encode_srgb8
from facerender.measure import error
from facerender.pricing import amd, cost
from facerender.pricing.variants import CALLS, lobe_terms, terms
from facerender.scenes.camera import Camera
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.shading import SMALL_SLOPE, Shading
from facerender.terms import MODELS as MODELS_

SCHEMA = "facerender.measure/1"
MODELS = tuple(CALLS)
SLOPES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
DEGREES = np.linspace(0.0, 90.0, 91)
MAGNIFIED = 8

Images = dict[str, NDArray[np.uint8]]


def measure(
    mesh: Mesh,
    m: float = 0.3,
    quick: bool = False,
    backend: Backend = "auto",
    progress: Callable[[str, float], object] = lambda what, done: None,
) -> tuple[dict[str, Any], Images]:
    """Measure what every form and lobe of both models costs and loses, on this machine.

    Parameters
    ----------
    mesh : rendered for the cost of a frame and the error of an image
    m : rms slope of the whole mesh
    quick : smaller images, fewer repeats, no lobes alone
    progress : called with what is measured and the share of it that is done

    Returns
    -------
    the data, as docs/measure.schema.md describes it, and images by caption, (H, W, 3) sRGB

    Raises
    ------
    ContextError : no OpenGL context
    InputError : m outside [1e-4, 2], or a damaged map
    """
    size = (256, 256) if quick else (512, 512)
    repeats = 7 if quick else 21
    plain = mesh.with_material(m=m, roughness_map=None)
    start_maps(plain)
    scene = Scene(plain, Camera(azimuth=-35.0, elevation=4.0))
    slopes = tuple(sorted({*SLOPES, m}))
    not_measured: list[str] = []

    statistics: dict[str, dict[str, dict[str, amd.Statistics]]] = {}
    for number, family in enumerate(amd.FAMILIES):
        progress("compiler statistics", number / len(amd.FAMILIES))
        try:
            statistics[family] = {model: amd.statistics(terms(model), family) for model in MODELS}
        except NotMeasured as why:
            not_measured.append(f"{family}: {why}")

    variants: list[dict[str, Any]] = []
    images: Images = {}
    for model in MODELS:

        def stage(what: str, model: str = model) -> Callable[[float], object]:
            return lambda done: progress(f"{model}: {what}", done)

        costs: dict[str, dict[str, cost.Interval]] = {"lobe_ns": {}}
        costs["term_ns"] = cost.by_slope(
            terms(model), cost.OF_VECTORS, repeats, backend, stage("terms")
        )
        if not quick:
            costs["lobe_ns"] = cost.by_slope(
                lobe_terms(model), cost.OF_COSINE, repeats, backend, stage("lobes")
            )
        k = MODELS_[model].k
        drawn = [name for name in lobes.NAMES if lobes.in_domain(m, name, k)]
        shadings = [Shading(model, name) for name in drawn]
        milliseconds = cost.frames(scene, shadings, size, repeats, backend, stage("frames"))
        costs["frame_ms"] = dict(zip(drawn, milliseconds, strict=True))
        comparison = error.image_errors(scene, shadings, size, backend)
        image_errors: dict[str, error.ImageError] = dict(zip(drawn, comparison.errors, strict=True))
        images |= _triptychs(model, comparison, drawn)
        for name in terms(model):
            if m < SMALL_SLOPE and name == f"exact, m >= {SMALL_SLOPE:g}":
                continue
            lobe = lobe_of(name)
            entry: dict[str, Any] = {"model": model, "name": name, "lobe": lobe}
            entry["cost"] = {kind: _row(rows.get(name)) for kind, rows in costs.items()} | {
                family: _row(statistics[family][model][name] if family in statistics else None)
                for family in amd.FAMILIES
            }
            entry["error"] = _errors(model, name, slopes) | {"image": _row(image_errors.get(name))}
            variants.append(entry)
    if importlib.util.find_spec("flip_evaluator") is None:
        not_measured.append("FLIP needs flip-evaluator: pip install 'facerender[measure]'")
    data = {
        "schema": SCHEMA,
        "environment": environment(backend) | {"amd_driver": amd.driver() if statistics else None},
        "settings": {"mesh": mesh.name, "m": m, "size": size, "repeats": repeats, "quick": quick},
        "variants": variants,
        "curves": {"degrees": DEGREES.tolist()}
        | {model: _curves(model, slopes) for model in MODELS},
        "not_measured": not_measured,
    }
    return data, images


def environment(backend: Backend = "auto") -> dict[str, Any]:
    """Say where figures come from: OpenGL driver, processor, versions, date."""
    context = create_context(backend)
    renderer, version = context.renderer, context.version
    context.release()
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "facerender": __version__,
        "GL_RENDERER": renderer,
        "GL_VERSION": version,
        "software": cost.is_software(renderer),
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


def lobe_of(variant: str) -> str:
    """Return the lobe of a variant's name, such as "printed, d16" or "exact, m >= 0.2"."""
    return next(name for name in reversed(lobes.NAMES) if name in variant.split(", "))


def _row(measured: Any) -> dict[str, Any] | None:
    return None if measured is None else asdict(measured)


def _errors(model: str, name: str, slopes: tuple[float, ...]) -> dict[str, dict[str, float | None]]:
    """Errors of a variant's lobe and BRDF by slope, in percent; None outside its domain."""
    lobe = lobe_of(name)
    if name.startswith("printed") and lobe != "exact":
        unclamped: dict[str, float | None] = {
            f"{m:g}": 100.0 * float(np.abs(error.printed_error(m, MODELS_[model].k, 16)).max())
            for m in slopes
        }
        return {"lobe": unclamped, "brdf": dict.fromkeys(unclamped, None)}
    least = SMALL_SLOPE if name.endswith(f">= {SMALL_SLOPE:g}") else 0.0
    by_slope = {f"{m:g}": _of_lobe(model, lobe, m) if m >= least else (None, None) for m in slopes}
    return {
        "lobe": {m: pair[0] for m, pair in by_slope.items()},
        "brdf": {m: pair[1] for m, pair in by_slope.items()},
    }


@cache
def _of_lobe(model: str, lobe: str, m: float) -> tuple[float, float] | tuple[None, None]:
    shading = Shading(model, lobe)
    if not lobes.in_domain(m, lobe, shading.term.entry.k):
        return None, None
    of_lobe = float(np.abs(error.lobe_error(lobe, m, shading.term.entry.k)).max())
    return 100.0 * of_lobe, 100.0 * error.brdf_error(shading, m)


def _curves(model: str, slopes: tuple[float, ...]) -> dict[str, dict[str, list[float]]]:
    k = MODELS_[model].k
    return {
        name: {
            f"{m:g}": np.round(100.0 * error.lobe_error(name, m, k, DEGREES), 5).tolist()
            for m in slopes
            if lobes.in_domain(m, name, k)
        }
        for name in lobes.NAMES
        if name != "exact"
    }


def _triptychs(model: str, comparison: error.Comparison, drawn: list[str]) -> Images:
    reference = comparison.reference.astype(np.float32)
    images = {f"{model} exact": encode_srgb8(reference)}
    for lobe, image in zip(drawn, comparison.images, strict=True):
        if lobe != "exact":
            images[f"{model} {lobe}"] = encode_srgb8(image)
            difference = MAGNIFIED * np.abs(image - reference)
            images[f"{model} {lobe} difference x{MAGNIFIED}"] = encode_srgb8(difference)
    return images
