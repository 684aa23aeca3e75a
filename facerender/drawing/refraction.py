"""Refraction. Each connected region of a refracting part, such as a cornea, has a map of the
surfaces behind it. ``shaders/host/refraction.glsl`` refracts the view ray and finds in this map the
surface that the ray hits. No OpenGL here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.prepare import Appearance
from facerender.drawing.program import Program, Uniforms, shade_program
from facerender.mesh.mesh import Mesh
from facerender.mesh.repair import joined
from facerender.mesh.setup import Area, TriangleSetup
from facerender.scene.view import View
from facerender.values.vectors import Vector

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_EMPTY = -1e30  # z of texels without a surface
_MOST = 8  # most maps of a part; with more regions, the part has one map
_MARGIN = 1.15  # half the width of a map, in radii of the region
_DEEP = 2.5  # depth of a map below the region's foremost vertex, in half widths of the map
_SIDES = (64, 1024)  # smallest and largest side of a map, in texels


class Region:
    """A connected region of a refracting part, and its map space.

    In map space, z points along the mean normal of the region, and the map covers x and y from -1
    to 1. The deepest vertex of the region is at z = 0. The space is mirrored, as images are.

    faces : (F,) indices of the part's triangles in the region
    matrix : (4, 4) float64, from the renderer's space to map space, for row vectors
    bottom, top : smallest z of the map, and largest z of the region's vertices
    uniforms : of draws into the map
    axes : (4, 4), origin and unit points of map space in the renderer's space, homogeneous
    within : for each part, the indices (F,) of its triangles that may be within the map
    """

    def __init__(self, setup: TriangleSetup, faces: Numbers, mesh: Mesh) -> None:
        corners = setup.positions[setup.faces[faces]].astype(np.float64)
        axis = _axis(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        across = np.cross(np.eye(3)[int(np.abs(axis).argmin())], axis)
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(across, axis), axis], axis=1)
        places = corners.reshape(-1, 3) @ axes
        low, high = places.min(axis=0), places.max(axis=0)
        middle = np.append(0.5 * (low + high)[:2], low[2])
        half = _MARGIN * max(float(np.linalg.norm((places - middle)[:, :2], axis=1).max()), 1e-6)
        self.faces, self.matrix = faces, np.eye(4)
        self.matrix[:3, :3], self.matrix[3, :3] = axes / half, -middle / half
        self.top = float(high[2] - low[2]) / half
        self.bottom = min(self.top - _DEEP, -0.1)
        near = self.top + 0.01
        depth = np.diag([1.0, 1.0, -2.0 / (near - self.bottom), 1.0])
        depth[3, 2] = (near + self.bottom) / (near - self.bottom)
        self.uniforms = {"view_projection": self.matrix @ depth, "to_map": self.matrix}
        points = np.array([(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 1), (0, 0, 1, 1)])
        self.axes = points @ np.linalg.inv(self.matrix)
        self.within = [self._within(setup) for setup in mesh.setups]

    def _within(self, setup: TriangleSetup) -> Numbers:
        positions = setup.positions @ self.matrix[:3, :3] + self.matrix[3, :3]
        high = positions > (1.0, 1.0, self.top)
        low = positions < (-1.0, -1.0, self.bottom)
        sides = np.packbits(np.hstack([low, high]), axis=1)[:, 0]  # six bits for each vertex
        a, b, c = (np.take(sides, corner) for corner in setup.faces.T)
        return np.flatnonzero(a & b & c == 0)


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


def regions_of(setup: TriangleSetup, mesh: Mesh) -> tuple[Region, ...]:
    """Return the regions of a refracting part of a mesh."""
    labels = _labels(setup)
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)[: _MOST + 1]]
    if len(groups) > _MOST:
        groups = [np.arange(len(setup.faces))]
    return tuple(Region(setup, group, mesh) for group in groups)


class Refraction:
    """The maps of a scene's refracting parts, for one image of a view.

    parts : regions of each part of the mesh; () for a part that does not refract
    side : width and height of a map in texels. A texel covers at most half a pixel, except in
        images of an eye alone. Maps that reach behind the camera do not count
    background : linear RGB where nothing is behind a refracting part
    """

    def __init__(
        self, look: Appearance, mesh: Mesh, view: View, size: tuple[int, int], background: Vector
    ) -> None:
        refracts = [material.refracts for material in look.materials]
        make = lambda: tuple(  # noqa: E731
            regions_of(setup, mesh) if active else ()
            for active, setup in zip(refracts, mesh.setups, strict=True)
        )
        # The geometry owns the regions: a change of m or of the light leaves them.
        self.parts: tuple[tuple[Region, ...], ...] = mesh.geometry.derived.of(
            "regions", (mesh.token, refracts), make
        )
        axes = np.array([region.axes for regions in self.parts for region in regions])
        clip = axes @ view.matrix
        clip = clip[np.minimum.reduce(clip[..., 3], 1) > 0.0]
        places = clip[..., :2] / clip[..., 3:] * size
        across = places[:, 1:] - places[:, :1]
        widths = np.add.reduce(across * across, 2)
        pixels = math.sqrt(np.maximum.reduce(widths, None, initial=0.0))
        self.side = 1 << math.ceil(math.log2(min(max(2.0 * pixels, _SIDES[0]), _SIDES[1])))
        self.background = np.asarray(background)

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

    def passes(self, look: Appearance, mesh: Mesh, shared: Uniforms, texels: int) -> list[Pass]:
        """Return the passes that draw the maps, which are kept until the scene changes.

        A texel of a map has the radiance of the diffuse term, without subsurface scattering, and
        the emission of the foremost surface behind the refracting part.

        shared : uniforms of the lights and of their shadow maps
        texels : width of a shadow map
        """
        front: list[Draw] = []
        behind: list[Draw] = []
        program, side = Program("refraction_surface.frag"), self.side
        for part, regions in zip(look.parts, self.parts, strict=True):
            for region in regions:
                area = Area(len(front) * side, 0, side, side)
                front.append(Draw(program, region.uniforms, part, area=area, order=region.faces))
                behind += _behind(look, region, area)
        surface = Target((1,), size=(len(front) * side, side), sampled=True, number=2)
        image = replace(surface, channels=(4,))
        light = look.lights, look.lighting.order, look.ambient, look.environment
        value = side, texels, look.materials, *light, look.shading.slope_filter
        key = mesh.geometry.derived.of("refraction", value, object)  # equal while the value is
        clear = (0.0, 0.0, 0.0, _EMPTY)
        return [
            Pass("refraction_surface", surface, tuple(front), key=key),
            Pass("refraction_map", image, tuple(behind), clear, shared, key=key),
        ]


def _behind(look: Appearance, region: Region, area: Area) -> Iterator[Draw]:
    """Yield the draws of the surfaces behind a region."""
    shading = look.shading.replace(diffuse="lambert", environment_samples=0)
    plain = replace(look, shading=shading)
    camera = np.array([0.0, 0.0, 1e3, 1.0]) @ np.linalg.inv(region.matrix)  # far in front
    for part in look.unblended:
        order = region.within[part.index]
        if part.material.transmission > 0.0 or not len(order):
            continue
        program = shade_program(plain, part, term=None, smallest_m=0.0).having("BEHIND_REFRACTION")
        draw = Draw.of_part(program, part, camera_position=camera[:3], **region.uniforms)
        yield replace(draw, area=area, order=order)
