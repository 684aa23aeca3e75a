"""Selection of a scene's subsurface scattering profiles for an image size."""

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

_HEADS = (40.0, 1200.0)  # plausible mesh radii in mm, from a small head to a whole person
_warned: WeakSet[Mesh] = WeakSet()


@dataclass(frozen=True)
class Scattering:
    """Scattering profiles of the parts of a scene.

    Attributes
    ----------
    profiles : distinct profiles of the parts, without Gaussians narrower than half a pixel
    numbers : for each part the index of its profile, counted from 1; -1 for no scattering
    millimetres : millimetres per unit of the renderer's space
    pixels : height in pixels of an object with height 1 at depth 1, both in the renderer's
        space
    """

    profiles: tuple[Gaussians, ...]
    numbers: tuple[int, ...]
    millimetres: float
    pixels: float


def scattering_of(scene: Scene, size: tuple[int, int]) -> Scattering | None:
    """Return the scattering profiles of a scene for an image size.

    Return None if nothing scatters over more than half a pixel at the camera target's distance.

    Raises
    ------
    InputError : the size of the mesh in millimetres is unknown
    """
    mesh = scene.mesh
    profiles_of_parts = [
        each.scattering if each.diffuse_weight > 0.0 else None for each in mesh.materials
    ]
    if not any(profiles_of_parts):
        return None
    if mesh.millimetres is None:
        raise InputError(
            f"scattering needs the size of {mesh.name}, which does not specify its unit: give "
            "--millimetres 1 if the unit is 1 mm, or 1000 if it is 1 m (load_mesh(..., "
            "millimetres=1))"
        )
    millimetres = mesh.radius * mesh.millimetres
    if not _HEADS[0] <= millimetres <= _HEADS[1] and mesh not in _warned:
        _warned.add(mesh)
        warn(
            f"{mesh.name} is {2.0 * millimetres:.3g} mm across if its unit is {mesh.millimetres:g} "
            "mm, unusual for a head: give --millimetres if the unit is wrong"
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
