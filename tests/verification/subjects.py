"""Scenes that plans are tested on, and the brute-force search that they are tested against."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

import facerender as fr
from facerender.drawing.reference import shade
from facerender.planning.budget import Budget
from facerender.scene.background import clear_color
from tests.verification.lights import PLAIN, PLAIN_THREE

BUDGETS = ("0.5/255", "1/255", "4/255")
KINDS = ("llvmpipe", "navi21", "vega10")


@dataclass(frozen=True, eq=False)
class Subject:
    """A named scene and the shading whose image is the reference."""

    name: str
    scene: fr.Scene
    full: fr.Shading = fr.Shading()


def subjects(head: fr.Mesh, scan: fr.Mesh | None) -> Iterator[Subject]:
    """Yield ten scenes, or eight if there is no scan."""
    front, key, three = (PLAIN["front"],), (PLAIN["key"],), PLAIN_THREE
    dielectric = fr.Shading(fresnel="dielectric")

    def at(m: float | None, ks: float = 1.0, mesh: fr.Mesh = head) -> fr.Mesh:
        return mesh.with_material(ks=ks) if m is None else mesh.with_material(m=m, ks=ks)

    for name, mesh, lights, full in (
        ("head, m 0.15, front light", at(0.15), front, fr.Shading()),
        ("head, m 0.2, three lights", at(0.2), three, fr.Shading()),
        ("head, m 0.3, key light, ks 0.18", at(0.3, 0.18), key, fr.Shading()),
        ("head, m 0.3, three lights", at(0.3), three, fr.Shading()),
        ("head, m 0.45, front light, Ward", at(0.45), front, fr.Shading("ward")),
        ("head, m 0.6, three lights", at(0.6), three, fr.Shading()),
        ("head, roughness map, three lights", at(None), three, fr.Shading()),
        ("head, roughness map, front light, ks 0.18", at(None, 0.18), front, fr.Shading()),
    ):
        yield Subject(name, fr.Scene(mesh, fr.Camera(-35.0, frame="all"), lights), full)
    if scan is not None:
        for name, mesh, lights, full in (
            ("scan, m 0.3, three lights", at(0.3, mesh=scan), three, fr.Shading()),
            ("scan, m 0.45, key light, dielectric", at(0.45, mesh=scan), key, dielectric),
        ):
            yield Subject(name, fr.Scene(mesh, fr.Camera(-35.0, frame="all"), lights), full)


def brute_force(
    renderer: fr.Renderer,
    subject: Subject,
    shadings: Sequence[fr.Shading],
    unit: str = "1/255",
    cameras: Sequence[fr.Camera] = (),
    within: float = 1.0,
) -> list[float]:
    """Return the largest error of each shading over all cameras, in the unit of a budget.

    Each image is the reference shading of that shading's G-buffer.

    cameras : default: the camera of the scene
    within : fraction of each camera's pixels that counts; the pixels with the largest errors are
        ignored
    """
    budget = Budget.parse(unit)
    scenes = [replace(subject.scene, camera=each) for each in cameras or (subject.scene.camera,)]
    gbuffers: dict[tuple[object, ...], list[fr.GBuffer]] = {}

    def images(shading: fr.Shading) -> list[np.ndarray]:
        key = (shading.normal_map, shading.ambient, shading.term.m, shading.ks)
        if key not in gbuffers:
            gbuffers[key] = [renderer.gbuffer(scene, shading) for scene in scenes]
        shaded = [shade(each, at, shading) for each, at in zip(gbuffers[key], scenes, strict=True)]
        for image, inside in zip(shaded, covered, strict=True):
            image[~inside] = clear_color(subject.scene.background)
        return shaded

    def worst(shading: fr.Shading) -> float:
        compared = zip(images(shading), exact, covered, strict=True)
        counted = [np.sort(budget.errors(own, full)[inside]) for own, full, inside in compared]
        return max(float(each[math.ceil(round(within * each.size, 6)) - 1]) for each in counted)

    covered = [renderer.gbuffer(scene, subject.full).part >= 0 for scene in scenes]
    exact = images(subject.full)
    return [worst(each) for each in shadings]
