"""Parts, the triangles of one material, as a mesh has them and as the GPU gets them. The face
of a mesh, and the regions that cameras frame."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.values.vectors import Array, Float32, Integers, Mask
from facerender.values.vectors import Float as Float

if TYPE_CHECKING:
    from facerender.mesh.rig import Rig

# Clip coordinates of corners whose bounds are the whole image.
_EVERYWHERE = np.array([[x, y, 0.0, 1.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)] * 2)
_EDGE_ON = 0.01  # sine of the angle between view ray and triangle


def used(positions: Float, faces: Array) -> Mask:
    """Return a mask of the vertices that faces use. np.unique takes fifty times as long."""
    mask = np.zeros(len(positions), dtype=bool)
    mask[faces] = True
    return mask


class Space(NamedTuple):
    """The renderer's space, in which a sphere around the mesh is the unit sphere."""

    center: tuple[float, ...]  # centre of the sphere, in mesh space
    radius: float  # radius of the sphere, in mesh units
    reach: float = 1.0  # radius of a sphere around all vertices of a pose; at least 1

    def normalised(self, points: ArrayLike) -> Float:
        """Map points (..., 3) from mesh space, in float64: large offsets need its precision."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.center) / self.radius)


@dataclass(frozen=True, eq=False)
class Part:
    """Triangles of one material, in mesh space."""

    positions: Float  # (N, 3)
    normals: Float  # (N, 3), unit vectors
    faces: NDArray[np.uint32]  # (F, 3), counter-clockwise seen from outside
    uv: Float | None = None  # (N, 2) with v upwards
    colors: Float | None = None  # (N, 3) linear RGB
    # (N,) in [0, 1], fraction of uniform ambient light that reaches a vertex; see
    # :func:`facerender.with_occlusion`.
    occlusion: Float | None = None
    uv2: Float | None = None  # (N, 2), for the maps that :attr:`Material.second_uv` names
    # (2, 3), bounds of the vertices that follow a head joint of the file's skin, for the framing.
    head: Float | None = None
    name: str = ""  # name from the file; see docs/formats.md
    skin: bool = True  # false for eyes, lashes, teeth and hair, by the names of part and material
    # (N,) index of each vertex in the vertices of the mesh's file or arrays, which texture seams do
    # not split; None if each vertex of the part has its own.
    sources: NDArray[np.integer] | None = None
    source_count: int = 0  # number of these vertices of the file or arrays
    rig: Rig | None = None  # data of the poses of a glTF file; None if the part cannot be posed
    preset: str = ""  # name of the preset that the part got by its name when it was loaded
    ks_ignored: bool = False  # whether the part's MTL file has Ks 0, which was loaded as ks 1

    def __repr__(self) -> str:
        has = [n for n in ("uv", "uv2", "colors", "occlusion") if getattr(self, n) is not None]
        counts = f"{len(self.positions)} vertices, {len(self.faces)} triangles"
        return f"<Part {', '.join([repr(self.name), counts, *has])}>"

    @cached_property
    def drawn(self) -> Mask | None:
        """Mask (N, 1) of the vertices that faces use; None if faces use all vertices."""
        mask = used(self.positions, self.faces)[:, None]
        return None if mask.all() else mask

    @cached_property
    def checksum(self) -> int:
        """CRC-32 of the positions in float32: last bits of float64 differ between processors."""
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
    """An upright cylinder around the head or face of a mesh, in the renderer's space."""

    center: Float  # (3,)
    radius: float  # half the width of the cylinder
    height: float  # half the height

    @property
    def profile(self) -> Float:
        """Outline of the cylinder: distance from its axis, and height, like ``Mesh.profile``."""
        return np.array([(self.radius, self.height), (self.radius, -self.height)])


@dataclass(frozen=True, eq=False)
class Face:
    """A face, as :func:`facerender.find_face` returns it.

    eyes : (2, 3) centres of the eyes on the surface, first the one on the viewer's left
    up, front : (3,) unit vectors, to the top of the head and in the direction in which it looks
    eye_distance : distance of the eyes, about 63 mm for adults
    score : agreement with a face; at least 0.85, about 0.95 for a scan, 1.05 for the built-in head
    """

    eyes: Float
    up: Float
    front: Float
    eye_distance: float
    score: float

    def __repr__(self) -> str:
        return f"<Face with score {self.score:.2f}, eyes {self.eye_distance:.4g} apart>"

    @property
    def axes(self) -> Float:
        """Rotation (3, 3), for column vectors, to a face that looks along +z with y up."""
        return np.stack([np.cross(self.up, self.front), self.up, self.front])


@dataclass(frozen=True, eq=False)
class Framing:
    """The face of a geometry, and what cameras frame."""

    face: Face | None  # in mesh space; None if no face is found
    # "head", "face", "eyes" and "auto", in the renderer's space. "auto" is the head if the mesh is
    # clearly larger than a head, and otherwise None: the whole mesh.
    regions: Mapping[str, Region | None]
    # Source of the regions if no face is found, for a warning: "the names of its parts" or "its
    # outline"; "" if there is a face, or nothing that may be a head.
    source: str


class Area(NamedTuple):
    """A rectangle of an image: left column, lowest row, width and height in pixels."""

    left: int = 0
    low: int = 0
    width: int = 0
    height: int = 0


def face_normals(columns: Array, faces: Array) -> tuple[Array, list[Array]]:
    """Return the first corner and the normal of each triangle, (3, F), from x, y and z of the
    vertices, (3, N). The length of a normal is twice the triangle's area."""
    a, b, c = (columns.take(corner, axis=1) for corner in faces)
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    return a, [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx]


@dataclass(frozen=True, eq=False)
class TriangleSetup:
    """The triangles of a part in the renderer's space, as the GPU gets them."""

    vertices: Float32  # (N, 6), vertex positions in the renderer's space, and normals
    faces: NDArray[np.uint32]  # (F, 3), indices of vertices
    positions: Float32 = field(init=False)  # (N, 3), the vertex positions alone

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", self.vertices[:, :3])

    @classmethod
    def of(cls, part: Part, space: Space) -> TriangleSetup:
        """Return the triangle setup of a part of a mesh."""
        vertices = np.empty((len(part.positions), 6), dtype=np.float32)
        vertices[:, :3], vertices[:, 3:] = space.normalised(part.positions), part.normals
        return cls(vertices, np.asarray(part.faces, dtype=np.uint32))

    @cached_property
    def bounds(self) -> NDArray[np.floating[Any]]:
        """Corners of the vertices' bounding box, homogeneous, (8, 4)."""
        columns = np.ascontiguousarray(self.positions.T)
        sides = zip(columns.min(axis=1), columns.max(axis=1), strict=True)
        return np.stack(np.meshgrid(*sides, [1.0]), axis=-1).reshape(-1, 4)

    @cached_property
    def planes(self) -> Float32:
        """Unit normal of each triangle, and the distance of the origin from its plane, (4, F)."""
        columns, faces = (np.ascontiguousarray(array.T) for array in (self.positions, self.faces))
        corners, vectors = face_normals(columns, faces)
        normals = np.stack(vectors)
        normals /= np.maximum(np.linalg.norm(normals, axis=0), 1e-30)
        return np.vstack([normals, -np.einsum("ij,ij->j", normals, corners)])

    def facing(self, eye: Float) -> Integers:
        """Return the indices of the triangles that can face a camera, a homogeneous point (4,).

        Triangles that are seen edge-on are included, because a driver rounds positions to fractions
        of a pixel before it decides which triangles are back faces.
        """
        edge_on = -_EDGE_ON * (1.0 + math.sqrt(eye[:3] @ eye[:3]))
        return (eye.astype(np.float32) @ self.planes > edge_on).nonzero()[0]


def areas_of(
    bounds: Float, view: Float, size: tuple[int, int], groups: Mapping[Any, Sequence[int]]
) -> dict[Any, Area]:
    """Return the bounds of each part in an image by its index, empty for a part outside the image;
    and the bounds of groups of parts by their names.

    bounds : (parts, 8, 4), see :attr:`TriangleSetup.bounds`
    view : matrix of the image's :class:`View`
    size : width and height of the image
    groups : indices of parts
    """
    clip = bounds @ view
    w = clip[..., 3:]
    if np.minimum.reduce(w, None) <= 0.0:  # a part may reach the camera
        w = np.where(behind := w.min(axis=1, keepdims=True) <= 0.0, 1.0, w)
        clip = np.where(behind, _EVERYWHERE, clip)
    corners = (clip[..., :2] / w * 0.5 + 0.5) * size
    # The largest of negated corners are the lowest ones: one array serves all four sides, also of
    # a group, which ignores parts outside the image.
    sides = np.maximum.reduce(np.concatenate([-corners, corners], axis=2), 1)
    width, height = size
    sides = np.maximum(np.ceil(sides), (-width, -height, 0, 0))
    sides = np.minimum(sides, (0, 0, width, height)).astype(int)
    rows = (Area(-left, -low, left + right, low + top) for left, low, right, top in sides.tolist())
    areas: dict[Any, Area] = dict(enumerate(rows))
    for name, indices in groups.items():
        filled = [sides[i] for i in indices if areas[i].width and areas[i].height]
        left, low, right, top = np.max(filled, axis=0).tolist() if filled else (0, 0, 0, 0)
        areas[name] = Area(-left, -low, left + right, low + top)
    return areas
