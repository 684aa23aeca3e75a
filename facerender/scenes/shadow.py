"""The space in which a light sees a mesh: see ``shaders/facerender/shadow.glsl``."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.scenes.light import Light
from facerender.scenes.mesh import Mesh
from facerender.scenes.vectors import within_reach

NEAREST = 1.05  # a point light, in radii of the mesh's bounding sphere


@dataclass(frozen=True, eq=False)
class LightSpace:
    """Where a light sees the renderer's space, in which the mesh lies within the unit sphere.

    Attributes
    ----------
    matrix : (4, 4) float64, for row vectors; the first three are to be divided by the fourth
    tan_radius : tangent of the angle between the centre and the rim of the light, seen from the
        centre of the mesh
    top : the largest z of the unit sphere
    """

    matrix: NDArray[np.float64]
    tan_radius: float
    top: float


def light_space(light: Light, mesh: Mesh) -> LightSpace:
    """Return the space of a light.

    Raises
    ------
    InputError : a point light stands within the mesh's bounding sphere, or nearly so, or 1e6 radii
        away
    """
    tan_radius = math.tan(math.radians(light.radius))
    if light.position is None:
        matrix = np.eye(4)
        matrix[:3, :3] = light_axes(light, mesh)
        return LightSpace(matrix, tan_radius, 1.0)
    place = within_reach(f"point light {light.position}", mesh.normalised(light.position))
    distance = float(np.linalg.norm(place))
    if distance < NEAREST:
        raise InputError(
            f"point light {light.position} casts no shadow from within the sphere around the mesh: "
            f"it is {distance:.3g} radii from the centre, give {NEAREST:g} or more, or no shadow"
        )
    axes = light_axes(light, mesh)
    scale = distance * math.sqrt(1.0 - 1.0 / distance**2)
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = scale * axes
    matrix[:3, 3] = -axes[:, 2]
    matrix[3, 3] = distance
    return LightSpace(matrix, tan_radius, scale / (distance - 1.0))


def light_axes(light: Light, mesh: Mesh) -> NDArray[np.float64]:
    """Return two vectors across the direction in which a light stands as seen from the centre of a
    mesh, and that itself, as columns (3, 3)."""
    towards = light.direction if light.position is None else mesh.normalised(light.position)
    towards = towards / np.linalg.norm(towards)
    across = np.cross(np.eye(3)[int(np.abs(towards).argmin())], towards)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards, across), towards], axis=1)
