"""Parts, the triangles of one material, and regions of a mesh that cameras frame."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from facerender.mesh.rig import Rig

Float = NDArray[np.float64]


def used(positions: Float, faces: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the vertices that faces use. np.unique takes fifty times as long."""
    mask = np.zeros(len(positions), dtype=bool)
    mask[faces] = True
    return mask


class Space(NamedTuple):
    """The renderer's space, in which a sphere around the mesh is the unit sphere.

    center : centre of the sphere, in mesh space
    radius : radius of the sphere, in mesh units
    reach : radius of a sphere around all vertices of a pose, in the renderer's space; at least 1
    """

    center: tuple[float, ...]
    radius: float
    reach: float = 1.0

    def normalised(self, points: ArrayLike) -> Float:
        """Map points (..., 3) from mesh space. Computes in float64: in float32, large offsets and
        small units would lose precision."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) / self.radius)


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in mesh space.

    positions : (N, 3) float64
    normals : (N, 3) float64, unit vectors
    faces : (F, 3) uint32, counter-clockwise seen from outside
    uv : (N, 2) float64 with v upwards, or None
    colors : (N, 3) linear RGB, or None
    occlusion : (N,) in [0, 1], fraction of uniform ambient light that reaches a vertex, or None;
        see :func:`facerender.with_occlusion`
    uv2 : (N, 2) float64, second texture coordinates for the maps that
        :attr:`Material.second_uv` names, or None
    head : (2, 3) float64, bounds of the vertices that follow a head joint of the file's skin, or
        None; camera framing uses them
    name : name from the file, or ""; see docs/formats.md
    skin : False for eyes, lashes, teeth and hair, by the names of the part and its material
    sources : (N,) index of each vertex in the vertices of the mesh's file or arrays, which texture
        seams do not split; None if each vertex of the part has its own
    source_count : number of these vertices of the file or arrays
    rig : data of the poses of a glTF file; None for a part that cannot be posed
    preset : name of the preset that the part got by its name when it was loaded, or ""
    ks_ignored : whether the part's MTL file has Ks 0, which was loaded as ks 1
    """

    positions: Float
    normals: Float
    faces: NDArray[np.uint32]
    uv: Float | None = None
    colors: Float | None = None
    occlusion: Float | None = None
    uv2: Float | None = None
    head: Float | None = None
    name: str = ""
    skin: bool = True
    sources: NDArray[np.integer] | None = None
    source_count: int = 0
    rig: Rig | None = None
    preset: str = ""
    ks_ignored: bool = False

    def __repr__(self) -> str:
        has = [n for n in ("uv", "uv2", "colors", "occlusion") if getattr(self, n) is not None]
        counts = f"{len(self.positions)} vertices, {len(self.faces)} triangles"
        return f"<Part {', '.join([repr(self.name), counts, *has])}>"

    @cached_property
    def drawn(self) -> NDArray[np.bool_] | None:
        """Mask (N, 1) of the vertices that faces use; None if faces use all vertices."""
        mask = used(self.positions, self.faces)[:, None]
        return None if mask.all() else mask

    @cached_property
    def checksum(self) -> int:
        """CRC-32 of the positions in float32, which hides differences between processors in the
        last bits of float64."""
        with np.errstate(over="ignore"):  # a pose may exceed float32
            return zlib.crc32(self.positions.astype(np.float32).tobytes())

    def within(self, bounds: Float) -> Part:
        """Return the part with the vertices outside the bounds moved to the bounds' centre. No face
        uses these vertices, but they could overflow in float32."""
        inside = ((self.positions >= bounds[0]) & (self.positions <= bounds[1])).all(axis=1)
        if inside.all():
            return self
        positions = np.where(inside[:, None], self.positions, bounds.mean(axis=0))
        return replace(self, positions=positions)


@dataclass(frozen=True, eq=False)
class Region:
    """An upright cylinder around the head or face of a mesh, in the renderer's space.

    center : (3,) float64
    radius, height : half the width and half the height of the cylinder
    """

    center: Float
    radius: float
    height: float

    @property
    def profile(self) -> Float:
        """Outline of the cylinder: distance from its axis, and height, like ``Mesh.profile``."""
        return np.array([(self.radius, self.height), (self.radius, -self.height)])
