"""Cost of subsurface scattering per pixel, without the fragment program: a fixed part, and a part
for each sample."""

from __future__ import annotations

import numpy as np

from facerender.pricing.cost import frames
from facerender.scenes.camera import Camera
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.scene import Scene
from facerender.shading import Shading

PARTS = ("scattering", "sample of scattering")
_MEASURED = (8, 64)  # subsurface samples per pixel of the two measured frames
_SIZE = 512


def scene() -> Scene:
    """Return a scene of a skin wall that fills a square image at four pixels per millimetre."""
    corners = 80.0 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    wall = Part(corners, np.tile((0.0, 0.0, 1.0), (4, 1)), faces)
    skin = Material(scattering="skin", ks=0.0)
    bounds = np.array([(-80.0, -80.0, -80.0), (80.0, 80.0, 80.0)])
    mesh = Mesh("wall", (wall,), (skin,), bounds, 139.0, np.array([(0.5, 0.5)]), 1.0)
    camera = Camera(position=(0.0, 0.0, 288.7), target=(0.0, 0.0, 0.0), fov=25.0)
    return Scene(mesh, camera)


def by_frames(repeats: int = 9) -> dict[str, float]:
    """Measure the cost of PARTS on this machine, in nanoseconds per pixel; raise like
    :func:`facerender.pricing.cost.frames`."""
    shadings = [Shading(scatter_samples=count) for count in (0, *_MEASURED)]
    none, *scattered = frames(scene(), shadings, (_SIZE, _SIZE), repeats)
    return parts(_MEASURED, [1e6 * (time.value - none.value) / _SIZE**2 for time in scattered])


def parts(samples: tuple[int, int], costs: list[float]) -> dict[str, float]:
    """Return the costs of PARTS, given the costs of scattering with two numbers of samples."""
    price = (costs[1] - costs[0]) / (samples[1] - samples[0])
    return dict(zip(PARTS, (max(costs[0] - samples[0] * price, 0.0), price), strict=True))
