"""The scenes of the pairs. The groups share no head, camera or light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

import facerender as fr
from facerender.scene.environment import studio
from facerender.values.vectors import Vector
from tests.verification.pairs.heads import JUDGED, makehuman_folder
from tests.verification.parts_head import parts_head
from tests.verification.scan import load_scan, scan_folder

Group = Literal["tune", "report", "judge"]

MINI_HEAD = Path(__file__).parents[3] / "tests" / "data" / "mini_head.glb"


@dataclass(frozen=True)
class Setting:
    """A scene, its size, samples and shading.

    Attributes
    ----------
    head : argument of :func:`head_of`
    target : of the camera, in the renderer's space; None keeps the target of ``camera``
    point : position, in the renderer's space, and irradiance of a point light after ``lights``
    material : fields to replace in every material of the head
    """

    name: str
    group: Group
    head: str
    size: int
    samples: int
    camera: fr.Camera
    lights: tuple[fr.Light, ...] = ()
    target: Vector | None = None
    point: tuple[Vector, Vector] | None = None
    material: Mapping[str, Any] = field(default_factory=dict)
    shading: fr.Shading = fr.Shading()
    ambient: Vector = (0.26, 0.28, 0.31)
    background: Vector | None = (0.012, 0.013, 0.016)
    environment: bool = False
    float_albedo: bool = False

    def scene(self) -> fr.Scene:
        """Return the scene with its mesh and lights."""
        mesh = head_of(self.head).with_material(**self.material)
        camera, lights = self.camera, self.lights
        if self.target is not None:
            camera = replace(camera, target=tuple(mesh.to_mesh_space(self.target).tolist()))
        if self.point is not None:
            position, irradiance = self.point
            place = tuple(mesh.to_mesh_space(position).tolist())
            lights = (*lights, fr.Light(irradiance=irradiance, position=place, shadow=False))
        around = fr.Environment(studio()) if self.environment else None
        return fr.Scene(mesh, camera, lights, self.ambient, self.background, around)


@cache
def head_of(name: str) -> fr.Mesh:
    """Return the mesh "head" (the skin of the built-in head), "parts", "mini", "scan", or a name in
    JUDGED."""
    if name in JUDGED:
        return JUDGED[name]()
    if name == "mini":
        return fr.load_mesh(MINI_HEAD).with_material(normal_map=wrinkles())
    if name == "scan":
        folder = scan_folder()
        assert folder is not None
        return load_scan(folder)
    return parts_head() if name == "parts" else fr.load_mesh().select("head")


def wrinkles(size: int = 512) -> fr.Texture:
    """Return a normal map of crossing waves and grain."""
    v, u = np.mgrid[:size, :size] * (2.0 * np.pi / size)
    grain = np.random.default_rng(1).normal(0.0, 0.06, (2, size, size))
    x = 0.12 * np.sin(23.0 * u + 3.0 * np.sin(4.0 * v)) + grain[0]
    y = 0.1 * np.sin(31.0 * v + 2.0 * np.sin(5.0 * u)) + grain[1]
    normals = np.stack([x, y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return fr.Texture.from_array(0.5 + 0.5 * normals, "wrinkles")


KEY = fr.Light(-50.0, 42.0, (3.6, 3.4, 3.1), shadow=False)
RIM = fr.Light(100.0, 33.0, (2.4, 2.5, 2.7), shadow=False)
FILL = fr.Light(50.0, 5.0, (0.34, 0.36, 0.4), shadow=False)

_SETTINGS = (
    Setting(
        *("head-front", "tune", "head", 512, 1, fr.Camera(), (KEY, RIM, FILL)),
        material={"roughness_factor": 0.9},
    ),
    Setting(
        *("head-three-quarter", "tune", "head", 1024, 4, fr.Camera(-35.0), (KEY,)),
        material={"m": 0.3},
        ambient=(0.05, 0.05, 0.06),
        background=None,
    ),
    Setting(
        *("head-profile", "tune", "head", 768, 1, fr.Camera(80.0, 4.0)),
        lights=(fr.Light(150.0, 25.0, 3.0, shadow=False), fr.Light(30.0, 20.0, 1.2, shadow=False)),
        material={"m": 0.2, "normal_map": None},
        shading=fr.Shading("ward"),
    ),
    Setting(
        *("head-mouth", "tune", "head", 512, 4, fr.Camera(12.0, -3.0, zoom=4.5)),
        target=(0.0, -0.33, 0.5),
        point=((-1.1, 1.2, 2.2), (3.0, 2.9, 2.8)),
        material={"m": 0.15},
        float_albedo=True,
    ),
    Setting(
        *("parts-eye", "tune", "parts", 384, 4, fr.Camera(-8.0, zoom=4.0), (KEY, FILL)),
        target=(0.18, 0.02, 0.42),
        material={"roughness_factor": 0.9},
    ),
    Setting(
        *("parts-above", "tune", "parts", 256, 1, fr.Camera(-20.0, 48.0)),
        lights=(fr.Light(-35.0, 55.0, 3.4, shadow=True),),
        material={"roughness_map": None},
        background=None,
    ),
    Setting(
        *("scan-front", "report", "scan", 512, 4, fr.Camera(6.0, 3.0, frame="all")),
        lights=(
            fr.Light(40.0, 35.0, (3.2, 3.0, 2.9), shadow=False),
            fr.Light(-120.0, 25.0, (2.2, 2.4, 2.6), shadow=False),
        ),
        material={"m": 0.25},
        background=None,
    ),
    Setting(
        *("scan-three-quarter", "report", "scan", 1024, 1, fr.Camera(42.0, -6.0, frame="all")),
        lights=(fr.Light(112.0, 34.0, 3.8, shadow=True), fr.Light(-20.0, 10.0, 0.9, shadow=False)),
        material={"m": 0.35},
        background=(0.2, 0.21, 0.24),
    ),
    Setting(
        *("scan-profile", "report", "scan", 768, 4, fr.Camera(-86.0, 8.0, frame="head")),
        lights=(
            fr.Light(-168.0, 24.0, (3.2, 3.3, 3.6), shadow=False),
            fr.Light(-45.0, 50.0, 1.4, shadow=False),
        ),
        material={"m": 0.3, "normal_map": None},
        shading=fr.Shading("ward"),
        ambient=(0.03, 0.03, 0.04),
        background=(0.0, 0.0, 0.0),
    ),
    Setting(
        *("scan-eye", "report", "scan", 384, 1, fr.Camera(-14.0, 5.0, zoom=4.0, frame="all")),
        target=(0.14, 0.3, 0.4),
        point=((0.9, 0.8, 2.4), (2.6, 2.6, 2.8)),
        material={"m": 0.12},
        float_albedo=True,
    ),
    Setting(
        *("mini-below", "report", "mini", 256, 4, fr.Camera(-24.0, -22.0)),
        lights=(fr.Light(20.0, 25.0, 1.5, shadow=False),),
        material={"m": 0.3},
        ambient=(0.0, 0.0, 0.0),
        environment=True,
    ),
    Setting(
        *("mini-above", "report", "mini", 512, 1, fr.Camera(25.0, 36.0)),
        lights=(fr.Light(5.0, 12.0, 2.0, shadow=False), fr.Light(-140.0, 30.0, 2.2, shadow=False)),
        material={"m": 0.5},
        background=None,
    ),
    Setting(
        *("haired-front", "judge", "haired", 384, 4, fr.Camera(-15.0, 5.0)),
        lights=(
            fr.Light(-32.0, 36.0, (3.0, 2.9, 2.7), radius=6.0),
            fr.Light(70.0, 15.0, 0.8, shadow=False),
        ),
    ),
    Setting(
        *("haired-side", "judge", "haired", 320, 1, fr.Camera(62.0, 10.0)),
        lights=(fr.Light(-130.0, 40.0, 1.6, shadow=False),),
        ambient=(0.0, 0.0, 0.0),
        background=(0.09, 0.1, 0.12),
        environment=True,
    ),
    Setting(
        *("haired-close", "judge", "haired", 256, 16, fr.Camera(-70.0, 25.0, zoom=2.2)),
        lights=(fr.Light(-100.0, 50.0, 3.2, shadow=False), fr.Light(10.0, 20.0, 0.9, shadow=False)),
        target=(0.0, 0.35, 0.1),
    ),
    Setting(
        *("distant-front", "judge", "distant", 512, 4, fr.Camera(20.0, -8.0)),
        lights=(fr.Light(65.0, 30.0, (3.1, 3.0, 3.0), radius=3.0),),
        material={"roughness_factor": 0.85},
        background=None,
        float_albedo=True,
    ),
    Setting(
        *("distant-profile", "judge", "distant", 1024, 1, fr.Camera(-78.0, 2.0)),
        lights=(
            fr.Light(-20.0, 30.0, 2.6, shadow=False),
            fr.Light(-150.0, 45.0, (2.0, 2.2, 2.6), shadow=False),
        ),
        shading=fr.Shading("ward"),
        ambient=(0.1, 0.1, 0.1),
    ),
    Setting(
        *("coarse-front", "judge", "coarse", 256, 1, fr.Camera(10.0, 12.0)),
        lights=(fr.Light(-60.0, 28.0, 2.8), fr.Light(80.0, 30.0, 1.2)),
        background=(0.5, 0.5, 0.55),
    ),
    Setting(
        *("coarse-below", "judge", "coarse", 384, 4, fr.Camera(-40.0, -25.0)),
        lights=(fr.Light(15.0, 60.0, 1.4, shadow=False),),
        point=((-1.4, -0.8, 1.8), (2.4, 2.2, 2.0)),
        material={"m": 0.16},
        ambient=(0.08, 0.08, 0.1),
        background=None,
    ),
    Setting(
        *("relative-front", "judge", "relative", 384, 4, fr.Camera(4.0, 1.0)),
        lights=(
            fr.Light(-42.0, 38.0, (3.8, 3.6, 3.3), radius=5.0),
            fr.Light(125.0, 28.0, (2.6, 2.7, 3.0), shadow=False),
        ),
    ),
    Setting(
        *("relative-eye", "judge", "relative", 256, 16, fr.Camera(-18.0, 3.0, zoom=5.0)),
        lights=(fr.Light(30.0, 50.0, 3.0, shadow=False), fr.Light(-60.0, 10.0, 1.2)),
        target=(-0.18, 0.14, 0.5),
    ),
    Setting(
        *("relative-profile", "judge", "relative", 512, 1, fr.Camera(-84.0, -4.0)),
        lights=(fr.Light(-25.0, 25.0, 2.2), fr.Light(-160.0, 20.0, 2.0, shadow=False)),
        ambient=(0.0, 0.0, 0.0),
        background=(0.0, 0.0, 0.0),
        environment=True,
    ),
    Setting(
        *("makehuman-above", "judge", "makehuman", 320, 1, fr.Camera(33.0, 30.0)),
        lights=(fr.Light(-10.0, 40.0, 4.0),),
        background=None,
        float_albedo=True,
    ),
)
_PRESENT = {"scan": scan_folder() is not None, "makehuman": makehuman_folder() is not None}
SETTINGS = {each.name: each for each in _SETTINGS if _PRESENT.get(each.head, True)}
