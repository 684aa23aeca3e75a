"""Writes docs/skin-scattering.md and its picture: what scattering in the image loses and costs.

python -m tools.docs.skin_scattering     from the repository's root; ten minutes; needs an OpenGL context,
                                   embreex, and the head scan of the tests for a table
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

import facerender as fr
from facerender.measure.tables import markdown_table
from facerender.pricing.frame import ratio
from tests.verification.scan import load_scan, scan_folder
from tests.verification.scattering import SUBJECTS, scatter_errors
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/skin-scattering.md"
PICTURE = OUTPUT.with_name("scattering.jpg")
SAMPLES = (8, 16, 32, 64)
ERROR_HEAD = ("samples", "mean error", "99 % of the pixels within")
COST_HEAD = ("samples", "1 sample a pixel", "4 samples a pixel")
LIGHTS = (fr.Light(-50.0, 42.0, 3.0, shadow=True), fr.Light(80.0, 20.0, 0.5))

PAGE = """# Light below the skin

Written by `python -m tools.docs.skin_scattering`, on {GL_RENDERER}, OpenGL {GL_VERSION}.

![The built-in head without scattering, with it, and eight times what it changes](scattering.jpg)

Light enters skin and leaves it a few millimetres beside, red farthest: edges of shadows become
soft and red, pores and folds fill with light. Without shadows little of it is seen.

```
facerender render head.glb --scattering skin --light key,shadow -o head.png
facerender render head.obj --scattering skin --millimetres 10 -o head.png      a unit is 1 cm
```

`skin` is the three-layer skin of d'Eon and Luebke (2007): six Gaussians. Others are said in a
scene file, `[material] scattering = [[0.5, 0.3, 0.2, 0.1], [2.0, 0.5, 0.2, 0.0]]`: of each the
variance in mm^2, and the weights of red, green and blue; what these lack to 1 leaves where it
enters. In Python `mesh.with_material(scattering="skin")`. Parts of a mesh with the same profile
scatter into each other, others do not.

A profile is in millimetres, so the size of the mesh must be known. A unit of a .glb or .gltf file
is a metre; other formats do not say, and are refused without `--millimetres`. A mesh that is
smaller than 80 mm or larger than 2.4 m across by that is told of in a warning.

## How it is drawn

The diffuse light of every pixel, in shadow and from everywhere, is drawn apart with the place
that the pixel shows. Around each pixel N others are looked at, on a spiral whose radii are
distributed as the red of the profile, and weighted by the profile at the distance between both
places in space: what is near in the image and far away does not count. Gaussians with a deviation
of less than half a pixel, at the distance of the camera's target, stay where they are; where all
of them do, nothing is drawn for scattering, and nothing is spent. `--scatter-samples N` is 8, 16,
32 or 64, and 0 leaves it out.

With several samples a pixel the coverage stays as it is without scattering. What scattering
changes is found at the pixel's centre, and counts for all that the pixel covers; where the centre
sees nothing, that of a neighbour does. Where a pixel sees two surfaces this mixes them up: in the
silhouette of the head 4 samples with scattering are as far from 16 shaded ones as they are
without (within 37 of 255 and 35 at 99 % of these pixels, 512 x 512). More samples than the driver
has scatter each by itself.

`only="diffuse"` is scattered, `only="specular"` is not. Light that the image does not show does
not scatter into it: what is beyond its border, hidden or on the far side of an ear.

## What it loses

Against the profile integrated over points of the mesh, both in the light of the same rays: one
light, 512 x 512 pixels, 1.8 of a millimetre, {count} pixels by chance. Error of the irradiance
over all of it; error of the displayed skin, of its worst channel, in steps of 255. The Gaussians
that are narrower than half a pixel stay where they are in both.

{error_tables}

The float64 reference (`facerender.drawing.reference.shade`) agrees with the GPU within 1e-4 of
max(reference, 0.01) at 99.9 % of the pixels. At the others a place of the spiral rounds into
another pixel there, and they differ by what one of N pixels counts.

## What it costs

Time of a frame of the built-in head, 1024 x 1024, with one light and its shadow and another one,
over that without scattering, in turns:

{costs}

Plans choose among these numbers, and none (`scattering` in `facerender plan`): what they lose is
drawn, at every camera.
"""


def main() -> None:
    with fr.Renderer((16, 16)) as renderer:
        facts = dict(renderer.metadata)
    count = 20_000
    picture()
    text = PAGE.format(
        count=f"{count:,}", error_tables="\n\n".join(error_tables(count)), costs=costs(), **facts
    )
    OUTPUT.write_text(text, encoding="utf-8")
    print(text)


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (ERROR_HEAD, COST_HEAD))


def picture() -> None:
    scene = fr.Scene(skin(), fr.Camera(-35.0, zoom=1.6), LIGHTS)
    with fr.Renderer((480, 480)) as renderer:
        off, on = (
            renderer.render(scene, fr.Shading(scatter_samples=n)).srgb8().astype(int)
            for n in (0, 32)
        )
    change = np.clip(128 + 8 * (on - off), 0, 255)
    Image.fromarray(np.hstack([off, on, change]).astype(np.uint8)).save(PICTURE, quality=86)


def error_tables(count: int) -> Iterator[str]:
    meshes = {"head": fr.load_mesh()}
    if folder := scan_folder():
        meshes["scan_mesh"] = load_scan(folder)
    for name, mesh in meshes.items():
        scene, light = SUBJECTS[name](mesh)
        with fr.Renderer((512, 512), samples=1) as renderer:
            _, errors = scatter_errors(renderer, scene, light, (0, *SAMPLES), count)
        rows = [
            (str(each.samples or "none"), f"{100.0 * each.mean:.2f} %", f"{each.p99:.1f}")
            for each in errors
        ]
        title = "The built-in head" if name == "head" else "The scan"
        yield f"{title}:\n\n{markdown_table(ERROR_HEAD, rows)}"


def costs() -> str:
    scene = fr.Scene(skin(), fr.Camera(-35.0), LIGHTS)
    columns = []
    for samples in (1, 4):
        with fr.Renderer((1024, 1024), samples=samples) as renderer:

            def draw(count: int) -> object:
                return renderer.render(scene, fr.Shading(scatter_samples=count))

            columns.append(
                [f"{ratio(lambda n=n: draw(n), lambda: draw(0), 7).value:.1f}" for n in SAMPLES]
            )
    return markdown_table(COST_HEAD, [*zip(map(str, SAMPLES), *columns, strict=True)])


def skin() -> fr.Mesh:
    return fr.load_mesh().with_material(scattering="skin")


if __name__ == "__main__":
    main()
