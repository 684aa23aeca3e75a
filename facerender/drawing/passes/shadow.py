"""The shadow map pass, and the pass that draws each light's visible fraction at pixel centres. The
reference reads this fraction."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from weakref import ref

import numpy as np

from facerender.drawing.passes import Area, Draw, Pass, Target
from facerender.drawing.passes.transparency import BlendedPart, mask_features, visible_draws
from facerender.drawing.program import (
    Program,
    part_uniforms,
    scene_uniforms,
    shadow_features,
    surface_features,
)
from facerender.drawing.resolve import ResolvedScene
from facerender.errors import InputError
from facerender.scenes.light import LightSpace
from facerender.scenes.material import Material
from facerender.scenes.mesh import drawn_alpha
from facerender.scenes.scene import Scene
from facerender.scenes.view import View
from facerender.shading import Shading

MOST = 16  # largest number of lights that cast shadows; one texture holds their maps in a row
_FEWEST_TEXELS, _MOST_TEXELS = 512, 4096  # width and height of a light's shadow map
_ALL_TEXELS = 1 << 24  # of the maps of all lights
_BLOCKS = 256  # width and height of a light's tile in the passes of _cones
_LEVELS = (1, 4, 16, 64)  # blocks per texel of the levels of _tops
_TAPS = 3  # samples of shadow_cones.frag on each side
_EMPTY = -1e30  # z, in light space, of texels without a surface


def with_shadows(
    resolved: ResolvedScene, view: View, size: tuple[int, int], passes: list[Pass]
) -> list[Pass]:
    """Return the passes that draw all shadow maps, and then `passes` with the maps' uniforms.

    The shadow maps are reused until the mesh, an alpha mask, a light or the maps' size changes.
    Blended parts, and texels that an alpha mask discards, cast no shadow. Raises InputError if more
    than MOST lights cast shadows, or if a light with shadows is inside the mesh.

    size : width and height of the image in pixels
    passes : passes that read the maps
    """
    scene = resolved.scene
    spaces = resolved.lighting.spaces(scene.mesh)
    if not spaces:
        return passes
    if len(spaces) > MOST:
        raise InputError(
            f"{len(spaces)} lights cast shadows: at most {MOST} may; turn off the other shadows"
        )
    texels = _texels(view, size, len(spaces))
    target, mesh = _target((len(spaces) * texels, texels)), scene.mesh
    key = (
        *(ref(part) for part in mesh.parts),
        *(_cut(material) for material in mesh.materials),
        *(mesh.center.tobytes(), mesh.radius),
        *(space.matrix.tobytes() for space in spaces),
    )
    draws, clear = _draws(scene, spaces, texels), (_EMPTY, 0.0, 0.0, 0.0)
    result = [Pass("shadow_map", target, draws, clear, key=key), *_cones(spaces, texels, key)]
    for step in passes:
        uniforms = {**step.uniforms, "shadow_tiles": (texels, _BLOCKS)}
        result.append(replace(step, uniforms=uniforms, key=step.key and (step.key, texels)))
    return result


def _target(size: tuple[int, int], number: int = 0) -> Target:
    return Target(size=size, sampled=True, values="number", number=number)


def _texels(view: View, size: tuple[int, int], count: int) -> int:
    """Return the width of each shadow map, a power of two. At the distance of the mesh's centre, a
    texel covers at most one pixel, unless the limits forbid it.

    count : number of shadow maps
    """
    depth = max(float(view.matrix[3, 3]), 1e-3)
    across = np.linalg.norm(view.matrix[:3, :2], axis=0) * size / depth  # of the map, in pixels
    limit = min(_MOST_TEXELS, 1 << int(math.log2(_ALL_TEXELS / count) / 2.0))
    texels = min(max(float(across.max()), _FEWEST_TEXELS), limit)
    return 1 << math.ceil(math.log2(texels) - 0.25)


def _cones(spaces: list[LightSpace], texels: int, map_key: Hashable) -> list[Pass]:
    """Return the passes that draw the z above which a point sees a whole light.

    Most points see all lights; one fetch then replaces the samples of ``fr_shadow_disc``. The first
    pass draws the largest z of each block of texels. Each further pass widens the result along
    one axis: see ``shaders/host/shadow_cones.frag``.
    """
    key = map_key, texels, *(space.tan_radius for space in spaces)
    widest = max(space.tan_radius for space in spaces) * _BLOCKS / math.sqrt(2.0)
    strides, reached = [1], _TAPS
    while reached < widest:
        strides.append(2 * reached + 1)
        reached += _TAPS * strides[-1]
    size = len(spaces) * _BLOCKS, _BLOCKS
    blocks = Draw(Program("shadow_blocks.frag", "screen.vert"), {"block": texels // _BLOCKS})
    steps: list[tuple[Draw, ...]] = [(blocks,)]
    program = Program("shadow_cones.frag", "screen.vert")
    for stride in [*((length, 0) for length in strides), *((0, length) for length in strides)]:
        cones = []
        for left, space in zip(range(0, size[0], _BLOCKS), spaces, strict=True):
            # The pyramid with this slope along the axes contains the cone.
            fall = math.sqrt(2.0) / _BLOCKS / max(space.tan_radius, 1e-3)
            uniforms = {"stride": stride, "left": left, "fall": fall}
            cones.append(Draw(program, uniforms, area=Area(left, 0, _BLOCKS, _BLOCKS)))
        steps.append(tuple(cones))
    passes = [
        Pass("shadow_cones", _target(size, 1 + number), draws, key=(key, number))
        for number, draws in enumerate(steps)
    ]
    if any(space.tan_radius for space in spaces):  # hard shadows do not search for occluders
        passes.insert(1, _tops(len(spaces), (map_key, texels)))
    return passes


def _tops(count: int, key: Hashable) -> Pass:
    """Return the pass that draws the largest z around each point, at four scales. ``top_of`` in
    ``shaders/host/shadow.glsl`` reads this image. The pass reads the first image of :func:`_cones`.
    """
    program = Program("shadow_tops.frag", "screen.vert")
    draws, column = [], 0
    for number in range(count):
        for size in _LEVELS:
            side = _BLOCKS // size
            uniforms = {"left": number * _BLOCKS, "column": column, "size": size}
            draws.append(Draw(program, uniforms, area=Area(column, 0, side, side)))
            column += side
    return Pass("shadow_tops", _target((column, _BLOCKS)), tuple(draws), key=key)


def _draws(scene: Scene, spaces: list[LightSpace], texels: int) -> tuple[Draw, ...]:
    draws, shading = [], Shading()
    for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
        alpha = drawn_alpha(part, material)
        if alpha == "blend" or material.transmission > 0.0:
            continue
        features = mask_features(surface_features(part, material, shading))
        program = Program("shadow_map.frag", "shadow_map.vert", features)
        mask = material if alpha == "mask" else None
        mask_uniforms = part_uniforms(part, mask) if mask else {}
        for number, space in enumerate(spaces):
            uniforms = {**mask_uniforms, "to_light": space.matrix, "top": space.top}
            area = Area(number * texels, 0, texels, texels)
            draws.append(Draw(program, uniforms, part, mask, area=area))
    return tuple(draws)


def _cut(material: Material) -> Hashable:
    """Return the values of a material that its shadow depends on, for the ``Pass.key`` of shadow
    maps."""
    if material.transmission > 0.0:
        return "no shadow"
    map_ = material.opacity_map and ref(material.opacity_map)
    mask_values = material.opacity, material.alpha_cutoff, material.by_second("opacity_map")
    return (material.alpha, map_, *mask_values) if material.alpha != "opaque" else None


def light_visibility_pass(
    resolved: ResolvedScene, view: View, blended_part: BlendedPart | None
) -> Pass:
    """Return the pass that draws the visible fraction of each light that casts shadows, in the
    order of ``Lighting.lights``.

    blended_part : see :func:`surface_pass`
    """
    scene, lighting, draws = resolved.scene, resolved.lighting, []
    for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
        features = surface_features(part, material, resolved.shading) + shadow_features(lighting)
        program = Program("light_visibility.frag", features=features, lights=lighting.groups)
        draws.append(Draw.of_part(program, part, material))
    uniforms = scene_uniforms(scene, view, lighting)
    visible = visible_draws(scene, draws, blended_part)
    return Pass("light_visibility", Target(colors=MOST // 4), visible, uniforms=uniforms)
