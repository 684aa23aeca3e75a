"""Writes docs/frame.md: what a whole frame costs here, what its parts take, what samples lose.

python -m docs.frame      from the repository's root; ten minutes; needs an OpenGL context and the
                          head scan of the tests
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

import facerender as fr
from docs.template import missing
from facerender.image import linear_to_srgb
from facerender.measure.antialiasing import Lost, antialiasing
from facerender.measure.tables import markdown_table
from facerender.pricing.frame import ratio
from trials.scan import load_scan, scan_folder

OUTPUT = Path(__file__).with_suffix(".md")
SIZES = (512, 1024)
SAMPLES_HEAD = (
    "samples",
    "frame",
    "silhouette: mean",
    "99 %",
    "inside: mean",
    "99 %",
    "over 1/255",
)
DEFERRED_HEAD = ("scene", "triangles", "1 sample", "over 1/255", "4 samples", "over 1/255")

PAGE = """# Frames: what they cost, what samples lose

Written by `python -m docs.frame`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. Times are of frames with readback, medians of ratios in turns.

## The reference

Errors of a frame are those of the displayed image (sRGB), of a pixel's worst channel, against the
full frame at high quality: 64 samples a pixel, each shaded by itself, the full mesh, exact terms,
all maps. `render` draws 4 samples, which share a pixel's shading; what that loses is the second row
of the tables below. A plan's errors are against the frame that `render` draws without a plan, whose
own distance from the reference is no fault of the plan's.

## Samples

The built-in head, three lights, 35 degrees to the side. Up to {most} samples are the driver's: a
pixel is shaded once for every triangle that its samples see. More are as many images with one
sample each, shaded anew: highlights between pixels are smoothed as well, at the price of as many
frames.

{sample_tables}

## Shaded as drawn, or deferred

On llvmpipe a frame is deferred, where that pays: a first pass draws which triangle each sample
sees, a second one shades every triangle that a pixel sees, once (Burns and Hunt 2013, "The
visibility buffer"). A triangle that is drawn shades blocks of pixels at its edges that it does not
cover; small triangles spend most of a frame on that. Time of a frame as it is drawn now over that
of triangles shaded as they are drawn, and the share of the covered pixels that differ by more than
1/255 in the display:

{deferred}

With one sample and more than 100 pixels for each triangle of the mesh, frames are not deferred.

Tried, and left out, since it saves less than 2 % of a frame here or loses more than 1/255 at one
pixel in 1000: one shading for a pixel's triangles of one smooth surface (4 % saved, 0.2 % of the
pixels over 1/255); the nearest mip level in place of two (nothing saved, 13 % over); maps without
their top level (nothing saved but memory); float16 and 8-bit targets (the pass that shades writes
each pixel once: 1 %).
"""


def main() -> None:
    with fr.Renderer() as renderer:
        facts = dict(renderer.metadata)
        most = renderer.context.most_samples
    text = PAGE.format(
        sample_tables="\n\n".join(f"{size} x {size}\n\n{sample_table(size)}" for size in SIZES),
        deferred=deferred_table(),
        most=most,
        **facts,
    )
    OUTPUT.write_text(text, encoding="utf-8")
    print(text)


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (SAMPLES_HEAD, DEFERRED_HEAD))


def sample_table(size: int) -> str:
    with fr.Renderer((size, size)) as renderer:
        rows = antialiasing(renderer, fr.Scene(fr.load_mesh(), fr.Camera(-35.0)))
    return markdown_table(
        SAMPLES_HEAD,
        [
            (
                str(row.samples),
                f"{row.time.value:.2f}",
                *_told(row.silhouette),
                *_told(row.inside),
                f"{100 * row.inside.over:.2f} %",
            )
            for row in rows
        ],
    )


def _told(lost: Lost) -> tuple[str, ...]:
    return f"{255 * lost.mean:.2f}/255", f"{255 * lost.percentile:.1f}/255"


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


def deferred_against_drawn(scene: fr.Scene, samples: int) -> tuple[str, str]:
    with fr.Renderer(samples=samples) as renderer:

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
