"""Writes docs/frame.md: what a whole frame costs here, what samples lose, what plans of it save.

python -m tools.docs.frame      from the repository's root; half an hour; needs an OpenGL context, the
                          extra lod, and the head scan of the tests for two scenes
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

import facerender as fr
from facerender.images.image import linear_to_srgb
from facerender.measure.antialiasing import antialiasing
from facerender.measure.tables import SAMPLES_HEAD, markdown_table, sample_cells
from facerender.planning.decisions import Decision
from facerender.pricing.frame import ratio
from tests.verification.scan import load_scan, scan_folder
from tests.verification.subjects import Subject, subjects
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/frame.md"
SIZES = (512, 1024)
DEFERRED_HEAD = ("scene", "triangles", "1 sample", "over 1/255", "4 samples", "over 1/255")

PLAN_HEAD = (
    "scene",
    "chosen",
    "predicted",
    "measured",
    "of a frame as drawn",
    "error",
    "worst pixel",
)
# title, cameras, size, budget, share of the pixels
PLANS = (
    ("Within 1/255 at 99.9 % of the pixels, one camera, 512 x 512", 1, 512, "1/255", "99.9%"),
    ("Within 1/255 at 99.9 % of the pixels, eight cameras, 128 x 128", 8, 128, "1/255", "99.9%"),
    ("Within 8/255 at 95 % of the pixels, one camera, 256 x 256", 1, 256, "8/255", "95%"),
)

PAGE = """# Frames: what they cost, what samples lose

Written by `python -m tools.docs.frame`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. Times are of frames with readback, medians of ratios in turns.

## The reference

Errors of a frame are those of the displayed image (sRGB), of a pixel's worst channel, against the
full frame at high quality: 64 samples a pixel, each shaded by itself, the full mesh, exact terms,
all maps. `render` draws 4 samples, which share a pixel's shading; what that loses is the second row
of the tables below. A plan's errors are against the frame that `render` draws without a plan, whose
own distance from the reference is not counted.

## Samples

The built-in head, three lights, 35 degrees to the side. Up to {most} samples are the driver's: a
pixel is shaded once for every triangle that its samples see. More are as many images with one
sample each, shaded anew: highlights between pixels are smoothed as well, at the price of as many
frames.

Per-pixel shading (`Renderer.render(..., shading_rate="pixel")`) shades one triangle of each pixel, the one that most of
its samples see, for all of them. The coverage is the same, and so is the silhouette; edges inside
it, such as of the nose before the cheek, are as with one sample. Each part of a mesh is shaded once
by itself. It needs as many samples as the driver has, and a frame that can be deferred (below);
others are drawn as without.

{sample_tables}

## Shaded as drawn, or deferred

On llvmpipe a frame is deferred, where that pays: a first pass draws which triangle each sample
sees, a second one shades every triangle that a pixel sees, once (Burns and Hunt 2013, "The
visibility buffer"). A triangle that is drawn shades blocks of pixels at its edges that it does not
cover; small triangles spend most of a frame on that. Time of a frame as it is drawn now over that
of triangles shaded as they are drawn, and the share of the covered pixels that differ by more than
1/255 in the display:

{deferred}

With one sample and more than 30 pixels for each triangle of the mesh, frames are not deferred.

Other sizes, with 4 samples, of the built-in head:

{sizes}

## Plans

A cheaper frame within a budget (`facerender plan --verify-cost`): terms, back faces, samples, pixels
shaded once, triangles. The scenes are those of [plan.md](plan.md). Time over that of the full frame
with 4 samples, predicted from a few measured frames and measured in turns; over that of the full
frame with its triangles shaded as they are drawn; the error that the budget counts, and that of the
worst pixel, both as drawn.

{plans}
Within 1/255 fewer samples err by more at the silhouette, pixels that are shaded once and fewer
triangles inside, at more than one pixel in 1000: what is left are back faces, which no
pixel shows, and terms. Most of what can be saved there every frame saves, by shading each triangle
of a pixel once.
"""


def main() -> None:
    with fr.Renderer() as renderer:
        facts = dict(renderer.metadata)
        most = renderer.context.most_samples
    text = PAGE.format(
        sample_tables="\n\n".join(f"{size} x {size}\n\n{sample_table(size)}" for size in SIZES),
        deferred=deferred_table(),
        sizes=sizes_table(),
        plans="\n".join(plan_tables()),
        most=most,
        **facts,
    )
    OUTPUT.write_text(text, encoding="utf-8")
    print(text)


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (SAMPLES_HEAD, DEFERRED_HEAD, PLAN_HEAD))


def sample_table(size: int) -> str:
    with fr.Renderer((size, size)) as renderer:
        rows = antialiasing(renderer, fr.Scene(fr.load_mesh(), fr.Camera(-35.0)))
    return markdown_table(SAMPLES_HEAD, [sample_cells(row) for row in rows])


def deferred_table() -> str:
    meshes = {"built-in head": fr.load_mesh()}
    if folder := scan_folder():
        meshes["scan"] = load_scan(folder)
    rows = []
    for name, mesh in meshes.items():
        scene = fr.Scene(mesh, fr.Camera(-35.0))
        cells = [name, str(sum(len(part.faces) for part in mesh.parts))]
        for samples in (1, 4):
            cells += deferred_against_drawn(scene, samples)
        rows.append(tuple(cells))
    return markdown_table(DEFERRED_HEAD, rows)


def sizes_table() -> str:
    scene, sizes = fr.Scene(fr.load_mesh(), fr.Camera(-35.0)), (256, 512, 1024, 2048)
    cells = [deferred_against_drawn(scene, 4, size)[0] for size in sizes]
    return markdown_table([f"{size} x {size}" for size in sizes], [cells])


def plan_tables() -> Iterator[str]:
    head, folder = fr.load_mesh(), scan_folder()
    scenes = [*subjects(head, load_scan(folder) if folder else None)]
    for title, count, size, budget, share in PLANS:
        with fr.Renderer((size, size)) as renderer:
            planned = [plan_row(renderer, each, count, budget, share) for each in scenes]
        median = float(np.median([measured for _, measured, _ in planned]))
        drawn = float(np.median([over_drawn for _, _, over_drawn in planned]))
        rows = [row for row, _, _ in planned]
        rows.append(("median", "", "", f"{median:.2f}", f"{drawn:.2f}", "", ""))
        yield f"{title}:\n\n{markdown_table(PLAN_HEAD, rows)}\n"


def plan_row(
    renderer: fr.Renderer, subject: Subject, count: int, budget: str, share: str
) -> tuple[tuple[str, ...], float, float]:
    """Return the cells of a plan, and its frame's time over both full frames'."""
    cameras = fr.turntable(subject.scene.camera, count)
    found = fr.plan(
        subject.scene,
        budget,
        full=subject.full,
        cameras=cameras,
        within=share,
        renderer=renderer,
        verify_cost=True,
    )
    assert found.detail is not None
    assert found.measured is not None
    assert found.error.drawn is not None
    assert found.error.drawn_within is not None
    scene = found.detail.of(subject.scene)

    def planned() -> object:
        fine = found.detail.values
        return renderer.render(scene, found.shading, **fine)

    def drawn() -> object:
        with patch("facerender.drawing.renderer.pays", lambda *_: False):
            return renderer.render(subject.scene, found.full)

    over_drawn = ratio(planned, drawn, 7).value
    text = found.budget.text
    cells = (
        subject.name,
        ", ".join(word for each in found.decisions for word in _chosen(each)) or "the full frame",
        f"{found.cost.relative:.2f}",
        f"{found.measured.value:.2f}",
        f"{over_drawn:.2f}",
        text(found.error.drawn_within),
        text(found.error.drawn),
    )
    return cells, found.measured.value, over_drawn


def _chosen(decision: Decision) -> Iterator[str]:
    """What was chosen, where it is not what the full frame has."""
    if decision.changed and decision.name == "cull_back_faces":
        yield "back faces culled"
    elif decision.changed:
        words = ("samples", "shading_rate", "triangles", "ambient", "normal map")
        named = decision.name in words
        yield f"{decision.name} {decision.chosen}" if named else decision.chosen


def deferred_against_drawn(scene: fr.Scene, samples: int, size: int = 1024) -> tuple[str, str]:
    with fr.Renderer((size, size), samples=samples) as renderer:

        def deferred() -> np.ndarray:
            return renderer.render(scene).linear

        def drawn() -> np.ndarray:
            with patch("facerender.drawing.renderer.pays", lambda *_: False):
                return renderer.render(scene).linear

        time = ratio(deferred, drawn, 9)
        one, other = deferred(), drawn()
    error = np.abs(linear_to_srgb(one[..., :3]) - linear_to_srgb(other[..., :3])).max(axis=-1)
    over = (error[other[..., 3] > 0.0] > 1 / 255).mean()
    return f"{time.value:.2f} ({time.low:.2f} to {time.high:.2f})", f"{100 * over:.3f} %"


if __name__ == "__main__":
    main()
