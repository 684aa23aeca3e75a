"""Measure the error of refracting eyes against exact rays, and the cost of eyes.

    python -m benchmarks.skin_eyes

Writes docs/measurements/skin_eyes.json in a minute. Needs an OpenGL context.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import facerender as fr
from benchmarks.data import ratio, save
from tests.meshes import with_geometry
from tests.verification.eye import INDEX, iris_errors
from tests.verification.parts_head import NAMES, parts_head

AZIMUTHS = (0.0, 30.0, 50.0, 60.0)
RINGS = (4, 8, 12, 24)


def main() -> None:
    with fr.Renderer((512, 512), samples=1) as renderer:
        measured = errors(renderer)
    triangles = [8 * rings**2 for rings in RINGS]
    save("skin_eyes", triangles=triangles, errors=measured, costs=costs())


def errors(renderer: fr.Renderer) -> list[dict[str, Any]]:
    """Return the displacement of the iris in fractions of its radius, per cornea and azimuth."""
    rows = []
    for azimuth in AZIMUTHS:
        found = [iris_errors(renderer, azimuth, rings=rings, sectors=4 * rings) for rings in RINGS]
        drawn = [{"mean": each.mean(), "most": np.quantile(each, 0.99)} for each, _ in found]
        rows.append({"azimuth": azimuth, "drawn": drawn, "straight": found[-1][1].mean()})
    return rows


def costs() -> list[dict[str, Any]]:
    """Return frame times of a head with clear shells around its eyes, relative to the head without
    the shells, with 1 and 4 samples per pixel."""
    whole, shell = parts_head(), NAMES.index("shells")
    bare = with_geometry(whole, parts=whole.parts[:shell], materials=whole.materials[:shell])
    rows = []
    for name, index in (("thin", 1.0), ("refracting", INDEX)):
        clear = replace(whole.materials[shell], alpha="opaque", transmission=1.0, refraction=index)
        parts, materials = whole.parts[: shell + 1], (*bare.materials, clear)
        scenes = [fr.Scene(with_geometry(whole, parts=parts, materials=materials)), fr.Scene(bare)]
        rows.append({"shells": name, "time": [_time(scenes, samples) for samples in (1, 4)]})
    return rows


def _time(scenes: list[fr.Scene], samples: int) -> float:
    """Return the frame time of the first scene relative to the second scene."""
    own, other = scenes
    with fr.Renderer(samples=samples) as renderer:
        return ratio(lambda: renderer.render(own), lambda: renderer.render(other), 15).value


if __name__ == "__main__":
    main()
