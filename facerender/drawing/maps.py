"""The maps that images read: of shadows, and of surfaces behind refracting parts. No OpenGL here.

The shadow map of a light has the surfaces that are nearest to the light. Two textures that are
derived from it save most of the samples of soft shadows: cones, above which a point sees a whole
light, and tops, the nearest surfaces around a point. ``shaders/host/shadow.glsl`` reads them.

Each connected region of a refracting part, such as a cornea, has a map of the surfaces behind it.
``shaders/host/refraction.glsl`` refracts the view ray and finds the surface that the ray hits.

All maps are kept while only the camera moves."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from facerender.drawing.prepare import Appearance
from facerender.drawing.program import (
    Draw,
    Pass,
    Program,
    Target,
    Uniforms,
    mask_features,
    part_uniforms,
    shade_draw,
)
from facerender.errors import InputError
from facerender.material import Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Area, TriangleSetup
from facerender.mesh.repair import joined
from facerender.scene.light import LightSpace
from facerender.scene.view import View
from facerender.values.vectors import Float, Integers, Size, Vector

MAX_SHADOWS = 16  # lights that cast shadows: one texture holds their maps in a row
_FEWEST_TEXELS, _MAX_TEXELS = 512, 4096  # width and height of a light's shadow map
_ALL_TEXELS = 1 << 24  # of the maps of all lights
_BLOCKS = 256  # width and height of a light's tile in the passes of _cones
_LEVELS = (1, 4, 16, 64)  # blocks per texel of the levels of _tops
_TAPS = 3  # samples of shadow_cones.frag on each side

_MAX_MAPS = 8  # most maps of a refracting part; with more regions, the part has one map
_MARGIN = 1.15  # half the width of a map, in radii of the region
_DEEP = 2.5  # depth of a map below the region's foremost vertex, in half widths of the map
_SIDES = (64, 1024)  # smallest and largest side of a map, in texels

_EMPTY = -1e30  # z of texels without a surface


class Maps:
    """The maps of one image of a view. The geometry of the mesh owns the keys of the passes: a map
    is drawn again only if a key changes.

    look, mesh : the appearance, and the mesh in its pose
    texels : width of each light's shadow map, a power of two; 0 if no light casts a shadow
    regions : regions of each part of the mesh, () for a part that does not refract; () if no part
        refracts, or if refraction is left out
    side : width and height of the map of a region in texels. A texel covers at most half a pixel,
        except in images of an eye alone. Maps that reach behind the camera do not count
    """

    def __init__(
        self, look: Appearance, mesh: Mesh, view: View, size: Size, refracts: bool = True
    ) -> None:
        self.look, self.mesh, self.texels = look, mesh, _shadow_texels(look, view, size)
        self.regions: tuple[tuple[RefractingRegion, ...], ...] = ()
        self.side = 0
        bends = tuple(material.refracts for material in look.materials)
        if not (refracts and any(bends)):
            return
        setups, derived = mesh.setups, mesh.geometry.derived
        make = lambda: tuple(  # noqa: E731
            regions_of(setup, setups) if bent else ()
            for bent, setup in zip(bends, setups, strict=True)
        )
        # The geometry owns the regions: a change of m or of the light leaves them.
        self.regions = derived.of("regions", (mesh.token, bends), make)
        axes = np.array([region.axes for regions in self.regions for region in regions])
        clip = axes @ view.matrix
        clip = clip[np.minimum.reduce(clip[..., 3], 1) > 0.0]
        pixels = clip[..., :2] / clip[..., 3:] * size
        across = pixels[:, 1:] - pixels[:, :1]
        widths = np.add.reduce(across * across, 2)
        widest = math.sqrt(np.maximum.reduce(widths, None, initial=0.0))
        self.side = 1 << math.ceil(math.log2(min(max(2.0 * widest, _SIDES[0]), _SIDES[1])))

    @cached_property
    def uniforms(self) -> Uniforms:
        """Uniforms of all lights, of the environment and of the shadow maps."""
        look = self.look
        uniforms: dict[str, Any] = {"ambient": np.asarray(look.ambient)}
        for light_type, lights in look.lighting.by_type.items():
            uniforms |= light_type.uniforms(lights, look.space)
        if spaces := look.light_spaces:
            uniforms["shadow_view"] = np.array([space.matrix for space in spaces])
            uniforms["shadow_size"] = np.array([(s.tan_radius, s.top, s.scale) for s in spaces])
        if environment := look.environment:
            split = environment.panorama.lights(len(look.lighting.environment))
            uniforms["environment_sh"] = split.coefficients
            uniforms["environment_around"] = environment.scale * split.around
            uniforms["environment_turn"] = environment.turn.T  # OpenGL stores matrices by column
            uniforms["environment_scale"] = environment.scale
            uniforms["environment_size"] = len(environment.panorama.map) - 2
        tiles = {"shadow_tiles": (self.texels, _BLOCKS), "shadow_reach": look.space.reach}
        return uniforms | tiles

    def refracted(self, draws: list[Draw], background: Vector) -> list[Draw]:
        """Return the draws, in which refracting parts show surfaces or the background behind."""
        first = 0
        for index, regions in enumerate(self.regions):
            if regions:
                draws[index] = draws[index].having(
                    f"REFRACTIONS {len(regions)}",
                    refraction_first=first,
                    refraction_view=np.array([region.matrix for region in regions]),
                    refraction_bottom=np.array([region.bottom for region in regions])[:, None],
                    refraction_background=np.asarray(background),
                )
                first += len(regions)
        return draws

    def passes(self, refracted: bool = True) -> list[Pass]:
        """Return the passes that draw the maps.

        refracted : whether to draw the maps of refracting parts, too. A texel of these has the
            radiance of the diffuse term, without subsurface scattering, and the emission of the
            foremost surface behind the part
        """
        look, texels, derived = self.look, self.texels, self.mesh.geometry.derived
        passes = []
        if spaces := look.light_spaces:
            lights = ((space.matrix.tobytes(), space.tan_radius) for space in spaces)
            value: Any = (texels, *map(_cut, look.materials), *lights)
            key = derived.of("shadows", value, object)  # equal while the value is
            target, clear = _target((len(spaces) * texels, texels)), (_EMPTY, 0.0, 0.0, 0.0)
            passes = [Pass("shadow_map", target, _draws(look, texels), clear, key=key)]
            passes += _cones(spaces, texels, key)
        if not (refracted and self.regions):
            return passes
        front: list[Draw] = []
        behind: list[Draw] = []
        program, side = Program("refraction_surface.frag"), self.side
        for part, regions in zip(look.parts, self.regions, strict=True):
            for region in regions:
                area = Area(len(front) * side, 0, side, side)
                front.append(Draw(program, region.uniforms, part, area=area, order=region.faces))
                behind += _behind(look, region, area)
        surface = Target((1,), size=(len(front) * side, side), sampled=True, number=2)
        image = replace(surface, channels=(4,))
        light = tuple(look.lighting.lights), look.ambient, look.environment
        value = side, texels, look.materials, *light, look.shading.slope_filter
        key, clear = derived.of("refraction", value, object), (0.0, 0.0, 0.0, _EMPTY)
        return [
            *passes,
            Pass("refraction_surface", surface, tuple(front), key=key),
            Pass("refraction_map", image, tuple(behind), clear, self.uniforms, key=key),
        ]


def _shadow_texels(look: Appearance, view: View, size: Size) -> int:
    """Return the width of a shadow map. At the mesh's centre, a texel covers at most one pixel,
    unless the limits forbid it. The width depends on the view alone, not on earlier frames: an
    image never depends on what was drawn before it."""
    if not (count := len(look.light_spaces)):
        return 0
    if count > MAX_SHADOWS:
        around = len(look.lighting.environment)
        including = f", including {around} of the environment" if around else ""
        remedy = f"at most {MAX_SHADOWS} may; turn off the other shadows"
        raise InputError(f"{count} lights cast shadows{including}: {remedy}")
    depth = max(float(view.matrix[3, 3]), 1e-3)
    columns = view.matrix[:3, :2]
    across = (columns * columns).sum(axis=0) ** 0.5 * size / depth * look.space.reach  # in pixels
    limit = min(_MAX_TEXELS, 1 << int(math.log2(_ALL_TEXELS / count) / 2.0))
    texels = min(max(float(across.max()), _FEWEST_TEXELS), limit)
    return 1 << math.ceil(math.log2(texels) - 0.25)


def _draws(look: Appearance, texels: int) -> tuple[Draw, ...]:
    draws = []
    for part in look.unblended:
        if part.material.transmission > 0.0:
            continue
        program = Program("shadow_map.frag", "shadow_map.vert", mask_features(part))
        mask_uniforms = part_uniforms(part) if part.alpha == "mask" else {}
        for index, space in enumerate(look.light_spaces):
            uniforms = {**mask_uniforms, "to_light": space.matrix, "top": space.top}
            area = Area(index * texels, 0, texels, texels)
            draws.append(Draw(program, uniforms, part, area=area))
    return tuple(draws)


def _cut(material: Material) -> Hashable:
    """Return all values on which the shadow of a material depends."""
    if material.transmission > 0.0:
        return "no shadow"
    if material.alpha == "opaque":
        return None
    map_ = material.opacity_map, "opacity_map" in material.second_uv
    return material.alpha, material.opacity, material.alpha_cutoff, *map_


def _target(size: Size, number: int = 0) -> Target:
    return Target((1,), size=size, sampled=True, number=number)


def _cones(spaces: Sequence[LightSpace], texels: int, map_key: Hashable) -> list[Pass]:
    """Return the passes that draw the z above which a point sees a whole light.

    Most points see all lights; one fetch then replaces the samples of ``fr_shadow_disc``. The first
    pass draws the largest z of each block of texels. Each further pass widens the result along
    one axis: see ``shaders/host/shadow_cones.frag``.
    """
    widest = max(space.tan_radius for space in spaces) * _BLOCKS / math.sqrt(2.0)
    strides, reached = [1], _TAPS
    while reached < widest:
        strides.append(2 * reached + 1)
        reached += _TAPS * strides[-1]
    size = len(spaces) * _BLOCKS, _BLOCKS
    blocks = Draw(Program("shadow_blocks.frag", "screen.vert"), {"block": texels // _BLOCKS})
    steps: list[list[Draw]] = [[blocks]]
    program = Program("shadow_cones.frag", "screen.vert")
    for stride in [*((length, 0) for length in strides), *((0, length) for length in strides)]:
        steps.append([])
        for left, space in zip(range(0, size[0], _BLOCKS), spaces, strict=True):
            # The pyramid with this slope along the axes contains the cone.
            fall = math.sqrt(2.0) / _BLOCKS / max(space.tan_radius, 1e-3)
            uniforms = {"stride": stride, "left": left, "fall": fall}
            steps[-1].append(Draw(program, uniforms, area=Area(left, 0, _BLOCKS, _BLOCKS)))
    passes = [
        Pass("shadow_cones", _target(size, 1 + number), tuple(draws), key=(map_key, number))
        for number, draws in enumerate(steps)
    ]
    if any(space.tan_radius for space in spaces):  # hard shadows do not search for occluders
        passes.insert(1, _tops(len(spaces), map_key))
    return passes


def _tops(count: int, key: Hashable) -> Pass:
    """Return the pass that draws the largest z around each point, at four scales, for ``top_of`` in
    ``shaders/host/shadow.glsl``. The pass reads the first image of :func:`_cones`."""
    program = Program("shadow_tops.frag", "screen.vert")
    draws, column = [], 0
    for index, size in product(range(count), _LEVELS):
        side = _BLOCKS // size
        uniforms = {"left": index * _BLOCKS, "column": column, "size": size}
        draws.append(Draw(program, uniforms, area=Area(column, 0, side, side)))
        column += side
    return Pass("shadow_tops", _target((column, _BLOCKS)), tuple(draws), key=key)


class RefractingRegion:
    """A connected region of a refracting part, and its map space.

    In map space, z points along the mean normal of the region, and the map covers x and y from -1
    to 1. The deepest vertex of the region is at z = 0. The space is mirrored, as images are.

    setups : triangles of all parts
    faces : (F,) indices of the part's triangles in the region
    matrix : (4, 4) float64, from the renderer's space to map space, for row vectors
    bottom, top : smallest z of the map, and largest z of the region's vertices
    uniforms : of draws into the map
    axes : (4, 4), origin and unit points of map space in the renderer's space, homogeneous
    within : for each part, the indices (F,) of its triangles that may be within the map
    """

    def __init__(self, setup: TriangleSetup, faces: Integers, setups: list[TriangleSetup]) -> None:
        corners = setup.positions[setup.faces[faces]].astype(np.float64)
        axis = _axis(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        across = np.cross(np.eye(3)[int(np.abs(axis).argmin())], axis)
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(across, axis), axis], axis=1)
        points = corners.reshape(-1, 3) @ axes
        low, high = points.min(axis=0), points.max(axis=0)
        middle = np.append(0.5 * (low + high)[:2], low[2])
        half = _MARGIN * max(float(np.linalg.norm((points - middle)[:, :2], axis=1).max()), 1e-6)
        self.faces, self.matrix = faces, np.eye(4)
        self.matrix[:3, :3], self.matrix[3, :3] = axes / half, -middle / half
        self.top = float(high[2] - low[2]) / half
        self.bottom = min(self.top - _DEEP, -0.1)
        near = self.top + 0.01
        depth = np.diag([1.0, 1.0, -2.0 / (near - self.bottom), 1.0])
        depth[3, 2] = (near + self.bottom) / (near - self.bottom)
        self.uniforms = {"view_projection": self.matrix @ depth, "to_map": self.matrix}
        units = np.array([(0, 0, 0, 1), (1, 0, 0, 1), (0, 1, 0, 1), (0, 0, 1, 1)])
        self.axes = units @ np.linalg.inv(self.matrix)
        self.within: list[Integers] = []
        for other in setups:
            positions = other.positions @ self.matrix[:3, :3] + self.matrix[3, :3]
            above = positions > (1.0, 1.0, self.top)
            below = positions < (-1.0, -1.0, self.bottom)
            sides = np.packbits(np.hstack([below, above]), axis=1)[:, 0]  # six bits for each vertex
            a, b, c = (np.take(sides, corner) for corner in other.faces.T)
            self.within.append(np.flatnonzero(a & b & c == 0))


def _axis(normals: Float) -> Float:
    """Return the mean (3,) of normals. The normals of a closed surface cancel out: then the result
    is the mean of the normals that point to the front of the mesh."""
    total, axis = np.linalg.norm(normals, axis=1).sum(), normals.sum(axis=0)
    if np.linalg.norm(axis) < 0.2 * total:
        axis = normals[normals[:, 2] > 0.0].sum(axis=0)
    length = np.linalg.norm(axis)
    return axis / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def _labels(setup: TriangleSetup) -> Integers:
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


def regions_of(setup: TriangleSetup, setups: list[TriangleSetup]) -> tuple[RefractingRegion, ...]:
    """Return the regions of a refracting part of a mesh, from the triangles of all parts."""
    labels = _labels(setup)
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)[: _MAX_MAPS + 1]]
    if len(groups) > _MAX_MAPS:
        groups = [np.arange(len(setup.faces))]
    return tuple(RefractingRegion(setup, group, setups) for group in groups)


def _behind(look: Appearance, region: RefractingRegion, area: Area) -> Iterator[Draw]:
    shading = look.shading.replace(diffuse="lambert", environment_samples=0)
    plain = replace(look, shading=shading)
    camera = np.array([0.0, 0.0, 1e3, 1.0]) @ np.linalg.inv(region.matrix)  # far in front
    for part in look.unblended:
        order = region.within[part.index]
        if part.material.transmission > 0.0 or not len(order):
            continue
        further: dict[str, Any] = {"camera_position": camera, **region.uniforms}
        draw = shade_draw(plain, part, None, 0.0, None, ("BEHIND_REFRACTION",), **further)
        yield replace(draw, area=area, order=order)
