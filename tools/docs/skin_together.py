"""Writes docs/skin-together.md: what each part of skin costs of a frame, and all of them together,
and what plans of such scenes leave out.

python -m tools.docs.skin_together   a quarter of an hour; needs an OpenGL context, the extra lod, and the
                               head scan of the tests for two scenes
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import facerender as fr
from facerender.measure.tables import markdown_table
from facerender.pricing.frame import seconds
from facerender.scenes.environment import Environment, studio
from tests.verification.scan import load_scan, scan_folder
from tests.verification.subjects import Subject, subjects
from tools.docs.frame import PLAN_HEAD, plan_row
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/skin-together.md"
COST_HEAD = ("a frame of 1024 x 1024, 1 sample", "over the plain one", "fastest over fastest")
REPEATS = 11
PLAN_SIZE = 128
SCAN_MILLIMETRES = 53.0  # of a unit of its file

PAGE = """# Skin: all of it together

Written by `python -m tools.docs.skin_together`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. What each part is for: [slopes](skin.md), [shadows](skin-shadows.md), [lobes and
diffuse light](skin-lobes.md), [scattering](skin-scattering.md), [environment](skin-environment.md).

## What it costs

The built-in head under key, rim and fill, 35 degrees to the side, readback included; medians of
ratios in turns, and the ratio of the fastest. The plain frame is the default one, with the slope
filter. The key light has a radius of 5 degrees; the second lobe has 1.6 times the slope and a fifth
of the highlight; scattering looks at 16 pixels.

{cost}

Scattering passes over what is no skin. A soft shadow is not looked for where a light is below the
horizon, and no penumbra where all or nothing of the light is hidden.

## Plans

Within 1/255 at 99.9 % of the pixels (`facerender plan --verify-cost`), {size} x {size}, of the
scenes of [plan.md](plan.md) with all of it: the first light with a radius of 5 degrees and a
shadow, two lobes, coupled diffuse light, scattering. Time over that of the full frame with 4
samples, predicted and measured in turns; over that of the full frame with its triangles shaded as
they are drawn; the error that the budget counts, and that of the worst pixel, both as drawn.

{plans}

{violations} of {count} plans are over their budget when they are drawn.
"""


def main() -> None:
    head = fr.load_mesh()
    with fr.Renderer() as renderer:
        facts = dict(renderer.metadata)
        cost = cost_table(renderer, fr.Scene(head, fr.Camera(-35.0)))
    scan = load_scan(folder) if (folder := scan_folder()) else None
    rows, over = [], 0
    with fr.Renderer((PLAN_SIZE, PLAN_SIZE)) as renderer:
        for subject in subjects(head, scan):
            row, _, _ = plan_row(renderer, with_all(subject), 1, "1/255", "99.9%")
            over += float(row[-2].split("/")[0]) > 1.0
            rows.append(row)
            print(row, flush=True)
    measured = [float(row[3]) for row in rows]
    rows.append(("median", "", "", f"{np.median(measured):.2f}", "", "", ""))
    text = PAGE.format(
        cost=cost,
        plans=markdown_table(PLAN_HEAD, rows),
        size=PLAN_SIZE,
        violations=over,
        count=len(measured),
        **facts,
    )
    OUTPUT.write_text(text, encoding="utf-8")
    print(text)


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (COST_HEAD, PLAN_HEAD))


def with_all(subject: Subject) -> Subject:
    """Return a scene with every part of skin that no environment needs."""
    scene = subject.scene
    mesh = scene.mesh.with_material(second_slope=1.6, lobe_weight=0.8, scattering="skin")
    mesh = replace(mesh, millimetres=mesh.millimetres or SCAN_MILLIMETRES)
    whole = replace(scene, mesh=mesh, lights=_soft(scene.lights, 1))
    return replace(subject, scene=whole, full=subject.full.replace(diffuse="coupled"))


def _soft(lights: tuple[fr.Light, ...], count: int) -> tuple[fr.Light, ...]:
    soft = (replace(light, radius=5.0, shadow=True) for light in lights[:count])
    return (*soft, *lights[count:])


def cost_table(renderer: fr.Renderer, plain: fr.Scene) -> str:
    frames = _frames(plain)
    draws = [
        lambda at=scene, how=shading: renderer.render(at, how, samples=1)
        for scene, shading in frames.values()
    ]
    times = seconds(draws, REPEATS)
    ratios = np.median(times / times[:, :1], axis=0)
    fastest = times.min(axis=0) / times[:, 0].min()
    cells = zip(frames, ratios, fastest, strict=True)
    return markdown_table(COST_HEAD, [(name, f"{a:.2f}", f"{b:.2f}") for name, a, b in cells])


def _frames(plain: fr.Scene) -> Mapping[str, tuple[fr.Scene, fr.Shading]]:
    """Scenes and shadings, by what they have; the plain one is the first."""
    every, key = fr.Shading(), plain.lights[0]
    coupled = fr.Shading(diffuse="coupled")

    def having(lights: int = 0, **material: object) -> fr.Scene:
        mesh = plain.mesh.with_material(**material) if material else plain.mesh
        return replace(plain, mesh=mesh, lights=_soft(plain.lights, lights))

    def key_light(**changes: object) -> fr.Scene:
        return replace(plain, lights=(replace(key, **changes), *plain.lights[1:]))  # type: ignore[arg-type]

    lobes = {"second_slope": 1.6, "lobe_weight": 0.8}
    return {
        "plain": (plain, every),
        "without the slope filter": (plain, fr.Shading(slope_filter=False)),
        "curvature": (plain, fr.Shading(curvature=True)),
        "key light with a radius": (key_light(radius=5.0), every),
        "key light with a hard shadow": (key_light(shadow=True), every),
        "key light with a soft shadow": (having(1), every),
        "three lights with soft shadows": (having(3), every),
        "two lobes": (having(**lobes), every),
        "coupled diffuse light": (plain, coupled),
        "scattering": (having(scattering="skin"), every),
        "environment, 32 samples, besides": (
            replace(plain, environment=Environment(studio())),
            every,
        ),
        "all, one soft shadow": (having(1, scattering="skin", **lobes), coupled),
        "all, three soft shadows": (having(3, scattering="skin", **lobes), coupled),
    }


if __name__ == "__main__":
    main()
