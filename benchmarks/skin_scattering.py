"""Measure the errors and the cost of screen-space subsurface scattering.

    python -m benchmarks.skin_scattering

Writes docs/measurements/skin_scattering.json in ten minutes. Needs an OpenGL context, embreex and
the head scan.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import facerender as fr
from benchmarks.data import meshes, ratio, save
from tests.verification.scattering import SUBJECTS, scatter_errors

SAMPLES = (8, 16, 32, 64)
COUNT = 20_000  # randomly chosen pixels
LIGHTS = (fr.Light(-50.0, 42.0, 3.0), fr.Light(80.0, 20.0, 0.5, shadow=False))


def main() -> None:
    errors = {name: errors_of(name, mesh) for name, mesh in meshes()}
    save("skin_scattering", errors=errors, costs=costs())


def errors_of(name: str, mesh: fr.Mesh) -> list[dict[str, Any]]:
    """Return the errors of a mesh by the number of subsurface samples."""
    scene, light = SUBJECTS["head" if name == "head" else "scan_mesh"](mesh)
    with fr.Renderer((512, 512), samples=1) as renderer:
        _, errors = scatter_errors(renderer, scene, light, (0, *SAMPLES), COUNT)
    return [{"samples": each.samples, "mean": each.mean, "p99": each.p99} for each in errors]


def costs() -> list[dict[str, Any]]:
    """Return frame times relative to frames without scattering, with 1 and 4 samples per pixel."""
    mesh = fr.load_mesh().with_material(scattering="skin")
    scene = fr.Scene(mesh, fr.Camera(-35.0, frame="all"), LIGHTS)
    rows: list[dict[str, Any]] = [{"samples": count, "time": []} for count in SAMPLES]
    for samples in (1, 4):
        with fr.Renderer((1024, 1024), samples=samples) as renderer:

            def draw(count: int, by: fr.Renderer = renderer) -> object:
                return by.render(scene, fr.Shading(scatter_samples=count))

            for row in rows:
                time = ratio(partial(draw, row["samples"]), partial(draw, 0), 7)
                row["time"].append(time.value)
    return rows


if __name__ == "__main__":
    main()
