"""Refraction. Each connected region of a refracting part, such as a cornea, has a map of the
surfaces behind it. ``shaders/host/refraction.glsl`` refracts the view ray and finds in this map the
surface that the ray hits. No OpenGL here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.prepare import ResolvedScene
from facerender.drawing.program import Program, scene_uniforms, shade_program
from facerender.mesh.repair import joined
from facerender.mesh.setup import Area, TriangleSetup
from facerender.scene.view import View

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_EMPTY = -1e30  # z of texels without a surface
_MOST = 8  # most maps of a part; with more regions, the part has one map
_MARGIN = 1.15  # half the width of a map, in radii of the region
_DEEP = 2.5  # depth of a map below the region's foremost vertex, in half widths of the map
_SIDES = (64, 1024)  # smallest and largest side of a map, in texels


@dataclass(frozen=True, eq=False)
class Region:
    """A connected region of a refracting part, and its map space.

    In map space, z points along the mean normal of the region, and the map covers x and y from -1
    to 1. The deepest vertex of the region is at z = 0. The space is mirrored, as images are.

    matrix : (4, 4) float64, from the renderer's space to map space, for row vectors
    faces : (F,) indices of the part's triangles in the region
    top : largest z of the region's vertices
    """

    matrix: Floats
    faces: Numbers
    top: float

    @classmethod
    def of(cls, setup: TriangleSetup, faces: Numbers) -> Region:
        """Return the region that consists of the given triangles of a part."""
        corners = setup.positions[setup.faces[faces]].astype(np.float64)
        axis = _axis(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        across = np.cross(np.eye(3)[int(np.abs(axis).argmin())], axis)
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(across, axis), axis], axis=1)
        places = corners.reshape(-1, 3) @ axes
        low, high = places.min(axis=0), places.max(axis=0)
        middle = np.append(0.5 * (low + high)[:2], low[2])
        half = _MARGIN * max(float(np.linalg.norm((places - middle)[:, :2], axis=1).max()), 1e-6)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = axes / half, -middle / half
        return cls(matrix, faces, float(high[2] - low[2]) / half)

    @property
    def bottom(self) -> float:
        """Smallest z of the map."""
        return min(self.top - _DEEP, -0.1)

    @property
    def clip(self) -> Floats:
        """Matrix (4, 4) from the renderer's space to clip space, for row vectors."""
        near = self.top + 0.01
        depth = np.diag([1.0, 1.0, -2.0 / (near - self.bottom), 1.0])
        depth[3, 2] = (near + self.bottom) / (near - self.bottom)
        return np.asarray(self.matrix @ depth)

    def within(self, setup: TriangleSetup) -> Numbers:
        """Return the indices of a part's triangles that may be within the map."""
        positions = setup.positions @ self.matrix[:3, :3] + self.matrix[3, :3]
        high = positions > (1.0, 1.0, self.top)
        low = positions < (-1.0, -1.0, self.bottom)
        sides = np.packbits(np.hstack([low, high]), axis=1)[:, 0]  # six bits for each vertex
        a, b, c = (np.take(sides, corner) for corner in setup.faces.T)
        return np.flatnonzero(a & b & c == 0)

    def pixels(self, view: Floats, size: tuple[int, int]) -> float:
        """Return the width of the map in pixels of an image, where it is widest. For the parameters
        see :meth:`TriangleSetup.area`."""
        back = np.linalg.inv(self.matrix)
        points = np.array([(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 1), (0, 0, 1, 1)]) @ back
        clip = points @ view
        if clip[:, 3].min() <= 0.0:  # behind the camera
            return 0.0
        places = clip[:, :2] / clip[:, 3:] * size
        return float(np.linalg.norm(places[1:] - places[0], axis=1).max())


def _axis(normals: Floats) -> Floats:
    """Return the mean (3,) of normals. The normals of a closed surface cancel out: then the result
    is the mean of the normals that point to the front of the mesh."""
    total, axis = np.linalg.norm(normals, axis=1).sum(), normals.sum(axis=0)
    if np.linalg.norm(axis) < 0.2 * total:
        axis = normals[normals[:, 2] > 0.0].sum(axis=0)
    length = np.linalg.norm(axis)
    return axis / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def _labels(setup: TriangleSetup) -> Numbers:
    """Return a label for each triangle, (F,). Connected triangles have the same label, and so have
    regions whose bounding boxes overlap, such as the front and the back of a shell."""
    corners = np.unique(setup.positions, axis=0, return_inverse=True)[1].reshape(-1)[setup.faces]
    labels = joined(np.asarray(corners), int(corners.max()) + 1)[corners[:, 0]]
    names, labels = np.unique(labels, return_inverse=True)
    low, high = np.full((2, len(names), 3), np.inf)
    points = setup.positions[setup.faces]
    np.minimum.at(low, labels, points.min(axis=1))
    np.minimum.at(high, labels, -points.max(axis=1))
    if len(names) > 1000:
        return np.asarray(labels)
    overlap = (low[:, None] <= -high[None]).all(axis=-1)
    pairs = np.argwhere(overlap & overlap.T)
    return np.asarray(joined(pairs, len(names))[labels])


def regions_of(setup: TriangleSetup) -> tuple[Region, ...]:
    """Return the regions of a refracting part."""
    labels = _labels(setup)
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)[: _MOST + 1]]
    if len(groups) > _MOST:
        groups = [np.arange(len(setup.faces))]
    return tuple(Region.of(setup, group) for group in groups)


@dataclass(frozen=True, eq=False)
class Refraction:
    """The maps of a scene's refracting parts, for one image.

    parts : regions of each part of the mesh; () for a part that does not refract
    side : width and height of a map in texels
    background : linear RGB where nothing is behind a refracting part
    """

    parts: tuple[tuple[Region, ...], ...]
    side: int
    background: Floats

    @classmethod
    def of(cls, resolved: ResolvedScene, view: View, size: tuple[int, int]) -> Refraction:
        """Return the maps for an image of a view. A texel covers at most half a pixel, except in
        images of an eye alone."""
        mesh, look = resolved.scene.mesh, resolved.appearance
        refracting = [material.refracts for material in mesh.materials]
        setups = [*compress(mesh.setups, refracting)]
        regions = iter(look.draws.of("regions", setups, lambda: [*map(regions_of, setups)]))
        parts = tuple(next(regions) if refracts else () for refracts in refracting)
        pixels = max(region.pixels(view.matrix, size) for regions in parts for region in regions)
        side = 2 ** int(np.ceil(np.log2(np.clip(2.0 * pixels, *_SIDES))))
        return cls(parts, side, np.asarray(resolved.scene.background or (0.0, 0.0, 0.0)))

    def refracted(self, draws: Sequence[Draw]) -> list[Draw]:
        """Return the draws of all parts, in which refracting parts show what is behind them."""
        changed, first = [*draws], 0
        for index, (draw, regions) in enumerate(zip(draws, self.parts, strict=True)):
            if not regions:
                continue
            program = draw.program.having(f"REFRACTIONS {len(regions)}")
            uniforms = {
                **draw.uniforms,
                "refraction_first": first,
                "refraction_view": np.array([region.matrix for region in regions]),
                "refraction_bottom": np.array([region.bottom for region in regions])[:, None],
                "refraction_background": self.background,
            }
            changed[index] = replace(draw, program=program, uniforms=uniforms)
            first += len(regions)
        return changed

    def passes(self, resolved: ResolvedScene) -> list[Pass]:
        """Return the passes that draw the maps, which are reused until the scene changes.

        A texel of a map has the radiance of the diffuse term, without subsurface scattering, and
        the emission of the foremost surface behind the refracting part.
        """
        mesh, look = resolved.scene.mesh, resolved.appearance
        light = look.lights, look.lighting.order, look.ambient, look.environment
        scene = mesh.token, mesh.space, mesh.materials, *light, look.shading.slope_filter
        value, make = (*scene, self.side), lambda: self._passes(resolved)
        passes: list[Pass] = mesh.geometry.derived.of("refraction", value, make)
        return passes

    def _passes(self, resolved: ResolvedScene) -> list[Pass]:
        look = resolved.appearance
        front: list[Draw] = []
        behind: list[Draw] = []
        program, side = Program("refraction_surface.frag"), self.side
        for part, regions in zip(look.parts, self.parts, strict=True):
            for region in regions:
                area = Area(len(front) * side, 0, side, side)
                uniforms = {"view_projection": region.clip, "to_map": region.matrix}
                front.append(Draw(program, uniforms, part, area=area, order=region.faces))
                behind += _behind(resolved, region, area)
        size = len(front) * side, side
        surface = Target(size=size, sampled=True, values="number", number=2)
        map_target = Target(size=size, sampled=True, number=2)
        shared = scene_uniforms(resolved, _NOWHERE)
        clear, key = (0.0, 0.0, 0.0, _EMPTY), object()
        return [
            Pass("refraction_surface", surface, tuple(front), key=key),
            Pass("refraction_map", map_target, tuple(behind), clear, shared, key=key),
        ]


_NOWHERE = View(np.zeros(3), np.zeros(3), np.eye(4))


def _behind(resolved: ResolvedScene, region: Region, area: Area) -> Iterator[Draw]:
    """Yield the draws of the surfaces behind a region."""
    shading = resolved.appearance.shading.replace(diffuse="lambert", environment_samples=0)
    plain = replace(resolved, appearance=replace(resolved.appearance, shading=shading))
    for part in resolved.appearance.unblended:
        order = region.within(resolved.scene.mesh.setups[part.index])
        if part.material.transmission > 0.0 or not len(order):
            continue
        program = shade_program(plain, part, term=None, smallest_m=0.0)
        program = program.having("BEHIND_REFRACTION")
        camera = np.array([0.0, 0.0, 1e3, 1.0]) @ np.linalg.inv(region.matrix)  # far in front
        uniforms = {"view_projection": region.clip, "to_map": region.matrix}
        draw = Draw.of_part(program, part, camera_position=camera[:3], **uniforms)
        yield replace(draw, area=area, order=order)
