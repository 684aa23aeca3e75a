"""Selection of a scene's subsurface scattering profiles for an image size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from facerender.errors import InputError
from facerender.mesh.hints import emit, unit_of, wrong_unit
from facerender.scene.scene import Scene
from facerender.scene.view import View, target_of
from facerender.terms.transport import Gaussians, wide_gaussians

_RADII = (40.0, 1200.0)  # plausible radii of a mesh in mm, from a small head to a person


@dataclass(frozen=True)
class Scattering:
    """Scattering profiles of the parts of a scene.

    profiles : distinct profiles of the parts, without Gaussians narrower than half a pixel
    numbers : for each part the index of its profile, counted from 1; -1 for no scattering
    millimetres : millimetres per unit of the renderer's space
    pixels : height in pixels of an object with height 1 at depth 1, in the renderer's space; of an
        orthographic camera at every depth
    """

    profiles: tuple[Gaussians, ...]
    numbers: tuple[int, ...]
    millimetres: float
    pixels: float


def scattering_of(scene: Scene, view: View, size: tuple[int, int]) -> Scattering | None:
    """Return the scattering profiles of a scene for an image size; None if nothing scatters over
    more than half a pixel at the camera target's distance. Raises InputError if the size of the
    mesh in millimetres is unknown."""
    mesh = scene.mesh
    profiles_of_parts = [m.scattering if m.diffuse_weight > 0.0 else None for m in mesh.materials]
    if not any(profiles_of_parts):
        return None
    if mesh.millimetres is None:
        remedy = unit_of(mesh) or "scale the mesh to mm, and give --millimetres 1"
        remedy += " (load_mesh(..., millimetres=...))"
        cause = f"scattering needs the size of {mesh.name}, which does not specify its unit"
        raise InputError(f"{cause}: {remedy}")
    millimetres = mesh.radius * mesh.millimetres
    if not _RADII[0] <= millimetres <= _RADII[1]:  # the search for the face takes time
        emit(mesh, wrong_unit, wrong_unit(mesh))
    distance = 1.0
    if not view.orthographic:
        distance = float(np.linalg.norm(view.position - target_of(mesh, scene.camera)))
    pixels = 0.5 * size[1] / math.tan(math.radians(scene.camera.fov) / 2.0)
    if view.orthographic or scene.camera.intrinsics is not None:
        pixels = float(view.pixels(size)[1])
    pixel = millimetres * distance / pixels
    wide = [wide_gaussians(profile, pixel) if profile else () for profile in profiles_of_parts]
    profiles = tuple(dict.fromkeys(filter(None, wide)))
    if not profiles:
        return None
    numbers = tuple(profiles.index(profile) + 1 if profile else -1 for profile in wide)
    return Scattering(profiles, numbers, millimetres, pixels)
