"""Measure the errors of shadows and baked occlusion against ray tracing, and their cost.

    python -m benchmarks.skin_shadows

Writes docs/measurements/skin_shadows.json in a few minutes. Needs an OpenGL context, embreex and
the head scan.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import facerender as fr
from benchmarks.data import meshes, ratio, save
from tests.verification.occlusion import occlusion_error
from tests.verification.shadows import shadow_error

RADII = (0.0, 0.25, 2.0, 6.0, 15.0)
NAMES = {"head": "built-in head", "scan": "scan"}


def main() -> None:
    with fr.Renderer((512, 512), samples=1) as renderer:
        measured = errors(renderer)
        occluded = occlusion(renderer)
    save("skin_shadows", errors=measured, costs=costs(), occlusion=occluded)


def key(mesh: fr.Mesh, radius: float, distance: float | None = None) -> fr.Light:
    """Return a light from the upper left.

    ``distance`` is in radii of the mesh's bounding sphere; None gives a distant light. ``radius``
    is the angular radius in degrees.
    """
    light = fr.Light(-50.0, 42.0, 3.5, radius=radius, shadow=True)
    if distance is None:
        return light
    return replace(
        light,
        azimuth=0.0,
        elevation=0.0,
        position=tuple(mesh.center + distance * mesh.radius * light.direction),
    )


def errors(renderer: fr.Renderer) -> list[dict[str, Any]]:
    """Return the errors of shadows against ray tracing, as fractions of the arriving light."""
    rows = []
    for name, mesh in meshes():
        scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6, frame="all"))
        for distance in (None, 2.5):
            for radius in RADII if distance is None else RADII[:-1]:
                light = key(mesh, radius, distance)
                lost = shadow_error(renderer, scene, light)
                kind = "distant" if distance is None else f"point, {distance:g} radii away"
                row = {"mesh": NAMES[name], "light": kind, "radius": radius}
                row |= {"shadowed": lost.shadowed, "without": lost.without}
                rows.append({**row, "mean": lost.mean, "wrong": lost.wrong})
    return rows


def costs() -> list[dict[str, Any]]:
    """Return frame times relative to frames without shadow, with 1 and 4 samples per pixel."""
    mesh = fr.load_mesh()
    rows = []
    for name, radius in (("radius 0", 0.0), ("radius 5 degrees", 5.0)):
        light = key(mesh, radius)
        scenes = [
            fr.Scene(mesh, fr.Camera(-20.0, frame="all"), (each,))
            for each in (light, replace(light, shadow=False))
        ]
        rows.append({"light": name, "time": [_time(scenes, samples, 9) for samples in (1, 4)]})
    return rows


def occlusion(renderer: fr.Renderer) -> list[dict[str, Any]]:
    """Return the errors of baked occlusion, the seconds to bake it, and the relative frame time."""
    rows = []
    for name, mesh in meshes():
        bare = mesh.with_material(occlusion_map=None)
        light = replace(key(bare, 0.0), shadow=False)
        scene = fr.Scene(bare, fr.Camera(-20.0, zoom=1.6, frame="all"), (light,))
        found = occlusion_error(renderer, scene)
        scenes = [replace(scene, mesh=fr.with_occlusion(bare)), scene]
        row = {"mesh": NAMES[name], "vertices": sum(len(part.positions) for part in bare.parts)}
        row |= {"seconds": found.seconds, "without": found.without, "baked": found.baked}
        rows.append({**row, "time": [_time(scenes, samples, 21) for samples in (1, 4)]})
    return rows


def _time(scenes: list[fr.Scene], samples: int, repeats: int) -> float:
    """Return the frame time of the first scene relative to the second scene."""
    own, other = scenes
    with fr.Renderer(samples=samples) as renderer:
        return ratio(lambda: renderer.render(own), lambda: renderer.render(other), repeats).value


if __name__ == "__main__":
    main()
