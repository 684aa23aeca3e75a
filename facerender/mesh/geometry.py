"""The geometry of a mesh, which never changes, and its poses.

Materials change by option and the pose changes by frame; the geometry stays. Each of these values
owns what derives from it: a cache is an attribute of the value that it derives from, and dies with
that value."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, parameters
from facerender.mesh.arrays import Corners
from facerender.mesh.framing import Framing, framing_of
from facerender.mesh.part import Part, Space, used
from facerender.mesh.repair import are_closed
from facerender.mesh.setup import TriangleSetup
from facerender.values.ranges import Range, check_fields, ranged
from facerender.values.vectors import MOST_RADII, unit

Floats = NDArray[np.float64]


class Latest(dict[Any, Any]):
    """Results by name, each with the value that it was made for."""

    def of(self, name: str, value: Any, make: Callable[[], Any]) -> Any:
        """Return the result of a name; make it if the last one was made for another value."""
        if name not in self or self[name][0] != value:
            self[name] = value, make()
        return self[name][1]


@dataclass(frozen=True, eq=False)
class Geometry:
    """The parts of a mesh in the reference pose. All meshes that differ only in materials or in the
    pose share it.

    bounds : (2, 3) float64, lowest and highest coordinates of the vertices that faces use
    radius : largest distance of a face's vertex from the centre of the bounds
    profile : (K, 2) float64, outline of the solid that the mesh sweeps when it rotates about the
        vertical axis through the centre of the bounds: distance from the axis and height, in the
        renderer's space
    millimetres : millimetres per unit of mesh space, needed for scattering; None if unknown
    known_framing : result of :attr:`framing` if it is known, as from the cache; None to compute it
    rotation : (3, 3), for column vectors, from the axes of the file to mesh space; None if they are
        equal. See :func:`facerender.load_mesh`
    gloss : for each part, the highlight of the material in the file; None if the mesh was not
        loaded. Hints name only these highlights, see :func:`facerender.mesh.hints.gloss_of`
    """

    name: str
    parts: tuple[Part, ...]
    bounds: Floats
    radius: float
    profile: Floats
    millimetres: float | None = ranged(Range(1e-6, 1e6, "mm"), None)
    known_framing: Framing | None = None
    rotation: Floats | None = None
    gloss: tuple[Any, ...] | None = None

    __getstate__ = parameters

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of(cls, name: str, parts: Sequence[Part], millimetres: float | None = None) -> Geometry:
        """Return the geometry of parts, whose face indices must be valid."""
        vertices = [part.positions[used(part.positions, part.faces)] for part in parts]
        joined = np.concatenate(vertices)
        bounds = np.array([joined.min(axis=0), joined.max(axis=0)])
        offsets = joined - bounds.mean(axis=0)
        radius = float(np.linalg.norm(offsets, axis=1).max())
        within = tuple(part.within(bounds) for part in parts)
        return cls(name, within, bounds, radius, _profile(offsets / radius), millimetres)

    @cached_property
    def space(self) -> Space:
        """The renderer's space."""
        return Space(tuple(self.bounds.mean(axis=0).tolist()), self.radius)

    @cached_property
    def token(self) -> object:
        """A value that no other geometry and no pose has, for keys that must not hold arrays."""
        return object()

    @cached_property
    def framing(self) -> Framing:
        """The face, and the regions that cameras frame. The search takes about half a second."""
        return self.known_framing or framing_of(self.parts, self.space, self.profile)

    @property
    def shapes(self) -> tuple[str, ...]:
        """Names of the morph targets."""
        rigs = (part.rig for part in self.parts)
        return tuple(dict.fromkeys(shape.name for rig in rigs if rig for shape in rig.shapes))

    @cached_property
    def corners(self) -> Corners:
        """Corners of the faces, from which a pose computes its normals."""
        return Corners.of(self.parts)

    @cached_property
    def mean_normals(self) -> list[Floats]:
        """Mean face normals around each vertex as unit vectors, (N, 3) for each part."""
        return [*map(unit, self.corners.normal_sums([part.positions for part in self.parts]))]

    @cached_property
    def closed(self) -> list[bool]:
        """For each part, whether it belongs to closed surfaces, see :func:`are_closed`."""
        return are_closed(self.parts)

    @cached_property
    def setups(self) -> list[TriangleSetup]:
        """The triangles of each part as the GPU gets them."""
        return [TriangleSetup.of(part, self.space) for part in self.parts]

    @cached_property
    def derived(self) -> Latest:
        """Results that hints and drawing derive from the geometry with recent materials, and
        simplified geometries. They are freed with it, so that no renderer keeps a mesh alive."""
        return Latest()


@dataclass(frozen=True, eq=False)
class MeshPose:
    """Moved vertices of a geometry.

    parts : the parts of the geometry, of which some have other positions and normals
    bounds : bounds of the geometry, moved with the head if the framing follows it
    """

    geometry: Geometry
    parts: tuple[Part, ...]
    bounds: Floats

    __getstate__ = parameters

    def __post_init__(self) -> None:
        _ = self.space  # refuses vertices that are too far away

    @cached_property
    def space(self) -> Space:
        """The renderer's space. Raises InputError if a vertex is too far from its centre."""
        center, radius = self.bounds.mean(axis=0), self.geometry.radius
        offsets = (part.positions - center for part in self.parts)
        squares = [np.einsum("ij,ij->i", vectors, vectors).max() for vectors in offsets]
        reach = math.sqrt(np.max(squares)) / radius
        if not reach <= MOST_RADII:
            distance = f"{reach:.3g} mesh radii from its centre"
            remedy = f"give positions, weights, a clip or a time within {MOST_RADII:g} radii"
            name = self.geometry.name
            raise InputError(f"the pose moves vertices of {name} to {distance}: {remedy}")
        return Space(tuple(center.tolist()), radius, reach if reach > 1.0 + 1e-9 else 1.0)

    @cached_property
    def token(self) -> object:
        """A value that no other pose has; see :attr:`Geometry.token`."""
        return object()

    @cached_property
    def levels(self) -> dict[int, MeshPose | None]:
        """The pose of simplified geometries, by triangle limit."""
        return {}

    @cached_property
    def setups(self) -> list[TriangleSetup]:
        """The triangles of each part as the GPU gets them; unmoved ones share the geometry's."""
        geometry = self.geometry
        stays = self.bounds is geometry.bounds
        return [
            geometry.setups[i] if stays and part is stored else TriangleSetup.of(part, self.space)
            for i, (part, stored) in enumerate(zip(self.parts, geometry.parts, strict=True))
        ]


def _profile(positions: Floats) -> Floats:
    """Return a mesh's profile: distance from the axis and height of the outermost vertex in
    each of at most 511 horizontal slices."""
    widths, heights = np.hypot(positions[:, 0], positions[:, 2]), positions[:, 1]
    slices = np.round(heights * 255.0).astype(np.int64)
    order = np.lexsort((widths, slices))
    widest = order[np.diff(slices[order], append=slices.max() + 1) > 0]
    return np.stack([widths[widest], heights[widest]], axis=1)
