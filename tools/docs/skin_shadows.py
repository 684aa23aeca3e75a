"""Writes docs/skin-shadows.md and its pictures: what shadows and baked occlusion are for, how far
they are from rays, what they cost.

python -m tools.docs.skin_shadows   a few minutes; needs an OpenGL context, embreex, and the head scan of
                              the tests
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import facerender as fr
from facerender.measure.tables import markdown_table
from facerender.pricing.frame import ratio
from tests.verification.occlusion import occlusion_error
from tests.verification.scan import load_scan, scan_folder
from tests.verification.shadows import shadow_error
from tools.docs.template import missing

HERE = Path(__file__).parents[2] / "docs"
OUTPUT = HERE / "skin-shadows.md"
PICTURE = HERE / "shadows.jpg"
OCCLUSION_PICTURE = HERE / "occlusion.jpg"

RADII = (0.0, 0.25, 2.0, 6.0, 15.0)
HEAD = ("mesh", "light", "radius", "in shadow", "without shadows", "mean error", "wrong by half")
COST_HEAD = ("a frame of 1024 x 1024", "1 sample", "4 samples")
OCCLUSION_HEAD = (
    *("mesh", "vertices", "baked in", "mean error without", "mean error"),
    *("a frame, 1 sample", "4 samples"),
)

PAGE = """# Skin: shadows

Written by `python -m tools.docs.skin_shadows`, on {GL_RENDERER}, OpenGL
{GL_VERSION}. No light casts shadows unless it says so, and then costs nothing.

**What they are for.** Without shadows a nose does not darken the cheek behind it, light shines
through the chin onto the neck, and the inner ear glows: faces look as if they were lit from within.
The shadow of a light without size has an edge like a knife; that of a softbox is sharp where nose
and cheek meet, and soft where the chin is far from the neck. `radius` sets that size, and widens
the highlight by the same disc ([skin.md](skin.md)).

![without shadows, from a light without size, from one with a radius of 5 degrees](shadows.jpg)

| | command line | Python, scene file |
|---|---|---|
| one light | `--light key,shadow`, `--light key,radius=5,shadow` | `fr.Light(shadow=True)` |
| all of them | `--shadows`, `--no-shadows` | |
| a shading without | | `fr.Shading(shadow_lights=[])` |
| how much is seen | `--only visibility` | `renderer.gbuffer(scene).visibility` |

A light's map has 1024 x 1024 texels over the sphere around the mesh; all maps lie in one texture,
and are drawn once, until a light or a mesh moves. So a shadow's edge is never finer than 1/512 of
that sphere's radius: in a close-up of a light without size its steps are seen, and a small radius
hides them. Lights of up to 16 cast shadows; a point light must stand outside the sphere.

Backs of triangles cast shadows as fronts do, for scans are open. What is transparent in a texture
casts a shadow as if it were not.

## How near it is

How much of the light is seen at every pixel's centre, at 512 x 512, against rays to points of the
light (one for a light without size, 64 else; Embree), by N.L: the mean error over all light that
arrives, beside that of an image without shadows; and the share of the pixels that err by more than
half.

{errors}

Beyond a radius of 6 degrees the penumbra comes out too dark: the mean depth of what stands before a
light says less the more of it is hidden. {shading}

## What it costs

A frame with one light over one without its shadow, readback included, medians in turns; the map is
drawn once and not counted.

{cost}

## In your own program

`facerender/shadow.glsl` has `fr_shadow_hard` and `fr_shadow_disc`; its header tells the space of a
light, in which a point light is like a distant one. `facerender.scenes.shadow.light_space` returns
the matrix. Clear the map to a large negative number, and draw z with a depth test.

```glsl
#include "facerender/shadow.glsl"

vec4 q = light_view * vec4(position + 2.5 / 1024.0 * n, 1.0);
float seen = fr_shadow_disc(
    map, ivec3(0, 0, 1024), q.xyz / q.w, plane, tan(radius), 1.0, 0.004, turn
);
```

`FR_SHADOW_SAMPLES` (12) is how often it looks, twice.

**Plans.** `facerender plan` leaves shadows out that nobody sees, such as those of a light beside
the camera, and tells so under "shadows".

## Light from everywhere

A light that is the same from everywhere has no shadow's edge, but less of it comes into an eye
socket, a nostril, between the lips, behind an ear. An occlusion map says how much, and a file that
brings none has all of it everywhere. `--occlusion` finds it by rays from the mesh's vertices, and
dims ambient light and the diffuse light of an environment by that; highlights and other lights stay
as they are.

![without and with baked occlusion in ambient light, and in that of a scene](occlusion.jpg)

| command line | Python | job |
|---|---|---|
| `--occlusion` | `fr.with_occlusion(mesh)` | `fr.MeshFile("scan.obj", occlusion=True)` |

It needs `pip install 'facerender[rays]'` (Embree). A part with an occlusion map keeps that, and
nothing is baked for it: it knows more than vertices do. If all have one, as the built-in head has,
a warning says so. The values are the same in every process, and the command keeps them by what the
mesh is, so that only the first run waits ([command-line.md](command-line.md#what-is-kept));
`fr.with_occlusion(mesh, cache=True)` does as well. All parts stand in the way, from both sides.
What is simplified is baked before and keeps it, as it keeps colours. A planned scene does not name
its mesh: name `--occlusion` with the mesh again.

What a pixel receives, at 4000 pixels of 512 x 512 against 512 rays for each, Embree's too: the mean
error, in shares of the whole light, of taking it for 1 and of what is baked; and frames with it
over those without, in ambient light and one other, 1024 x 1024, readback included, medians in
turns. The head is without its own map, the scan Lee Perry-Smith's (Infinite-Realities, CC BY 3.0),
as in the picture.

{occlusion}

Every vertex looks in the same 512 directions over the sphere, of which half count, by their cosine:
the errors of neighbours are alike, and no noise is seen. Most of the error is between vertices: a
crease that is narrower than their distance, such as the line between lids, is too light or too
wide.
"""


def main() -> None:
    with fr.Renderer((512, 512), samples=1) as renderer:
        facts = dict(renderer.metadata)
        errors = error_table(renderer)
        occlusion = occlusion_table(renderer)
    fields = {"errors": errors, "cost": cost_table(), "occlusion": occlusion}
    text = PAGE.format(shading=SHADING, **fields, **facts)
    OUTPUT.write_text(text, encoding="utf-8")
    picture()
    occlusion_picture()
    print(text)


SHADING = """The image itself differs from float64 shading of the
same G-buffer, which holds the visibility, by less than 1e-4 (`pytest tests/test_shadows.py`)."""


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (HEAD, COST_HEAD, OCCLUSION_HEAD))


def key(mesh: fr.Mesh, radius: float, distance: float | None = None) -> fr.Light:
    """A light high on the left: distant, or so many radii of the mesh's sphere away."""
    light = fr.Light(-50.0, 42.0, 3.5, radius=radius, shadow=True)
    if distance is None:
        return light
    return replace(light, position=tuple(mesh.center + distance * mesh.radius * light.direction))


def meshes() -> dict[str, fr.Mesh]:
    own = {"built-in head": fr.load_mesh()}
    if folder := scan_folder():
        own["scan"] = load_scan(folder)
    return own


def error_table(renderer: fr.Renderer) -> str:
    rows = []
    for name, mesh in meshes().items():
        scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.6))
        for distance in (None, 2.5):
            for radius in RADII if distance is None else RADII[:-1]:
                light = key(mesh, radius, distance)
                lost = shadow_error(renderer, scene, light, 64 if radius else 1)
                shares = lost.shadowed, lost.without, lost.mean, lost.wrong
                kind = "distant" if distance is None else f"point, {distance:g} radii away"
                cells = [name, kind, f"{radius:g}", *(f"{100.0 * each:.2f} %" for each in shares)]
                rows.append(cells)
    return markdown_table(HEAD, rows)


def cost_table() -> str:
    mesh = fr.load_mesh()
    rows = []
    for name, radius in (("light without size", 0.0), ("radius 5", 5.0)):
        light = key(mesh, radius)
        scenes = [
            fr.Scene(mesh, fr.Camera(-20.0), (each,))
            for each in (light, replace(light, shadow=False))
        ]
        cells = [name]
        for samples in (1, 4):
            with fr.Renderer(samples=samples) as renderer:
                draws = [lambda at=each: renderer.render(at) for each in scenes]
                cells.append(f"{ratio(*draws, repeats=9).value:.2f}")
        rows.append(cells)
    return markdown_table(COST_HEAD, rows)


def picture(size: int = 440) -> None:
    """Write the head without shadows, with hard ones and with soft ones."""
    mesh = fr.load_mesh()
    lights = fr.Scene(mesh).lights
    images = []
    with fr.Renderer((size, size)) as renderer:
        for shadow, radius in ((False, 0.0), (True, 0.0), (True, 5.0)):
            own = tuple(replace(each, shadow=shadow, radius=radius) for each in lights)
            scene = fr.Scene(mesh, fr.Camera(-20.0, zoom=1.35), own)
            images.append(renderer.render(scene).srgb8()[..., :3])
    Image.fromarray(np.concatenate(images, axis=1)).save(PICTURE, quality=88)


def occlusion_table(renderer: fr.Renderer) -> str:
    rows = []
    for name, mesh in meshes().items():
        bare = mesh.with_material(occlusion_map=None)
        light = replace(key(bare, 0.0), shadow=False)
        scene = fr.Scene(bare, fr.Camera(-20.0, zoom=1.6), (light,))
        found = occlusion_error(renderer, scene)
        baked = replace(scene, mesh=fr.with_occlusion(bare))
        ratios = []
        for samples in (1, 4):
            with fr.Renderer(samples=samples) as drawing:
                draws = [lambda at=each, by=drawing: by.render(at) for each in (baked, scene)]
                ratios.append(f"{ratio(*draws, repeats=21).value:.2f}")
        vertices = sum(len(part.positions) for part in bare.parts)
        errors = f"{found.without:.3f}", f"{found.baked:.3f}"
        rows.append([name, f"{vertices:,}", f"{found.seconds:.1f} s", *errors, *ratios])
    return markdown_table(OCCLUSION_HEAD, rows)


def occlusion_picture(size: int = 440) -> None:
    """Write the last mesh in ambient light and in that of a scene, without occlusion and with."""
    *_, mesh = meshes().values()
    bare = mesh.with_material(occlusion_map=None)
    images = []
    with fr.Renderer((size, size)) as renderer:
        for ambient in (True, False):
            for each in (bare, fr.with_occlusion(bare)):
                scene = fr.Scene(each, fr.Camera(-20.0, zoom=1.6))
                scene = replace(scene, lights=(), ambient=3.0) if ambient else scene
                images.append(renderer.render(scene).srgb8()[..., :3])
    Image.fromarray(np.concatenate(images, axis=1)).save(OCCLUSION_PICTURE, quality=88)


if __name__ == "__main__":
    main()
