"""Writes docs/skin-environment.md: light from all around, what it is for, and how far few samples
of it are from many, and its pictures.

python -m tests.verification.environment -o docs/measurements/environment.json
python -m tools.docs.skin_environment

The second takes half a minute; both need an OpenGL context, the first one the head scan of the
tests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import facerender as fr
from facerender.measure.tables import markdown_table
from facerender.scenes.environment import studio
from tests.verification.environment import COUNTS, sky

HERE = Path(__file__).parents[2] / "docs"
OUTPUT = HERE / "skin-environment.md"
MEASUREMENT = HERE / "measurements" / "environment.json"
PICTURE = HERE / "environment.jpg"

PAGE = """# Skin: light from all around

Written by `python -m tools.docs.skin_environment` from
[measurements/environment.json](measurements/environment.json), which `python -m tests.verification.environment`
measured, on {GL_RENDERER}, OpenGL
{GL_VERSION}. A scene without an environment is drawn by the same program as before.

**What it is for.** Lamps light a face from a few directions, and one ambient term fills the rest
with the same grey from everywhere. In a room or under the sky light comes from all sides, in other
colours and strengths: windows show as broad sheens on the forehead, the ground brightens the chin,
and the rim of a head takes the colour of what stands behind it. A panorama of radiance has all of
that.

![the usual lights, the studio, a sky with its sun](environment.jpg)

Left the usual lights, middle the built-in studio, right a sky with a sun; below the specular part
alone, four times as bright.

| | command line | Python, scene file |
|---|---|---|
| a panorama | `--environment FILE[,ROTATION[,SCALE]]` | `fr.EnvironmentFile(file, 30.0, 0.5)` |
| one made by code | `--environment studio` | `fr.EnvironmentFile("studio")` |
| directions of a lobe | `--environment-samples N` (32) | `fr.Shading(environment_samples=32)` |

```python
environment = fr.load_environment(fr.EnvironmentFile("room.hdr", rotation=30.0, scale=0.5))
scene = fr.Scene(fr.load_mesh(), lights=(), ambient=0.0, environment=environment)

panorama = fr.Panorama("mine", radiance)  # (H, 2 H, 3) float32
scene = fr.Scene(fr.load_mesh(), environment=fr.Environment(panorama))
```

In a scene file it is `environment = "room.hdr,30,0.5"`, or a table `[environment]` with `file`,
`rotation` and `scale`. Files are .hdr (the extra `hdr`: OpenImageIO), .exr (the extra `exr`), .npy
and .npz, twice as wide as high: a sphere as latitude and longitude, its top row above, its middle
column what the face sees before it, as it sees it. The rotation, in degrees, adds to azimuths: a
lamp in the middle of the panorama stands at the azimuth of the rotation. A radiance of 1 from
everywhere shows a white diffuse surface as 1. On the command line an environment takes the place of
the usual lights and of the ambient light, unless `--light`, `--ambient` or the scene file give
some; in Python a scene has what it is given. The background stays as it is.

Diffuse light comes from nine coefficients, times the occlusion map; with `--diffuse coupled` it is
what the specular term leaves, as of ambient light. The specular part is the mean of N directions,
each for every lobe of the material: half vectors on a spiral of Beckmann slopes, both sides of each
cavity, and of each the radiance around its direction, from a level of the map whose texels are as
large as what the direction stands for. The directions are the same at every pixel, in the frame of
normal and eye, so that nothing flickers or is grainy. It has the Fresnel and the masking term that
the lights have, and always the exact lobe: there is nothing that an approximation would save. It
is not shadowed: the inside of a nostril is as bright as its occlusion map says, and reflects what
is behind the head. A model without such a term of its own (`ward-printed`) is refused until
`--environment-samples 0` leaves the specular part out.

## How near it is

Diffuse, against the whole panorama, over {directions} directions, as shares of the mean irradiance:

{diffuse}

Specular, on the built-in head and the scan (Lee Perry-Smith, Infinite-Realities, CC BY 3.0), 192
pixels, at several slopes, against 4096 samples: the mean error over the mean of the whole image;
for 32 samples also over the mean of the specular part, how much energy is too much, and the 99th
percentile of what is displayed. Worst of 32: {worst} of all light.

{samples}

Every covered pixel agrees with float64 on the same G-buffer within 1e-4 of the larger of it and
0.01; the largest difference here was {float64}. Nothing depends on a driver's texture filter: the
map is octahedral, its levels lie side by side in one float texture, and the shader interpolates
between eight texels itself. So it also runs where float textures cannot be filtered, as in
WebGL 2.

**Plans.** The number of samples is a decision of `facerender plan`: 0, 8, 16 or 32. The AMD
compiler counts {sample} cycles for a sample of a lobe on RDNA2, {base} for the coefficients. A
guarantee over all views refuses whatever changes the environment's light.

## What was left out

- The split sum (a blurred map times an albedo) errs by 12 to 33 % of the specular part for Beckmann
  slopes with V-cavities, where 32 samples err by {low} to {high}: the lobe is neither round nor
  where the mirror's direction is.
- Noise: another turn of the directions at each pixel hides what 8 samples leave, and leaves grain
  that several samples a pixel do not smooth, for a pixel is shaded once.
- Shadows of the environment: an occlusion map, or what `--occlusion` bakes where there is none,
  darkens the diffuse part alone.
"""


def percent(value: float, sign: str = "", digits: int = 1) -> str:
    return f"{100.0 * value:{sign}.{digits}f} %"


def page(measured: dict[str, Any]) -> str:
    """Return docs/skin-environment.md."""
    diffuse = [
        [name, *(percent(error) for error in errors.values())]
        for name, errors in measured["diffuse"].items()
    ]
    rows, at_32 = [], []
    for each in measured["samples"]:
        lost = each["lost"]
        at_32.append(lost["32"])
        rows.append(
            [
                *(each["mesh"], each["environment"], f"{each['m']:g}"),
                *(percent(lost[str(count)]["of_all"], digits=2) for count in COUNTS),
                percent(at_32[-1]["of_specular"]),
                percent(at_32[-1]["energy"], "+"),
                f"{at_32[-1]['displayed']:g}/255",
            ]
        )
    head = ["mesh", "environment", "m", *(f"{count} samples" for count in COUNTS)]
    of_specular = [each["of_specular"] for each in at_32]
    return PAGE.format(
        diffuse=markdown_table(["environment", "mean", "largest"], diffuse),
        samples=markdown_table([*head, "of the specular part", "energy", "p99"], rows),
        worst=percent(max(each["of_all"] for each in at_32), digits=2),
        low=percent(min(of_specular)),
        high=percent(max(of_specular)),
        float64=f"{measured['float64']:.1e}",
        directions=400,
        **measured["cycles"],
        **measured["environment"],
    )


def picture(size: int = 420) -> None:
    """Write the head under the usual lights, in the studio and under the sky, and the specular
    part of each."""
    head, camera = fr.load_mesh(), fr.Camera(azimuth=-35.0, zoom=1.3)
    scenes = [
        fr.Scene(head, camera),
        *(
            fr.Scene(head, camera, (), 0.0, environment=fr.Environment(panorama, 0.0, scale))
            for panorama, scale in ((studio(), 1.0), (sky(), 0.9))
        ),
    ]
    with fr.Renderer((size, size)) as renderer:
        whole = [renderer.render(scene).srgb8() for scene in scenes]
        shine = [renderer.render(scene, only="specular").srgb8(2.0)[..., :3] for scene in scenes]
    image = np.vstack([np.hstack(whole), np.hstack(shine)])
    Image.fromarray(image).save(PICTURE, quality=86)


def committed() -> str:
    return page(json.loads(MEASUREMENT.read_text(encoding="utf-8")))


def stale() -> Iterator[str]:
    """Tell whether the document is another."""
    if OUTPUT.read_text(encoding="utf-8") != committed():
        yield "not what its measurement says"


def main() -> None:
    OUTPUT.write_text(committed(), encoding="utf-8")
    picture()


if __name__ == "__main__":
    main()
