"""Measure how often the comparison's first reason names the cause of a change.

python -m benchmarks.causes

Renders pairs of images whose cause of change is known, without metadata, and compares the first
reason with the cause. The rules in ``facerender/comparison/compare.py`` were chosen on the half
"tune". The half "report" adds cameras of the built-in head. Writes docs/measurements/causes.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from typing import cast

import numpy as np
from PIL import Image

import facerender as fr
from benchmarks.data import save
from facerender.comparison.causes import (
    CODEC,
    DRIVER,
    EXPOSURE,
    GEOMETRY,
    LIGHT,
    LOBE,
    TEXTURE,
    cause_of,
    strips,
)
from facerender.comparison.causes import Change as Changed
from facerender.comparison.compare import compare
from facerender.images.image import ImageData, image_from_array
from facerender.mesh.simplify import simplified
from tests.meshes import with_geometry
from tests.verification.pairs.changes import (
    CHANGES,
    Against,
    Bytes,
    Change,
    exposed,
    factor,
    has,
    moved,
    slope,
    turned,
)
from tests.verification.pairs.room import Linear, Room
from tests.verification.pairs.scenes import SETTINGS, Setting

SIZE = 512  # largest width and height of the images
OTHER_CAMERAS = (
    Setting(
        *("head-left", "report", "head", 384, 1, fr.Camera(38.0, 12.0, zoom=1.4)),
        lights=(fr.Light(10.0, 55.0, (2.6, 2.7, 3.0), shadow=False),),
        material={"m": 0.25},
        background=None,
    ),
    Setting(
        *("head-below", "report", "head", 512, 4, fr.Camera(-62.0, -18.0)),
        lights=(
            fr.Light(-95.0, 12.0, (2.9, 2.7, 2.4), shadow=True),
            fr.Light(20.0, 30.0, 0.8, shadow=False),
        ),
        material={"m": 0.35},
        background=(0.05, 0.05, 0.05),
    ),
)

Make = Callable[[Room], Linear | Against | None]


@dataclass(frozen=True)
class Pixels:
    """A change of the pixels of an 8-bit image (H, W, 3 or 4)."""

    make: Callable[[Bytes], Bytes]


def known(name: str) -> Make:
    """Return a change of the suite of pairs."""
    return cast(Change, CHANGES[name]).make


def tilted(degrees: float) -> Make:
    """Raise the first light."""

    def make(room: Room) -> Linear | None:
        first, *others = room.scene.lights
        if first.position is not None:
            return None
        return room.draw(lights=(replace(first, elevation=first.elevation + degrees), *others))

    return make


def camera(**by: float) -> Make:
    """Add numbers to fields of the camera."""

    def make(room: Room) -> Linear:
        own = room.scene.camera
        return room.draw(camera=replace(own, **{key: getattr(own, key) + by[key] for key in by}))

    return make


def flatter(room: Room) -> Linear | None:
    """Multiply the strength of the normal map by 0.8."""
    return factor("normal_strength", 0.8)(room) if has(room, "normal_map") else None


def coarser(room: Room) -> Linear:
    """Simplify the mesh to a tenth of its triangles."""
    mesh = room.scene.mesh
    return room.draw(mesh=simplified(mesh, sum(len(part.faces) for part in mesh.parts) // 10))


def bent(room: Room) -> Linear:
    """Pull the middle of the face forward by up to 3 % of the mesh's radius."""
    mesh = room.scene.mesh
    parts = []
    for part in mesh.parts:
        places = mesh.normalised(part.positions)
        near = np.exp(-((places[:, :2] / 0.35) ** 2).sum(axis=1))
        places[:, 2] += 0.03 * near * (places[:, 2] > 0.0)
        parts.append(replace(part, positions=np.ascontiguousarray(mesh.to_mesh_space(places))))
    return room.draw(mesh=with_geometry(mesh, parts=tuple(parts)), view=room.view)


def other_samples(room: Room) -> Against:
    """Compare 1 with 4 samples per pixel."""
    return Against("golden-1", room.draw(samples=1), room.draw(samples=4), 4)


def jpeg(quality: int) -> Pixels:
    def make(pixels: Bytes) -> Bytes:
        Image.fromarray(pixels[..., :3]).save(file := BytesIO(), "JPEG", quality=quality)
        out = pixels.copy()
        out[..., :3] = np.asarray(Image.open(file))
        return out

    return Pixels(make)


def dithered(by: int) -> Pixels:
    """Add noise of up to ``by`` levels."""

    def make(pixels: Bytes) -> Bytes:
        noise = np.random.default_rng(1).integers(-by, by + 1, (*pixels.shape[:2], 3))
        out = pixels.copy()
        out[..., :3] = np.clip(pixels[..., :3] + noise, 0, 255)
        return out

    return Pixels(make)


def fewer(levels: int) -> Pixels:
    """Round the colours to ``levels`` values."""

    def make(pixels: Bytes) -> Bytes:
        out = pixels.copy()
        step = 255.0 / (levels - 1)
        out[..., :3] = np.round(np.round(pixels[..., :3] / step) * step)
        return out

    return Pixels(make)


def gamma(power: float) -> Pixels:
    """Encode with a power instead of sRGB."""

    def make(pixels: Bytes) -> Bytes:
        x = pixels[..., :3] / 255.0
        linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
        out = pixels.copy()
        out[..., :3] = np.round(255.0 * linear ** (1.0 / power))
        return out

    return Pixels(make)


CAUSES: Mapping[str, Mapping[str, Make | Pixels]] = {
    "lobe": {
        "m +10 %": slope(1.1),
        "m -3 %": slope(0.97),
        "ks -3 %": known("ks -3 %"),
        "f0 0.028 to 0.04": known("f0 0.028 to 0.04"),
        "D8 in place of exact": known("D8 in place of exact"),
        "ks +20 %": factor("ks", 1.2),
    },
    "light": {
        "turned by 0.5 degrees": turned(0.5),
        "turned by 2 degrees": turned(2.0),
        "turned by 10 degrees": turned(10.0),
        "raised by 3 degrees": tilted(3.0),
        "shadow left out": known("shadow left out"),
    },
    "exposure": {
        "+1 %": exposed(1.01),
        "-2 %": exposed(0.98),
        "+10 %": exposed(1.1),
        "+50 %": exposed(1.5),
    },
    "texture": {
        "green of the normals inverted": known("green of the normals inverted"),
        "normal map's strength 0.8": lambda room: (
            factor("normal_strength", 0.8)(room)
            if room.scene.mesh.materials[0].normal_map
            else None
        ),
        "albedo's red +2 %": known("albedo's red +2 %"),
        "albedo blurred": known("albedo blurred"),
        "albedo decoded twice": known("albedo decoded twice"),
        "grain in the normals": known("grain in the normals"),
    },
    "geometry": {
        "20 triangles missing": known("20 triangles missing"),
        "camera moved by 0.5 pixels": moved(0.4, 0.3),
        "camera moved by 3 pixels": moved(-2.0, 2.2),
        "camera turned by 1 degree": camera(azimuth=1.0),
        "a tenth of the triangles": coarser,
        "face pulled forward": bent,
    },
    "driver": {
        "softpipe": known("softpipe"),
        "mean of other samples": known("mean of other samples"),
        "samples mirrored": known("samples mirrored"),
        "sample moved by 0.1 pixels": known("sample moved by 0.1 pixels"),
        "vertices snapped": known("vertices snapped"),
        "4 samples instead of 1": other_samples,
    },
    "codec": {
        "JPEG, quality 95": jpeg(95),
        "JPEG, quality 75": jpeg(75),
        "dither of 2 steps": dithered(2),
        "64 levels": fewer(64),
        "gamma 2.2": gamma(2.2),
        "r11g11b10": known("r11g11b10"),
    },
    "pixels": {
        "2 black pixels": known("2 black pixels"),
        "3 fireflies": known("3 fireflies"),
        "12 false highlights at the silhouette": known("12 false highlights at the silhouette"),
        "D16 not clamped": known("D16 not clamped"),
    },
}


NAMES = {  # words of a reason: cause
    **{LOBE: "lobe", LIGHT: "light", EXPOSURE: "exposure", TEXTURE: "texture"},
    **{GEOMETRY: "geometry", DRIVER: "driver", CODEC: "codec"},
    **dict.fromkeys(("fireflies", "missing pixels", "false highlights"), "pixels"),
}


def settings(half: str) -> list[Setting]:
    """Return the scenes of a half, with smaller images."""
    return [
        replace(each, size=min(each.size, SIZE))
        for each in (*SETTINGS.values(), *OTHER_CAMERAS)
        if each.group == half
    ]


def pair(room: Room, make: Make | Pixels, png: bool) -> tuple[ImageData, ImageData] | None:
    """Return the images of a change, without metadata; None if the change does not apply.

    png : whether the images have 8 bits, if the change does not require a format
    """
    images: tuple[Linear | Bytes, Linear | Bytes]
    if isinstance(make, Pixels):
        golden = room.frame(room.golden).srgb8()
        images = golden, make.make(golden)
    else:
        made = make(room)
        if made is None:
            return None
        if not isinstance(made, Against):
            made = Against("golden", room.golden, made, room.setting.samples)
        images = made.golden, made.image
        if png:
            images = room.frame(made.golden).srgb8(), room.frame(made.image).srgb8()
    if np.array_equal(*images):
        return None
    return image_from_array(images[0], "A"), image_from_array(images[1], "B")


def named(a: ImageData, b: ImageData) -> str:
    """Return the cause that the first reason names; of a pair that passes, the likely cause."""
    result = compare(a, b)
    if result.same:
        height, width = a.pixels.shape[:2]
        return NAMES[cause_of(Changed.between(a, b, strips(height, width)))]
    return NAMES[result.reasons[0].split("perhaps ")[1].split(" (")[0]]


def rows(half: str) -> Iterator[dict[str, str]]:
    """Yield scene, change, cause and named cause of each pair of a half, half of them 8-bit."""
    number = 0
    for setting in settings(half):
        room = Room(setting)
        for cause, changes in CAUSES.items():
            for change, make in changes.items():
                number += 1
                if images := pair(room, make, number % 2 == 0):
                    about = {"half": half, "scene": setting.name, "change": change}
                    yield {**about, "cause": cause, "named": named(*images)}
        room.renderer.release()


def main() -> None:
    found = [row for half in ("tune", "report") for row in rows(half)]
    save("causes", pairs=found)
    for half in ("tune", "report"):
        own = [row for row in found if row["half"] == half]
        print(half, sum(row["named"] == row["cause"] for row in own), "of", len(own))


if __name__ == "__main__":
    main()
