"""Changed renders that test every check of the comparison: broken ones, whose cause it must name,
and harmless ones. The tests and the table of docs/measurements/comparison.md use both lists."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

import facerender as fr
from tests.verification.lights import PLAIN_THREE
from tests.verification.pairs.changes import (
    CHANGES,
    SOFTPIPE,
    Against,
    Change,
    grain,
    moved,
    patched,
)
from tests.verification.pairs.room import Linear, Room
from tests.verification.pairs.scenes import Setting

Pixels = NDArray[np.float32] | NDArray[np.uint8]
Images = tuple[Pixels, Pixels]
Make = Callable[[Room], Linear | Against | None]

SIZE = 512
CAMERAS = {"front": fr.Camera(), "three-quarter": fr.Camera(-35.0)}
DRIVERS = {name: SOFTPIPE | {"GALLIUM_DRIVER": name} for name in ("llvmpipe", "softpipe")}


def setting_of(mesh: str, camera: str, samples: int = 1, size: int = SIZE) -> Setting:
    """Return a setting of the built-in "head" or the "scan" with the default lights, without
    shadows."""
    name, at, target = f"{mesh}-{camera}", CAMERAS[camera], None
    if mesh == "scan":  # the tables hold for any result of the face finder
        at, target = replace(at, frame="all", zoom=1.595104), (-0.0157635, 0.2735361, 0.0537355)
    return Setting(name, "tune", mesh, size, samples, at, PLAIN_THREE, target, float_albedo=True)


def images(make: Make) -> Callable[[Room], Images]:
    """Return a function that draws the golden and the image of a change."""

    def draw(room: Room) -> Images:
        made = make(room)
        assert made is not None
        return (made.golden, made.image) if isinstance(made, Against) else (room.golden, made)

    return draw


def rougher(m: float = 0.306) -> Make:
    """Return a change whose golden has m = 0.3 everywhere and whose image has another m."""

    def make(room: Room) -> Against:
        golden, image = (room.with_material(m=each) for each in (0.3, m))
        return Against("golden-m", golden, image, room.renderer.samples)

    return make


def rounding(room: Room) -> Images:
    """Return an 8-bit image, and a copy whose values differ by at most one level at random."""
    a = room.frame(room.golden).srgb8()
    steps = np.random.default_rng(1).integers(-1, 2, a.shape)
    return a, np.clip(a + steps, 0, 255).astype(np.uint8)


_SUITE = (
    *("ks -3 %", "no masking", "D16 not clamped", "2 black pixels", "3 fireflies"),
    *("12 false highlights at the silhouette", "green of the normals inverted"),
    *("albedo decoded twice", "exposure +2 %"),
)
_POWER = "* sec2 * (masked.x * inverse)"
BROKEN = {
    **{name: images(cast(Change, CHANGES[name]).make) for name in _SUITE},
    "m 0.300 to 0.306": images(rougher()),
    "no 1/c^4 in the lobe": images(patched(_POWER, _POWER.replace("*", "/", 1))),
}
HARMLESS = {
    "8 bits, 1 step of rounding": rounding,
    "noise of 5e-4": images(grain(5e-4)),
    "camera moved by 0.05 pixels": images(moved(0.05, 0.05)),
}
