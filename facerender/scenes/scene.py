"""A mesh under lights before a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.scenes.camera import Camera
from facerender.scenes.light import LIGHTS, Light
from facerender.scenes.mesh import Mesh
from facerender.scenes.vectors import Vector, non_negative


@dataclass(frozen=True)
class Scene:
    """A mesh under lights before a camera.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    camera, lights : see there
    ambient : irradiance from everywhere, one number or linear RGB
    background : linear RGB behind the mesh, or None for transparent
    """

    mesh: Mesh
    camera: Camera = Camera()
    lights: tuple[Light, ...] = (LIGHTS["key"], LIGHTS["rim"], LIGHTS["fill"])
    ambient: float | Vector = (0.26, 0.28, 0.31)
    background: Vector | None = (0.012, 0.013, 0.016)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lights", tuple(self.lights))
        object.__setattr__(self, "ambient", non_negative("ambient", self.ambient))
        if self.background is not None:
            background = non_negative("background", self.background)
            object.__setattr__(self, "background", background)


def slope_ranges(scene: Scene) -> list[tuple[float, float]]:
    """Return the smallest and the largest m of each part; without texture coordinates no map
    counts."""
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    return [(at.m, at.m) if part.uv is None else at.slopes for part, at in parts]


def point_lights(scene: Scene) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return positions and intensities of the point lights in the renderer's space, (3,) each.

    The intensity is the irradiance that the light gives at the mesh's centre, times the square of
    its distance from there.

    Raises
    ------
    InputError : a light stands at the centre itself
    """
    result = []
    for light in scene.lights:
        if light.position is None:
            continue
        position = scene.mesh.normalised(light.position)
        distance2 = float(position @ position)
        if distance2 < 1e-12:
            raise InputError(f"point light {light.position} is at the mesh's centre; move it")
        result.append((position, np.asarray(light.irradiance) * distance2))
    return result
