"""Measure the cost of whole frames, the errors of fewer samples, and the savings of plans.

    python -m benchmarks.frame

Writes docs/measurements/frame.json in half an hour. Needs an OpenGL context and the extra lod; two
scenes also need the head scan.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from itertools import product
from typing import Any

import numpy as np

import facerender as fr
from benchmarks.data import meshes, ratio, save, scenes
from facerender.images.image import linear_to_srgb
from facerender.planning.search import Decision
from facerender.scene.job import MAX_SAMPLES
from facerender.scene.scene import SHADING_RATES, ShadingRate
from tests.verification.lights import PLAIN_THREE
from tests.verification.subjects import Subject

SIZES = (512, 1024)
PLANS = {  # number of cameras, image size, budget, fraction of pixels that must meet the budget
    "one-camera": (1, 512, "1/255", "99.9%"),
    "eight-cameras": (8, 128, "1/255", "99.9%"),
    "wide-budget": (1, 256, "8/255", "95%"),
}


class _Forward(fr.Renderer):
    """A renderer that shades all fragments, not only the visible ones."""

    def _defers(self, *arguments: object) -> bool:
        return False


def main() -> None:
    with fr.Renderer() as renderer:
        most = renderer.context.most_samples
    head = fr.Scene(fr.load_mesh(), fr.Camera(-35.0), PLAIN_THREE)
    save(
        "frame",
        most_samples=most,
        samples={str(size): sampled(head, size) for size in SIZES},
        deferred=deferred(),
        sizes={str(size): deferred_against_drawn(head, 4, size) for size in (256, 512, 1024, 2048)},
        plans={name: plans(*settings) for name, settings in PLANS.items()},
    )


def sampled(scene: fr.Scene, size: int) -> list[dict[str, Any]]:
    """Return time and error by the number of samples per pixel; errors in levels."""
    with fr.Renderer((size, size)) as renderer:

        def draw(samples: int, rate: ShadingRate = "sample") -> np.ndarray:
            return renderer.render(scene, samples=samples, shading_rate=rate).linear

        reference = draw(MAX_SAMPLES)
        coverage, rows = reference[..., 3], []
        areas = {"silhouette": (coverage > 0.0) & (coverage < 1.0), "inside": coverage == 1.0}
        for samples, rate in product((1, 4, 8, 16), SHADING_RATES):
            if rate == "pixel" and not renderer.can_shade_per_pixel(scene, samples):
                continue
            row: dict[str, Any] = {
                "samples": f"{samples}{', per-pixel shading' * (rate == 'pixel')}"
            }
            row["frame"] = ratio(partial(draw, samples, rate), partial(draw, 1), 9).value
            images = (linear_to_srgb(x[..., :3]) for x in (draw(samples, rate), reference))
            errors = 255.0 * np.abs(np.subtract(*images)).max(axis=-1)
            for name, area in areas.items():
                row |= {name: float(errors[area].mean())}
                row |= {f"{name}_99": float(np.quantile(errors[area], 0.99))}
            rows.append(row | {"over_percent": 100.0 * float((errors[areas["inside"]] > 1).mean())})
    return rows


def deferred() -> list[dict[str, Any]]:
    """Return the relative time and the error of deferred shading, with 1 and 4 samples."""
    names = {"head": "built-in head", "scan": "scan"}
    rows = []
    for name, mesh in meshes():
        scene = fr.Scene(mesh, fr.Camera(-35.0, frame="all"), PLAIN_THREE)
        times = {at: deferred_against_drawn(scene, n) for at, n in (("one", 1), ("four", 4))}
        triangles = sum(len(part.faces) for part in mesh.parts)
        rows.append({"scene": names[name], "triangles": triangles, **times})
    return rows


def plans(count: int, size: int, budget: str, share: str) -> dict[str, Any]:
    """Return the plans of all scenes, and the medians of their relative times."""
    with fr.Renderer((size, size)) as renderer:
        rows = [plan_of(renderer, each, count, budget, share) for each in scenes()]
    return {"plans": rows, "median": medians(rows)}


def medians(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the medians of the plans' relative times."""
    names = ("measured", "of_drawn")
    return {name: float(np.median([row[name] for row in rows])) for name in names}


def plan_of(
    renderer: fr.Renderer, subject: Subject, count: int, budget: str, share: str
) -> dict[str, Any]:
    """Return a plan's choices, its frame time relative to both full frames, and its errors.

    ``measured`` is relative to the full frame as the renderer chooses to shade it, ``of_drawn`` to
    the full frame with forward shading.
    """
    cameras = fr.turntable(subject.scene.camera, count)
    found = fr.plan(
        subject.scene,
        budget,
        full=subject.full,
        cameras=cameras,
        within=share,
        renderer=renderer,
    )
    assert found.detail is not None
    assert found.error.drawn is not None
    assert found.error.drawn_within is not None
    scene, values = found.detail.of(subject.scene), found.detail.values
    forward = _Forward(renderer.size, samples=renderer.samples)

    def planned() -> object:
        return renderer.render(scene, found.shading, **values)

    def drawn() -> object:
        return forward.render(subject.scene, found.full)

    text = found.budget.text
    chosen = ", ".join(word for each in found.decisions for word in _chosen(each))
    return {
        "scene": subject.name,
        "chosen": chosen or "the full frame",
        "measured": found.cost.relative,
        "of_drawn": ratio(planned, drawn, 7).value,
        "error": text(found.error.drawn_within),
        "worst": text(found.error.drawn),
        "over_budget": found.error.drawn_within > found.budget.limit,
    }


def _chosen(decision: Decision) -> Iterator[str]:
    """Yield the plan's choice if it differs from the full frame."""
    if decision.changed and decision.name == "cull_back_faces":
        yield "back faces culled"
    elif decision.changed:
        words = ("samples", "shading_rate", "triangles", "ambient", "normal map")
        named = decision.name in words
        yield f"{decision.name} {decision.chosen}" if named else decision.chosen


def deferred_against_drawn(scene: fr.Scene, samples: int, size: int = 1024) -> dict[str, float]:
    """Return the time of deferred shading relative to forward shading, and the fraction of covered
    pixels that differ by more than one level."""
    with _Forward(size, samples=samples) as forward, fr.Renderer(size, samples=samples) as renderer:

        def deferred() -> np.ndarray:
            return renderer.render(scene).linear

        def drawn() -> np.ndarray:
            return forward.render(scene).linear

        time = ratio(deferred, drawn, 9)
        one, other = deferred(), drawn()
    error = np.abs(linear_to_srgb(one[..., :3]) - linear_to_srgb(other[..., :3])).max(axis=-1)
    return {**asdict(time), "over": float((error[other[..., 3] > 0.0] > 1 / 255).mean())}


if __name__ == "__main__":
    main()
