"""The measurements of ``facerender measure`` as plain data; errors against exact float64 values."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__, lobes
from facerender.comparison import pictures, windows
from facerender.comparison.windows import Float
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
from facerender.terms.lobe import LOBES

SCHEMA = "facerender.measure/2"
MODELS = PRINTED
MAGNIFIED = 8

# The content of measure.json, which docs/measurements/measure-schema.md describes, and a row of its
# table "variants". Errors of images are fractions and counts, errors of lobe and BRDF percent.
Measurement = Mapping[str, Any]
MeasuredVariant = Mapping[str, Any]

# Three images side by side, 8-bit sRGB (H, 3 W, 3), keyed by model and lobe: with the exact lobe in
# float64, with the lobe as OpenGL draws it, and the linear difference times MAGNIFIED.
Triptychs = Mapping[tuple[str, str], NDArray[np.uint8]]

Array = NDArray[np.float64]


def rows_of(measurement: Measurement, model: str) -> list[MeasuredVariant]:
    """Return the variants of a model."""
    return [row for row in measurement["variants"] if row["model"] == model]


def slope_of(measurement: Measurement) -> str:
    """Return m of the skin as text, which is the key of m in the errors of lobe and BRDF."""
    return f"{measurement['settings']['m']:g}"


def lobe_error(name: AnyLobe, m: float, k: int, degrees: Array | None = None) -> Array:
    """Return a lobe minus the exact lobe (peak 1), at angles γ between normal and half vector.

    m : roughness, in the domain of the lobe
    k : power of the cosine in the lobe's formula: 4 for Cook-Torrance, 0 for Ward
    degrees : angles in degrees, (N,); None: 0 to 90 in steps of 0.01
    """
    angles = np.linspace(0.0, 90.0, 9001) if degrees is None else degrees
    c = np.cos(np.radians(angles)).clip(0.0, 1.0)
    return lobes.lobe(name, c, m, k) - lobes.exact(c, m, k)


def brdf_error(shading: Shading, m: float) -> float:
    """Return the largest error of the BRDF times N.L, relative to the largest exact product, for m
    in the domain of the lobe. Both maxima are over all directions."""
    # 24 polar angles of light and camera, and 48 azimuths of the light: the error is smooth.
    theta = np.radians(np.linspace(0.0, 89.0, 24))
    l = _from_angles(theta[:, None, None], np.linspace(0.0, np.pi, 48))
    v = _from_angles(theta[:, None], np.pi)
    n = np.array([0.0, 0.0, 1.0])
    exact = shading.replace(lobe="exact")
    values, expected = (s.term.brdf(n, l, v, m, 0.028) * l[..., 2] for s in (shading, exact))
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
) -> tuple[Array, list[NDArray[np.float32]], list[dict[str, Any]]]:
    """Draw a scene with each shading, one sample per pixel, and compare the images with float64.
    Return the float64 reference, the OpenGL images and the errors. The reference uses
    `shadings[0]`, but with the exact lobe. The errors of `undrawn`, which OpenGL cannot draw, come
    last; their images are float64, too."""
    scene = replace(scene, background=None)
    exact = shadings[0].replace(lobe="exact")
    with Renderer(size, samples=1, backend=backend) as renderer:
        gbuffer = renderer.gbuffer(scene, exact)
        reference = shade(gbuffer, scene, exact)
        images = [renderer.render(scene, shading).linear[..., :3] for shading in shadings]
    covered = gbuffer.coverage > 0.0
    compared: list[Float] = [*images, *(shade(gbuffer, scene, x) for x in undrawn)]
    return reference, images, [image_error(image, reference, covered) for image in compared]


def image_error(image: Float, reference: Array, covered: windows.Mask) -> dict[str, Any]:
    """Compare a linear image (H, W, 3) with its reference over the covered pixels (H, W). The
    result is ``error.image`` of measure.json; "flip" is None without flip-evaluator."""
    relative = np.abs(image - reference)[covered] / np.maximum(reference[covered], 0.01)
    displayed, expected = encode_srgb8(image), encode_srgb8(reference.astype(np.float32))
    steps = np.abs(displayed.astype(int) - expected)[covered].max(axis=-1)
    flip_error = None
    with suppress(InputError):  # the package for FLIP may be missing
        flip_error = float(pictures.flip_errors(expected / 255.0, displayed / 255.0).mean())
    return {
        "point": point_error(image, reference),
        "block": block_error(image, reference, covered.astype(np.float64)),
        "largest": float(relative.max()),
        "percentile": float(np.quantile(relative.max(axis=-1), 0.999)),
        "steps": int(steps.max()),
        "steps_percentile": float(np.quantile(steps, 0.999)),
        "flip": flip_error,
    }


def point_error(a: Float, b: Float) -> float:
    """Return the largest distance of a pixel from the range of 3 x 3 pixels in the other image."""
    worst = 0.0
    for x, y in ((a, b), (b, a)):
        low, high = (windows.filtered(x, choose) for choose in (np.minimum, np.maximum))
        worst = max(worst, float(np.maximum(y - high, low - y).max()))
    return worst


def block_error(a: Float, reference: Float, coverage: Float) -> float:
    """Return the largest error of the mean of a block of 16 x 16 pixels, relative to max(mean of
    the reference, 0.01).

    a, reference : linear images, (H, W, 3)
    coverage : (H, W) in [0, 1]. Pixels count if all pixels within a distance of 3 are fully
        covered; blocks count if they contain at least 64 such pixels
    """
    inside = windows.shrunk(coverage >= windows.FULL, 3)

    def sums(values: NDArray[Any]) -> Array:
        return windows.block_sums(windows.cell_sums(values * inside))

    count, worst = sums(inside), 0.0
    for channel in range(3):
        x, y = reference[..., channel], a[..., channel]
        divisor = np.maximum(sums(np.abs(x)), windows.FLOOR * np.maximum(count, 1.0))
        change = np.abs(sums(y - x)) / divisor
        worst = max(worst, float(change[count >= windows.BLOCK**2 // 4].max(initial=0.0)))
    return worst


# Errors of lobe and BRDF are measured at these values of m and at the roughness of the skin.
SLOPES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def measure(
    mesh: Mesh,
    m: float = 0.3,
    quick: bool = False,
    backend: Backend = "auto",
    progress: Progress = no_progress,
) -> tuple[Measurement, Triptychs]:
    """Measure cost and error of all variants.

    mesh : mesh for the cost of a frame and the error of an image
    m : roughness of the skin, in [1e-4, 2]; see :meth:`facerender.Mesh.with_skin`
    quick : whether to use smaller images and fewer repeats, and skip the cost of lobes alone
    """
    size, repeats = ((256, 256), 7) if quick else ((512, 512), 21)
    plain = mesh.with_skin(m=m)
    start_maps(resolved_parts(plain))  # decoded in threads, before frames need them
    scene = Scene(plain, Camera(azimuth=-35.0, elevation=4.0))
    settings = {"mesh": mesh.name, "m": m, "size": [*size], "repeats": repeats, "quick": quick}
    measured: list[MeasuredVariant] = []
    triptychs: dict[tuple[str, str], NDArray[np.uint8]] = {}
    for model in MODELS:
        rows, images = _model(model, scene, settings, backend, progress)
        measured += rows
        triptychs |= images
    errors = filter(None, (row["error"]["image"] for row in measured))
    no_flip = any(error["flip"] is None for error in errors)
    return {
        "schema": SCHEMA,
        "environment": environment(backend),
        "settings": settings,
        "variants": measured,
        "not_measured": ["FLIP needs flip-evaluator: pip install 'facerender[measure]'"] * no_flip,
    }, triptychs


def _model(
    model: str, scene: Scene, settings: dict[str, Any], backend: Backend, progress: Progress
) -> tuple[list[MeasuredVariant], Triptychs]:
    """Measure all variants of a model."""

    def step(name: str) -> Callable[[float], object]:
        return partial(progress, f"{model}: {name}")

    m, size, repeats = settings["m"], tuple(settings["size"]), settings["repeats"]
    term_ns = cost.by_slope(terms(model), cost.OF_VECTORS, repeats, backend, step("terms"))
    lobe_ns: dict[str, Interval] = {}
    if not settings["quick"]:
        lobe_ns = cost.by_slope(lobe_terms(model), cost.OF_COSINE, repeats, backend, step("lobes"))
    inside = [variant for variant in of_model(model) if _inside(variant, m)]
    rendered = [variant for variant in inside if not (variant.printed or variant.plain)]
    undrawn = [variant for variant in inside if variant.unclamped]
    # The slope filter is off, since it may raise m above the lobe's domain. The m of other parts
    # than the skin may be outside.
    changes: Any = {"slope_filter": False, "outside": "exact"}
    shadings = [replace(variant.shading, **changes) for variant in rendered]
    others = [replace(variant.shading, **changes) for variant in undrawn]
    frames = cost.frames(scene, shadings, size, repeats, backend, step("frames"))
    frame_ms = dict(zip(rendered, frames, strict=True))
    reference, images, drawn_errors = image_errors(scene, shadings, size, backend, others)
    image_error = dict(zip([*rendered, *undrawn], drawn_errors, strict=True))
    measured: list[MeasuredVariant] = []
    for variant in of_model(model):
        if variant.plain and m < SMALL_SLOPE:
            continue
        lobe, brdf = _errors(variant, sorted({*SLOPES, m}))
        costs = {"lobe_ns": lobe_ns.get(variant.name), "term_ns": term_ns[variant.name]}
        costs["frame_ms"] = frame_ms.get(variant)
        row = {name: getattr(variant, name) for name in ("model", "name", "lobe")}
        row["cost"] = {name: interval and asdict(interval) for name, interval in costs.items()}
        row["error"] = {"lobe": lobe, "brdf": brdf, "image": image_error.get(variant)}
        measured.append(row)
    exact = reference.astype(np.float32)
    return measured, {
        (model, variant.lobe): encode_srgb8(
            np.hstack([exact, image, MAGNIFIED * np.abs(image - exact)])
        )
        for variant, image in zip(rendered, images, strict=True)
        if variant.lobe != "exact"
    }


def environment(backend: Backend = "auto") -> dict[str, Any]:
    """Return the conditions of a measurement: OpenGL driver, processor, versions, date."""
    context = create_context(backend)
    context.release()
    processor = platform.processor() or platform.machine()
    with suppress(OSError):  # only Linux has this file, and only some architectures name the model
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
        processor = next(names, platform.machine())
    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "facerender": __version__,
        "GL_RENDERER": context.renderer,
        "GL_VERSION": context.version,
        "software": context.software,
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _inside(variant: Variant, m: float) -> bool:
    """Return whether m is in the domain of the variant's lobe."""
    return bool(LOBES[variant.lobe].belongs(m, variant.k).all())


def _errors(variant: Variant, slopes: Sequence[float]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the errors of lobe and BRDF in percent, keyed by m; None outside the domain."""
    lobe: dict[str, float | None] = {}
    brdf: dict[str, float | None] = {}
    for m in slopes:
        inside = _inside(variant, m) and not (variant.plain and m < SMALL_SLOPE)
        lobe[f"{m:g}"], brdf[f"{m:g}"] = _errors_of(variant.shading, m) if inside else (None, None)
    return lobe, brdf


@cache  # variants with and without small slopes have one shading
def _errors_of(shading: Shading, m: float) -> tuple[float, float]:
    lobe = np.abs(lobe_error(shading.term.lobe, m, shading.term.entry.k)).max()
    return 100.0 * float(lobe), 100.0 * brdf_error(shading, m)
