"""Writes docs/skin-shadows.md and its picture: what shadows are for, how far they are from rays,
what they cost.

python -m docs.skin_shadows   a few minutes; needs an OpenGL context, embreex, and the head scan of
                              the tests
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import facerender as fr
from docs.template import missing
from facerender.measure.tables import markdown_table
from facerender.pricing.frame import ratio
from trials.scan import load_scan, scan_folder
from trials.shadows import shadow_error

HERE = Path(__file__).parent
OUTPUT = HERE / "skin-shadows.md"
PICTURE = HERE / "shadows.jpg"

RADII = (0.0, 0.25, 2.0, 6.0, 15.0)
HEAD = ("mesh", "light", "radius", "in shadow", "without shadows", "mean error", "wrong by half")
COST_HEAD = ("a frame of 1024 x 1024", "1 sample", "4 samples")

PAGE = """# Skin: shadows

Written by `python -m docs.skin_shadows`, on {GL_RENDERER}, OpenGL
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
"""


def main() -> None:
    with fr.Renderer((512, 512), samples=1) as renderer:
        facts = dict(renderer.metadata)
        errors = error_table(renderer)
    text = PAGE.format(errors=errors, cost=cost_table(), shading=SHADING, **facts)
    OUTPUT.write_text(text, encoding="utf-8")
    picture()
    print(text)


SHADING = """The image itself differs from float64 shading of the
same G-buffer, which holds the visibility, by less than 1e-4 (`pytest tests/test_shadows.py`)."""


def stale() -> Iterator[str]:
    """Yield what the document lacks."""
    yield from missing(OUTPUT, PAGE, (HEAD, COST_HEAD))


def key(mesh: fr.Mesh, radius: float, distance: float | None = None) -> fr.Light:
    """A light high on the left: distant, or so many radii of the mesh's sphere away."""
    light = fr.Light(-50.0, 42.0, 3.5, radius=radius, shadow=True)
    if distance is None:
        return light
    return replace(light, position=tuple(mesh.center + distance * mesh.radius * light.direction))


def error_table(renderer: fr.Renderer) -> str:
    meshes = {"built-in head": fr.load_mesh()}
    if folder := scan_folder():
        meshes["scan"] = load_scan(folder)
    rows = []
    for name, mesh in meshes.items():
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


if __name__ == "__main__":
    main()
