"""Meshes: triangles with their materials. Files are read in ``loading``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_range, check_type, each_of
from facerender.scenes.material import Material, check_maps
from facerender.scenes.vectors import check_array


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in the mesh's space.

    Attributes
    ----------
    positions : (N, 3) float64
    normals : (N, 3) float64, unit vectors
    faces : (F, 3) uint32, counter-clockwise seen from outside
    uv : (N, 2) float64 with v upwards, or None
    colors : (N, 3) linear RGB, or None
    occlusion : (N,) in [0, 1], what reaches a vertex of a light that is the same from everywhere,
        or None; see :func:`facerender.with_occlusion`
    """

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    faces: NDArray[np.uint32]
    uv: NDArray[np.float64] | None = None
    colors: NDArray[np.float64] | None = None
    occlusion: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        for name, columns in (("positions", 3), ("normals", 3), ("faces", 3)):
            check_array(name, getattr(self, name), columns)
        for name, columns in (("uv", 2), ("colors", 3), ("occlusion", 0)):
            if (values := getattr(self, name)) is not None:
                check_array(name, values, columns)


@dataclass(frozen=True, eq=False)
class Mesh:
    """What a mesh file holds.

    Attributes
    ----------
    name : the file's name, for messages
    parts : at least one
    materials : one for each part
    bounds : (2, 3) float64, the lowest and the highest corner of what the faces use
    radius : the largest distance of a vertex from the centre of the bounds
    profile : (K, 2) float64, the outline that the mesh has when it turns about the vertical axis
        through its centre: distance from the axis and height, in the renderer's space
    millimetres : that a unit of its space is, as a glTF file says; None where no file has said so.
        Scattering needs it
    """

    name: str
    parts: tuple[Part, ...]
    materials: tuple[Material, ...]
    bounds: NDArray[np.float64]
    radius: float
    profile: NDArray[np.float64]
    millimetres: float | None = None

    def __post_init__(self) -> None:
        check_type("name of a mesh", self.name, str, "text")
        parts = each_of("parts", self.parts, Part, "several facerender.scenes.mesh.Part")
        materials = each_of("materials", self.materials, Material, "several facerender.Material")
        if not 0 < len(parts) == len(materials):
            raise InputError(
                f"{self.name} has {len(parts)} parts and {len(materials)} materials: give one for "
                "each, and one part at least"
            )
        object.__setattr__(self, "parts", parts)
        object.__setattr__(self, "materials", materials)
        check_array("bounds", self.bounds, 3)
        check_array("profile", self.profile, 2)
        check_range("radius", self.radius, 0.0, math.inf)
        if self.millimetres is not None:
            check_range("millimetres", self.millimetres, 1e-6, 1e6)
        check_maps(self.name, self.materials)

    @property
    def center(self) -> NDArray[np.float64]:
        """(3,) float64: the middle of the bounds."""
        return np.asarray(self.bounds.mean(axis=0))

    def normalised(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points, (..., 3), to the renderer's space: centre at the origin, radius 1.

        In float64, so that millimetres, micrometres and large offsets survive the step to float32.
        """
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) / self.radius)

    def denormalised(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points, (..., 3), of the renderer's space back to the mesh's."""
        return np.asarray(np.asarray(points, dtype=np.float64) * self.radius + self.center)

    def with_material(self, **changes: Any) -> Mesh:
        """Return the mesh with fields of every material replaced; geometry and maps are shared.

        A new ``m`` takes the place of a roughness map.

        Raises
        ------
        InputError : a value outside its domain
        """
        if "m" in changes:
            changes = {"roughness_map": None, **changes}
        return replace(self, materials=tuple(replace(each, **changes) for each in self.materials))


def slope_range(part: Part, material: Material) -> tuple[float, float]:
    """Return the smallest and the largest m of all lobes; without texture coordinates no map
    counts."""
    return material.with_second(material.m, material.m) if part.uv is None else material.slopes
