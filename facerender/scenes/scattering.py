"""What of a scene scatters light, and by which profiles, in an image of a size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from weakref import WeakSet

import numpy as np

from facerender.errors import InputError, warn
from facerender.scenes.mesh import Mesh
from facerender.scenes.scene import Scene
from facerender.scenes.view import target_of, view_of
from facerender.terms.scattering import Gaussians, wide_gaussians

_HEADS = (40.0, 1200.0)  # mm, of radii around heads and whole people
_told: WeakSet[Mesh] = WeakSet()


@dataclass(frozen=True)
class Scattering:
    """Profiles of the parts of a scene.

    Attributes
    ----------
    profiles : the Gaussians of each that are wider than half a pixel
    numbers : of each part its profile's, from 1; -1 for one that does not scatter
    millimetres : of a unit of the renderer's space
    pixels : of such a unit across the view, at a depth of 1
    """

    profiles: tuple[Gaussians, ...]
    numbers: tuple[int, ...]
    millimetres: float
    pixels: float


def scattering_of(scene: Scene, size: tuple[int, int]) -> Scattering | None:
    """Return how a scene scatters in an image; None where nothing does that pixels resolve, at the
    distance of the camera's target.

    Raises
    ------
    InputError : nobody has said how long a unit of the mesh is
    """
    mesh = scene.mesh
    profiles_of_parts = [each.scattering if each.kd > 0.0 else None for each in mesh.materials]
    if not any(profiles_of_parts):
        return None
    if mesh.millimetres is None:
        raise InputError(
            f"scattering needs the size of {mesh.name}, which does not say how long its unit is: "
            "give --millimetres, such as 1 or 1000 (load_mesh(..., millimetres=1))"
        )
    millimetres = mesh.radius * mesh.millimetres
    if not _HEADS[0] <= millimetres <= _HEADS[1] and mesh not in _told:
        _told.add(mesh)
        warn(
            f"{mesh.name} is {2.0 * millimetres:.3g} mm across if its unit is {mesh.millimetres:g} "
            "mm, and scatters as such: give --millimetres if it is not"
        )
    camera, view = scene.camera, view_of(scene, size[0] / size[1])
    distance = float(np.linalg.norm(view.position - target_of(mesh, camera)))
    pixels = 0.5 * size[1] / math.tan(math.radians(camera.fov) / 2.0)
    if camera.intrinsics is not None:
        pixels = float(view.intrinsics(size)[1, 1])
    pixel = millimetres * distance / pixels
    wide = [wide_gaussians(each, pixel) if each else () for each in profiles_of_parts]
    profiles = tuple(dict.fromkeys(filter(None, wide)))
    if not profiles:
        return None
    numbers = tuple(profiles.index(each) + 1 if each else -1 for each in wide)
    return Scattering(profiles, numbers, millimetres, pixels)
