"""Levels of detail: simplified meshes, and the images that a scene's plan covers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import index
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_type, shown, warn
from facerender.images.files import MAX_SIDE
from facerender.scenes.geometry import Geometry, Level
from facerender.scenes.mesh import TRIANGLES, Mesh, moved
from facerender.scenes.part import Part
from facerender.scenes.repair import VERTEX_ARRAYS, double_areas
from facerender.scenes.scene import Scene, ShadingRate, check_shading_rate
from facerender.system import meshoptimizer
from facerender.terms.ranges import IntegerRange, check_fields, ranged

Float = NDArray[np.float64]

# Weights of attribute errors. Position errors, in extents of the mesh, have weight 1.
# _PLACE weights texture coordinates, scaled to lengths on the surface in mesh radii. _COLOR weights
# linear colours and occlusion. Comparisons of images, as in docs/measurements/levels.md, determined
# the weights.
_NORMAL, _PLACE, _COLOR = 1.0, 20.0, 1.0
_WEIGHTS = [_NORMAL] * 3 + [_PLACE] * 2 + [_COLOR] * 4 + [_PLACE] * 2

_SAME_SHAPE = 1.01  # tolerance factor on the aspect ratio, because sizes are rounded


def simplified(mesh: Mesh, triangles: int) -> Mesh:
    """Return a simplified mesh with at most the given number of triangles, if possible.

    Edges collapse in increasing order of quadric error (Garland and Heckbert 1997), which includes
    normals, texture coordinates, colours and occlusion (Hoppe 1999). Remaining vertices do not
    move. Edges on mesh borders, seams and borders between parts collapse only along these lines, on
    both sides together, so that no cracks open. Materials, number of parts, bounds, radius,
    profile, head and face do not change, so that cameras frame the simplified mesh like the
    original. Triangles are ordered for the GPU's vertex cache. In all poses of a mesh, the
    reference pose determines which triangles remain.

    Reference: Kapoulkine (2016-2026), meshoptimizer: meshopt_simplifyWithAttributes.

    Parameters
    ----------
    mesh : from :func:`facerender.load_mesh`
    triangles : triangle limit of the whole mesh, at least 1; a smaller mesh is returned unchanged

    Raises
    ------
    InputError : triangles is below 1, or the package meshoptimizer is not installed

    Warns
    -----
    FacerenderWarning : the mesh still has more triangles than the limit, because of seams or parts
    """
    check_type("mesh", mesh, Mesh, "a facerender.Mesh")
    TRIANGLES.check("triangles", triangles)
    if sum(len(part.faces) for part in mesh.parts) <= triangles:
        return mesh
    levels = mesh.geometry.levels
    if triangles not in levels:
        levels[triangles] = _simplify(mesh.geometry, triangles)
    geometry, remaining = levels[triangles]
    if (count := sum(len(part.faces) for part in geometry.parts)) > triangles:
        warn(f"{mesh.name} cannot be simplified to {triangles} triangles: {count} remain")
    level = Mesh(geometry, mesh.materials)
    if mesh.pose is None:
        return level
    if triangles not in mesh.pose.levels:
        level = replace(level, pose=replace(mesh.pose, geometry=geometry, parts=geometry.parts))
        pairs = [*zip(mesh.parts, remaining, strict=True)]
        columns = ([getattr(p, n)[rows] for p, rows in pairs] for n in ("positions", "normals"))
        posed_level = moved(level, *columns).pose
        assert posed_level is not None
        mesh.pose.levels[triangles] = posed_level
    return replace(level, pose=mesh.pose.levels[triangles])


def _simplify(mesh: Geometry, triangles: int) -> Level:
    """Simplify all parts together, so that borders between parts stay closed and the errors of
    different parts are comparable. Also return the indices of each part's remaining vertices."""
    try:
        meshoptimizer.library()
    except ImportError:
        need = "levels of detail need the package meshoptimizer"
        raise InputError(f"{need}; pip install 'facerender[lod]'") from None
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    faces = [part.faces + start for part, start in zip(mesh.parts, starts, strict=False)]
    rows = np.concatenate([_vertices(mesh, number) for number in range(len(mesh.parts))])
    # In some files, triangles do not share vertices, so equal vertices are merged.
    rows, first_indices, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    corners = numbers.reshape(-1)[np.concatenate(faces)]
    attributes = rows.astype(np.float32)
    weights = np.array(_WEIGHTS[: rows.shape[1] - 4], dtype=np.float32)
    collapsed = meshoptimizer.collapsed(
        corners.astype(np.uint32), attributes[:, 1:4], attributes[:, 4:], weights, triangles
    )
    parts, remaining = [], []
    for number, part in enumerate(mesh.parts):
        chosen = collapsed[rows[collapsed[:, 0], 0] == number]
        if not len(chosen):
            all_faces = corners[rows[corners[:, 0], 0] == number]
            chosen = all_faces[[np.argmax(double_areas(rows[all_faces, 1:4]))]]
        vertices, inverse = np.unique(chosen, return_inverse=True)
        kept = first_indices[vertices] - starts[number]
        columns = ((name, getattr(part, name)) for name in (*VERTEX_ARRAYS, "occlusion"))
        arrays = {name: values[kept] for name, values in columns if values is not None}
        corners_of_part = inverse.reshape(chosen.shape).astype(np.uint32)
        ordered = meshoptimizer.in_cache_order(corners_of_part, len(vertices))
        parts.append(Part(**arrays, faces=ordered, name=part.name, skin=part.skin))
        remaining.append(kept)
    return replace(mesh, parts=tuple(parts), known_regions=mesh.regions), remaining


def _vertices(mesh: Geometry, index: int) -> Float:
    """Return the attributes of a part's vertices, one row per vertex.

    The first 12 columns are part index, position, normal, scaled texture coordinates and colour.
    If any part has occlusion or second texture coordinates, column 13 is the occlusion. If any part
    has second texture coordinates, columns 14 and 15 are the scaled second texture coordinates.
    """
    part = mesh.parts[index]
    count = len(part.positions)
    columns = [
        np.full((count, 1), index),
        mesh.space.normalised(part.positions),
        part.normals,
        _on_surface(mesh, part, part.uv),
        np.ones((count, 3)) if part.colors is None else part.colors,
    ]
    second = any(mesh_part.uv2 is not None for mesh_part in mesh.parts)
    if second or any(mesh_part.occlusion is not None for mesh_part in mesh.parts):
        columns.append((np.ones(count) if part.occlusion is None else part.occlusion)[:, None])
    if second:
        columns.append(_on_surface(mesh, part, part.uv2))
    return np.concatenate(columns, axis=1)


def _on_surface(mesh: Geometry, part: Part, uv: Float | None) -> Float:
    """Return texture coordinates (N, 2), scaled to lengths on the surface in mesh radii."""
    if uv is None:
        return np.zeros((len(part.positions), 2))
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], axis=1)
    on_map = float(double_areas(flat[part.faces]).sum())
    on_surface = float(double_areas(part.positions[part.faces]).sum())
    scale = math.sqrt(on_surface / on_map) if on_map > 0.0 else 1.0
    return uv * (scale / mesh.radius)


@dataclass(frozen=True)
class LevelOfDetail:
    """Settings that determine a frame's samples and triangles.

    samples, shading_rate : see :meth:`facerender.Renderer.render`
    triangles : triangle limit of the simplified mesh; None for all triangles
    cull_back_faces : whether all parts are drawn without back faces
    """

    samples: int
    triangles: int | None
    cull_back_faces: bool = False
    shading_rate: ShadingRate = "sample"

    @property
    def values(self) -> dict[str, Any]:
        """Keyword arguments for :meth:`facerender.Renderer.render`."""
        return {"samples": self.samples, "shading_rate": self.shading_rate}

    def of(self, scene: Scene) -> Scene:
        """Return the scene with its mesh simplified, and without back faces if they are culled. The
        frame before changes alike. Raises the errors of :func:`simplified`."""
        mesh = scene.mesh
        if self.triangles is not None:
            mesh = simplified(mesh, self.triangles)
        if self.cull_back_faces:
            mesh = mesh.single_sided
        if mesh is scene.mesh:
            return scene
        return replace(scene, mesh=mesh, before=scene.before and self.of(scene.before))


@dataclass(frozen=True)
class Planned:
    """The images for which a plan measured its error, and the settings that the plan chose.

    Parameters
    ----------
    sizes : width and height of each image in pixels
    samples : samples per pixel of these images if drawn without the plan
    drawn_samples : samples per pixel that the plan draws; None for the value of ``samples``
    triangles, cull_back_faces, shading_rate : see :class:`LevelOfDetail`

    Raises
    ------
    InputError : invalid sizes or samples
    """

    sizes: tuple[tuple[int, int], ...]
    samples: int
    drawn_samples: int | None = ranged(IntegerRange(1, math.inf), None)
    triangles: int | None = ranged(TRIANGLES, None)
    cull_back_faces: bool = False
    shading_rate: ShadingRate = "sample"

    def __post_init__(self) -> None:
        try:
            sizes = tuple((index(width), index(height)) for width, height in self.sizes)
            numbers = [index(self.samples), *(number for size in sizes for number in size)]
        except (TypeError, ValueError):
            numbers = []
        if len(numbers) < 3 or not 1 <= min(numbers) <= max(numbers) <= MAX_SIDE:
            raise InputError(
                f"planned sizes = {shown(self.sizes)}, samples = {shown(self.samples)}: give "
                f"widths and heights up to {MAX_SIDE}, such as [[512, 512], [1024, 1024]], and a "
                "number of samples"
            )
        check_fields(self, "planned ")
        check_shading_rate("planned shading_rate", self.shading_rate)
        object.__setattr__(self, "sizes", sizes)

    def holds(self, size: tuple[int, int], samples: int) -> bool:
        """Return whether the plan covers an image.

        The samples per pixel must be the planned number; size and aspect ratio must be in the
        planned ranges. One sample per pixel is also covered if the plan draws all triangles and
        back faces: that sample is at the pixel's centre, where every plan's error is measured.
        """
        centres = self.triangles is None and not self.cull_back_faces
        widths, heights = zip(*self.sizes, strict=True)
        shapes = [width / height for width, height in self.sizes]
        return (
            samples in (self.samples, 1 if centres else self.samples)
            and min(widths) <= size[0] <= max(widths)
            and min(heights) <= size[1] <= max(heights)
            and min(shapes) / _SAME_SHAPE <= size[0] / size[1] <= max(shapes) * _SAME_SHAPE
        )

    @property
    def detail(self) -> LevelOfDetail:
        """Level of detail that the plan draws for an image."""
        samples = self.drawn_samples or self.samples
        return LevelOfDetail(samples, self.triangles, self.cull_back_faces, self.shading_rate)

    def __str__(self) -> str:
        extremes = dict.fromkeys((min(self.sizes), max(self.sizes)))
        sizes = " to ".join(f"{width} x {height}" for width, height in extremes)
        return f"{sizes} pixels with {self.samples} sample{'s' if self.samples > 1 else ''}"
