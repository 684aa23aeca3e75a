"""Measure the cost of each skin feature and of all together, and the savings of plans.

    python -m benchmarks.skin_together

Writes docs/measurements/skin_together.json in a quarter of an hour. Needs an OpenGL context and the
extra lod; two scenes also need the head scan.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import facerender as fr
from benchmarks.data import save, scenes
from benchmarks.frame import medians, plan_of
from facerender.pricing.cost import seconds
from facerender.scene.environment import Environment, studio
from tests.meshes import with_geometry
from tests.verification.lights import PLAIN_THREE
from tests.verification.subjects import Subject

REPEATS = 11
PLAN_SIZE = 128
SCAN_MILLIMETRES = 53.0  # per unit of the head scan's file


def main() -> None:
    with fr.Renderer() as renderer:
        measured = costs(renderer, fr.Scene(fr.load_mesh(), fr.Camera(-35.0), PLAIN_THREE))
    with fr.Renderer((PLAN_SIZE, PLAN_SIZE)) as renderer:
        plans = [plan_of(renderer, with_all(each), 1, "1/255", "99.9%") for each in scenes()]
    save("skin_together", costs=measured, plans=plans, median=medians(plans))


def with_all(subject: Subject) -> Subject:
    """Return a subject with all skin features that need no environment map."""
    scene = subject.scene
    mesh = scene.mesh.with_material(second_slope=1.6, lobe_weight=0.8, scattering="skin")
    mesh = with_geometry(mesh, millimetres=mesh.millimetres or SCAN_MILLIMETRES)
    whole = replace(scene, mesh=mesh, lights=_soft(scene.lights, 1))
    return replace(subject, scene=whole, full=subject.full.replace(diffuse="coupled"))


def _soft(lights: tuple[fr.Light, ...], count: int) -> tuple[fr.Light, ...]:
    soft = (replace(light, radius=5.0, shadow=True) for light in lights[:count])
    return (*soft, *lights[count:])


def costs(renderer: fr.Renderer, plain: fr.Scene) -> list[dict[str, Any]]:
    """Return the frame time of each feature relative to the plain frame: the median ratio, and the
    ratio of the fastest frames."""
    frames = _frames(plain)
    draws = [
        lambda at=scene, how=shading: renderer.render(at, how, samples=1)
        for scene, shading in frames.values()
    ]
    times = seconds(draws, REPEATS)
    ratios = np.median(times / times[:, :1], axis=0)
    fastest = times.min(axis=0) / times[:, 0].min()
    return [
        {"part": name, "time": float(ratio), "fastest": float(least)}
        for name, ratio, least in zip(frames, ratios, fastest, strict=True)
    ]


def _frames(plain: fr.Scene) -> Mapping[str, tuple[fr.Scene, fr.Shading]]:
    """Return scenes and shadings by the name of their features, beginning with the plain one."""
    every, key = fr.Shading(), plain.lights[0]
    coupled = fr.Shading(diffuse="coupled")

    def having(lights: int = 0, **material: Any) -> fr.Scene:
        mesh = plain.mesh.with_material(**material) if material else plain.mesh
        return replace(plain, mesh=mesh, lights=_soft(plain.lights, lights))

    def key_light(**changes: object) -> fr.Scene:
        return replace(plain, lights=(replace(key, **changes), *plain.lights[1:]))  # type: ignore[arg-type]

    lobes: dict[str, Any] = {"second_slope": 1.6, "lobe_weight": 0.8}
    return {
        "plain": (plain, every),
        "without the slope filter": (plain, fr.Shading(slope_filter=False)),
        "key light with a radius": (key_light(radius=5.0), every),
        "key light with a hard shadow": (key_light(shadow=True), every),
        "key light with a soft shadow": (having(1), every),
        "three lights with soft shadows": (having(3), every),
        "two lobes": (having(**lobes), every),
        "coupled diffuse term": (plain, coupled),
        "scattering": (having(scattering="skin"), every),
        "environment map, 32 samples": (replace(plain, environment=Environment(studio())), every),
        "all, one soft shadow": (having(1, scattering="skin", **lobes), coupled),
        "all, three soft shadows": (having(3, scattering="skin", **lobes), coupled),
    }


if __name__ == "__main__":
    main()
