"""Shadow maps. A light's map has the surfaces that are nearest to the light. Two textures that are
derived from the maps save most of the samples of soft shadows: cones, above which a point sees a
whole light, and tops, the nearest surfaces around a point. ``shaders/host/shadow.glsl`` reads them.

The images are kept until the pose, an alpha mask, a light or the size of the maps changes."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from itertools import product

from facerender.drawing.passes import Draw, Pass, Target, mask_features
from facerender.drawing.prepare import Appearance
from facerender.drawing.program import Program, Uniforms, part_uniforms, surface_features
from facerender.errors import InputError
from facerender.material import Material
from facerender.mesh.mesh import Mesh
from facerender.mesh.setup import Area
from facerender.scene.light import LightSpace
from facerender.scene.shading import Shading
from facerender.scene.view import View

MOST = 16  # largest number of lights that cast shadows; one texture holds their maps in a row
_FEWEST_TEXELS, _MOST_TEXELS = 512, 4096  # width and height of a light's shadow map
_ALL_TEXELS = 1 << 24  # of the maps of all lights
_BLOCKS = 256  # width and height of a light's tile in the passes of _cones
_LEVELS = (1, 4, 16, 64)  # blocks per texel of the levels of _tops
_TAPS = 3  # samples of shadow_cones.frag on each side
_EMPTY = -1e30  # z, in light space, of texels without a surface


def shadow_texels(look: Appearance, view: View, size: tuple[int, int]) -> int:
    """Return the width of each light's shadow map, a power of two; 0 if no light casts a shadow. At
    the mesh's centre, a texel covers at most one pixel, unless the limits forbid it.

    The width depends on the view alone, not on earlier frames: an image never depends on what was
    drawn before it. Raises InputError if more than MOST lights cast shadows, or if a light with
    shadows is inside the mesh.
    """
    if not (count := len(look.light_spaces)):
        return 0
    if count > MOST:
        raise InputError(
            f"{count} lights cast shadows: at most {MOST} may; turn off the other shadows"
        )
    depth = max(float(view.matrix[3, 3]), 1e-3)
    columns = view.matrix[:3, :2]
    across = (columns * columns).sum(axis=0) ** 0.5 * size / depth * look.space.reach  # in pixels
    limit = min(_MOST_TEXELS, 1 << int(math.log2(_ALL_TEXELS / count) / 2.0))
    texels = min(max(float(across.max()), _FEWEST_TEXELS), limit)
    return 1 << math.ceil(math.log2(texels) - 0.25)


def shadow_uniforms(look: Appearance, texels: int) -> Uniforms:
    """Return the uniforms of the passes that read the shadow maps."""
    return {"shadow_tiles": (texels, _BLOCKS), "shadow_reach": look.space.reach}


def shadow_passes(look: Appearance, mesh: Mesh, texels: int) -> list[Pass]:
    """Return the passes that draw the shadow maps, and what is derived from the maps. Blended
    parts, and texels that an alpha mask discards, cast no shadow.

    mesh : any pose of the mesh
    """
    if not (spaces := look.light_spaces):
        return []
    lights = ((space.matrix.tobytes(), space.tan_radius) for space in spaces)
    value = texels, *map(_cut, look.materials), *lights
    key = mesh.geometry.derived.of("shadows", value, object)  # equal while the value is
    target, clear = _target((len(spaces) * texels, texels)), (_EMPTY, 0.0, 0.0, 0.0)
    shadow_map = Pass("shadow_map", target, _draws(look, texels), clear, key=key)
    return [shadow_map, *_cones(spaces, texels, key)]


def _target(size: tuple[int, int], number: int = 0) -> Target:
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
    for number, size in product(range(count), _LEVELS):
        side = _BLOCKS // size
        uniforms = {"left": number * _BLOCKS, "column": column, "size": size}
        draws.append(Draw(program, uniforms, area=Area(column, 0, side, side)))
        column += side
    return Pass("shadow_tops", _target((column, _BLOCKS)), tuple(draws), key=key)


def _draws(look: Appearance, texels: int) -> tuple[Draw, ...]:
    draws, shading = [], Shading()
    for part in look.unblended:
        if part.material.transmission > 0.0:
            continue
        features = mask_features(surface_features(part, shading))
        program = Program("shadow_map.frag", "shadow_map.vert", features)
        mask_uniforms = part_uniforms(part) if part.alpha == "mask" else {}
        for number, space in enumerate(look.light_spaces):
            uniforms = {**mask_uniforms, "to_light": space.matrix, "top": space.top}
            area = Area(number * texels, 0, texels, texels)
            draws.append(Draw(program, uniforms, part, area=area))
    return tuple(draws)


def _cut(material: Material) -> Hashable:
    """Return what the shadow of a material depends on, for the ``Pass.key`` of shadow maps."""
    if material.transmission > 0.0:
        return "no shadow"
    if material.alpha == "opaque":
        return None
    map_ = material.opacity_map, material.by_second("opacity_map")
    return material.alpha, material.opacity, material.alpha_cutoff, *map_
