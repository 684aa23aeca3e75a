"""Writes docs/skin.md: what a face requires, what each part of it is for, and how far it is from
what many samples give, and its pictures.

python -m tests.verification.skin -o docs/measurements/skin.json && python -m tools.docs.skin

The second takes a minute; both need an OpenGL context, the extra measure, and the head scan of the
tests.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import facerender as fr
from facerender.images.srgb import encode_srgb8
from facerender.measure.tables import markdown_table
from tests.verification.skin import Subjects, subjects
from tests.verification.slope_filter import Bench, relief

HERE = Path(__file__).parents[2] / "docs"
OUTPUT = HERE / "skin.md"
MEASUREMENT = HERE / "measurements" / "skin.json"
PICTURE = HERE / "slope-filter.jpg"

PAGE = """# Skin: what a face requires

Written by `python -m tools.docs.skin` from [measurements/skin.json](measurements/skin.json), which
`python -m tests.verification.skin` measured, on {GL_RENDERER}, OpenGL
{GL_VERSION}. Each part here is off where a scene does not need it, and then costs nothing.

Others have pages of their own: [shadows](skin-shadows.md), [two lobes, sampling, coupled diffuse
light](skin-lobes.md), [light below the skin](skin-scattering.md), [light from all
around](skin-environment.md); and one tells [what all of it costs together](skin-together.md).

## Slope variance

**What it is for.** Pores are smaller than a pixel unless the face fills the frame. Where a pixel
holds many of them, the eye sees no pore: it sees a softer, broader sheen. A renderer that looks at
one point of the normal map a pixel shows either sparkle that crawls when the head turns, or a
forehead as smooth as plastic with a highlight that is too sharp. The slope filter turns the pores
that a pixel cannot show into roughness, so that a small portrait has the same sheen as a large one
made smaller. A softbox is not a point either: `radius` gives a light its size, and broadens the
highlight as the light would, without noise and without further samples.

![without the filter, with it, 256 samples of the unfiltered map](slope-filter.jpg)

Left without, middle with the filter, right 256 samples a pixel of the unfiltered map; above the
built-in head with its relief three times as steep, below the scan with three times its pores; m
0.15, 192 pixels, specular light alone.

| | command line | Python, scene file |
|---|---|---|
| normal map | `--slope-filter`, `--no-slope-filter` (on) | `fr.Shading(slope_filter=True)` |
| curvature of the mesh | `--curvature` (off) | `fr.Shading(curvature=False)` |
| size of a light | `--light key,radius=5` | `fr.Light(radius=5.0)` |

The filter is on wherever there is a normal map. Curvature is for heads below about 128 pixels,
where the nose or an ear is a few pixels wide; the AMD compiler counts a fifth more cycles for it. A
radius is the angle between the light's centre and its rim, in degrees, as seen from the head: the
sun has 0.27, a softbox of 1 m at 2 m has 14. Above 20 it is refused: the formula is not good enough
there. A point light has its radius as seen from the mesh's centre, and the nearer a place is, the
larger it sees it.

All of it widens the rms slope m of the material: Beckmann's slopes have variance m^2/2 along each
axis, and variances add. So every lobe, model and light has it, the G-buffer holds the widened m
(`gbuffer.m`), and float64 shading of it agrees within 1e-4 as before. A term with an m of its own
(`fr.Shading(m=0.3)`, a plan's constant slope) is not widened: it says what it is. Lobes have
domains, and m with all that may widen it must lie within: with a normal map 0.6 becomes up to 0.7.
`--outside exact` and `--no-slope-filter` are the ways out.

**Plans.** The filter is no decision of `facerender plan`: it costs 1.03 of the fragment on RDNA2,
and no further fetch. The full image that a plan's error is measured against is the filtered one.

### How near it is

The highlight (pixels above a quarter of its 99.5th percentile) of a head under one light, against
256 samples a pixel of the finest level of the map. Energy is the highlight's sum over that of the
reference, less 1; L1 the mean difference over the mean; FLIP the mean over the head; each beside
its share of what it is without the filter. Anisotropy is 1, curvature off. Worst of them: energy
{energy}, L1 {l1} of without, FLIP {flip} of without.

L1 stays above 0.75 of what it is without at 512 pixels, and at 256 with m 0.4, where the relief is
nearly resolved and little is lost either way. What is left there is the blur of isotropic texture
filtering.

{filtered}

The built-in head has the relief of its own normal map, the scan (Lee Perry-Smith,
Infinite-Realities, CC BY 3.0) its tangent map with the band above it from its displacement; x3 is
three times as steep.

A map's variance counts by half. Relief is mostly flat with a few steep walls, and a normal
distribution of its whole variance has too low a peak: counted in full it leaves out 18 to 22 % of
the highlight at x3 and m 0.15, counted by half 7 % at most. Relief that is normal noise, which skin
is not, then keeps 8 % too much.

Flicker, of the highlight at m 0.15 and 128 pixels when the camera turns by 0.15 degrees, eight
times: how much more the pixels deviate than those of the reference, over their mean. Of the scan's
own pores most of it comes from the curvature of the mesh.

{flicker}

Light of a disc on a sphere, mean error of the specular light over its mean, in float64, against 600
points of the disc:

{discs}

With the light behind the head (beyond 110 degrees) errors grow: 17 % at 130 degrees and a radius of
10.

### In your own program

```
facerender shaders prepare-normal-map normal.png normal.ktx2
```

writes KTX 2.0, RGBA with 8 bits, with every mip level: red, green and blue are the mean normal of
the texels that a texel stands for, at unit length; alpha is sqrt((1 - |N|)/|N|)/0.35, |N| the
length of that mean, cut off at 1, and 0 at the finest level. It is made in float32 of unit vectors,
which is why `glGenerateMipmap` cannot make it. Rows go from the image's top down. Load it as it is,
linear (not sRGB), with trilinear filtering; block compression takes away what alpha has to say. In
the shader

```glsl
#include "facerender/slope_variance.glsl"
#include "facerender/cook_torrance.glsl"

vec4 texel = texture(normal_map, uv);
vec3 n = normalize(frame * (texel.xyz * 2.0 - 1.0));
float variance = fr_slope_variance_map(texel.a);
variance += fr_slope_variance_pixel(dFdx(mesh_normal), dFdy(mesh_normal));  // if you want it
float m = fr_slope_filtered(material_m, variance);

// a light of a radius R: s = sin(R), k = 0.5 + 0.5 * cos(R)
float wide = fr_slope_filtered(m, fr_slope_variance_disc(s, k, 0.5 * length(l + v)));
vec3 specular = fr_cook_torrance(n, l, v, wide, f0) * irradiance * max(dot(n, l), 0.0);
vec3 diffuse = albedo / FR_PI * irradiance * fr_cosine_disc(dot(n, l), s, k);
```

In Python, `fr.Texture.open("normal.png").levels("normal").result()` is the list of levels, the
finest first.

### What was left out

- Linearly transformed cosines: a fit to Beckmann errs by 21 to 37 % (m 0.2 to 0.3), more than slope
  variance does up to 20 degrees, and needs two tables.
- Slopes with two variances and a direction (LEAN mapping): with anisotropic texture filtering they
  gain nothing, and they take a second map.
- Derivatives of the mapped normal (Tokuyoshi and Kaplanyan 2019): they see the pixels that are
  drawn, not the texels between.
"""


def percent(value: float, sign: str = "") -> str:
    return f"{100.0 * value:{sign}.1f} %"


def page(measured: dict[str, Any]) -> str:
    """Return docs/skin.md."""
    rows, energies, l1s, flips = [], [], [], []
    for each in measured["filtered"]:
        none, own = (each["lost"][name] for name in ("none", "filter"))
        energies.append(own["energy"])
        l1s.append(own["l1"] / none["l1"])
        flips.append(own["flip"] / none["flip"])
        rows.append(
            [
                *(each["relief"], str(each["size"]), f"{each['m']:g}"),
                *(percent(none["energy"], "+"), percent(own["energy"], "+")),
                *(percent(own["l1"]), f"{l1s[-1]:.2f}", f"{own['flip']:.4f}", f"{flips[-1]:.2f}"),
            ]
        )
    head = ("relief", "image", "m", "energy without", "energy", "L1", "of without", "FLIP")
    shaken = [
        [each["relief"], *(f"{value:.4f}" for value in each["beyond"].values())]
        for each in measured["flicker"]
    ]
    discs = [
        [f"{each['angle']:g}", f"{each['radius']:g}", f"{each['m']:g}"]
        + [percent(each[name]) for name in ("without", "with")]
        for each in measured["discs"]
    ]
    return PAGE.format(
        filtered=markdown_table([*head, "of without"], rows),
        flicker=markdown_table(["relief", "without", "slope filter", "with curvature"], shaken),
        discs=markdown_table(["light from the eye", "radius", "m", "no size", "disc"], discs),
        energy=f"{percent(min(energies), '+')} to {percent(max(energies), '+')}",
        l1=f"{max(l1s):.2f}",
        flip=f"{max(flips):.2f}",
        **measured["environment"],
    )


def picture(given: Subjects, size: int = 192) -> None:
    """Write head and scan without the filter, with it, and as the reference."""
    lines = []
    for mesh, slopes in given.values():
        bench = Bench.of(mesh, relief(slopes, 3.0), 0.15, size)
        bench = replace(bench, camera=fr.Camera(-20.0, zoom=1.5))
        with fr.Renderer((2 * size,) * 2) as renderer:
            expected = bench.reference(renderer)
        with fr.Renderer((size, size)) as renderer:
            shadings = fr.Shading(slope_filter=False), fr.Shading()
            images = [bench.image(renderer, shading) for shading in shadings]
        shown = [encode_srgb8(each[..., :3].astype(np.float32)) for each in (*images, expected)]
        lines.append(np.concatenate(shown, axis=1))
    whole = np.concatenate(lines).repeat(2, axis=0).repeat(2, axis=1)
    Image.fromarray(whole).save(PICTURE, quality=88)


def committed() -> str:
    return page(json.loads(MEASUREMENT.read_text(encoding="utf-8")))


def stale() -> Iterator[str]:
    """Tell whether the document is another."""
    if OUTPUT.read_text(encoding="utf-8") != committed():
        yield "not what its measurement says"


def main() -> None:
    OUTPUT.write_text(committed(), encoding="utf-8")
    picture(subjects())


if __name__ == "__main__":
    main()
