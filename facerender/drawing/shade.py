"""The passes that shade: the G-buffer (``shaders/host/gbuffer.frag``), radiance of all parts under
all lights (``shade.frag``), subsurface scattering (``scatter.frag``), and shadow maps.

Scattering reads the images of the shading pass: radiance, irradiance, position and albedo. The
reference reads each light's visible fraction at pixel centres."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from facerender.drawing.passes import (
    BlendedPart,
    Draw,
    Pass,
    Target,
    blended_parts,
    mask_features,
    unblended,
    visible_draws,
)
from facerender.drawing.prepare import Appearance, ResolvedScene
from facerender.drawing.program import (
    Program,
    part_uniforms,
    scene_uniforms,
    shade_program,
    shadow_features,
    surface_features,
)
from facerender.errors import InputError
from facerender.material import Material
from facerender.mesh.setup import Area
from facerender.scene.light import LightSpace
from facerender.scene.scattering import Scattering
from facerender.scene.scene import Only, Scene
from facerender.scene.shading import Shading
from facerender.scene.view import View
from facerender.terms.transport import scatter_uniforms
from facerender.values.vectors import Vector

if TYPE_CHECKING:
    from facerender.drawing.refraction import Refraction


def surface_images(scene: Scene, layer: bool) -> tuple[str, ...]:
    """Return the names of the images of a G-buffer in drawing order:

    - position: position, index of the part plus 1
    - normal: normal, m
    - albedo: albedo, specular weight
    - uv: texture coordinates, occlusion, and either facing (if a part scatters) or opacity (of a
      layer)
    - lobes: m of the second lobe and weight of the first lobe, if a part has two lobes
    - emitted: emission, with the refracted light, if a part emits or refracts light
    - layer: depth, and index of the triangle in drawing order, of a layer

    layer : whether the G-buffer is one layer of a blended part
    """
    materials = scene.mesh.materials
    lobes = ("lobes",) * any(material.two_lobes for material in materials)
    emitted = ("emitted",) * any(material.emits for material in materials)
    return ("position", "normal", "albedo", "uv", *lobes, *emitted, *("layer",) * layer)


def surface_pass(
    resolved: ResolvedScene,
    view: View,
    scatters: bool,
    blended_part: BlendedPart | None,
    refraction: Refraction | None,
) -> Pass:
    """Return the pass that draws the G-buffer of a scene, see :func:`surface_images`.

    scatters : whether to draw facing, the cosine between the mesh's normal and the direction to
        the camera
    blended_part : part of which one layer is drawn; None: all parts that are not blended are drawn
    refraction : refraction of the scene; None if no part refracts
    """
    shading = resolved.appearance.shading
    images, draws = surface_images(resolved.scene, blended_part is not None), []
    further = [f"{name.upper()} {index}" for index, name in enumerate(images[4:], 4)]
    for part in resolved.appearance.parts:
        features = (
            *surface_features(part, shading),
            *("EMISSIVE",) * any(part.material.emissive),
            # Every program must write all images of the pass, also for parts with one lobe.
            *("TWO_LOBES",) * ("lobes" in images and not part.material.two_lobes),
            *("SCATTER",) * scatters,
            *further,
        )
        program = Program("gbuffer.frag", features=features)
        draws.append(Draw.of_part(program, part, part=part.index + 1))
    if refraction:
        draws = refraction.refracted(draws)
    target = Target(colors=len(images))
    if blended_part is not None:  # two targets alternate, as each layer reads the previous one
        target = replace(target, sampled=True, number=blended_part.layer % 2)
    visible = visible_draws(draws, blended_part)
    return Pass("surface", target, visible, uniforms=scene_uniforms(resolved, view, lights=False))


def shade_pass(
    resolved: ResolvedScene,
    view: View,
    samples: int,
    only: Only | None = None,
    scattering: Scattering | None = None,
    apart: bool = False,
    refraction: Refraction | None = None,
) -> Pass:
    """Return the pass that shades a scene. Blended parts are drawn last.

    only : term to draw, "specular" or "diffuse"; None for the whole image
    scattering : scattering of the scene. If given, the pass also draws the input images of the
        scatter pass, and omits background and blended parts
    apart : whether to draw only the input images of the scatter pass
    refraction : refraction of the scene; None to leave out the light that parts refract

    For errors see ``Appearance.terms`` and ``Appearance.slopes``.
    """
    scene, draws = resolved.scene, _shade_draws(resolved, samples, only)
    if refraction:
        draws = refraction.refracted(draws)
    uniforms = scene_uniforms(resolved, view)
    if scattering:
        for index, (draw, number) in enumerate(zip(draws, scattering.numbers, strict=True)):
            program = draw.program.having("SCATTER", *("APART",) * apart)
            values = {**draw.uniforms, "profile": number}
            draws[index] = replace(draw, program=program, uniforms=values)
        target = Target(3 if apart else 4, samples, sampled=True)
        names = ("albedo", "light", "place") if apart else ("image", "light", "place", "albedo")
        return Pass(names[0], target, unblended(draws), uniforms=uniforms, others=names[1:])
    background = (only is None and scene.background) or (0.0, 0.0, 0.0)
    blends = (
        replace(draws[blended.part], order=blended.order, depth="blend")
        for blended in blended_parts(resolved, view)
    )
    all_draws = (*unblended(draws), *blends)
    return Pass("shade", Target(samples=samples), all_draws, (*background, 0.0), uniforms)


def _shade_draws(resolved: ResolvedScene, samples: int, only: Only | None) -> list[Draw]:
    """Return the draws of all parts, from the cache if a frame with this appearance was drawn."""
    look, key = resolved.appearance, ("shade", samples, only)
    if key not in look.draws:
        specular, count = only != "diffuse", len(look.parts)
        slopes = look.slopes if specular else [(0.0, 0.0)] * count
        terms = look.terms if specular and look.lighting.shining else [None] * count
        draws = []
        for part, term, (smallest_m, _) in zip(look.parts, terms, slopes, strict=True):
            program = shade_program(resolved, part, term, smallest_m, only)
            if samples > 1 and "ALPHA_MASK" in program.features:
                program = program.having(f"TO_COVERAGE {samples}")
            draws.append(Draw.of_part(program, part))
        look.draws[key] = draws
    return [*look.draws[key]]


def scatter_pass(
    view: View,
    scattering: Scattering,
    samples: int,
    background: Vector | None = None,
    several: bool = False,
    area: Area | None = None,
) -> Pass:
    """Return the pass that adds subsurface scattering to an image.

    samples : subsurface samples per pixel
    background : linear RGB behind the image; None if the image already contains the background
    several : whether the image has several samples per pixel
    area : rectangle of the image that contains the mesh; None for the whole image
    """
    behind = background or (0.0, 0.0, 0.0)
    shared = {
        "camera_position": view.position,
        "forward": view.forward,
        "pixels": scattering.pixels,
        "background": np.asarray(behind),
    }
    draws = [Draw(Program("background.frag", "screen.vert"), {"depth": 1.0}, area=area)]
    mask_program = Program("scatter_mask.frag", "screen.vert", ("SEVERAL",) * several)
    for number, gaussians in enumerate(scattering.profiles, 1):
        mask = {"profile": number, "depth": 1.0 / (1.0 + number)}
        draws.append(Draw(mask_program, mask, area=area, depth="mark"))
        counts = f"FR_SCATTER_SAMPLES {samples}", f"FR_SCATTER_GAUSSIANS {len(gaussians)}"
        program = Program("scatter.frag", "screen.vert", counts + mask_program.features)
        uniforms = {**mask, **scatter_uniforms(gaussians, samples, scattering.millimetres)}
        draws.append(Draw(program, uniforms, area=area, depth="marked"))
    return Pass("scatter", Target(), tuple(draws), (*behind, 0.0), shared)


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

    passes : passes that read the maps
    """
    mesh, look = resolved.scene.mesh, resolved.appearance
    if not (spaces := look.light_spaces):
        return passes
    if len(spaces) > MOST:
        raise InputError(
            f"{len(spaces)} lights cast shadows: at most {MOST} may; turn off the other shadows"
        )
    texels = _texels(view, size, len(spaces), mesh.space.reach)
    lights = ((space.matrix.tobytes(), space.tan_radius) for space in spaces)
    value = mesh.token, mesh.space, texels, *map(_cut, mesh.materials), *lights
    shadows = mesh.geometry.derived.of("shadows", value, lambda: _shadow_passes(look, texels))
    result: list[Pass] = [*shadows]
    maps = {"shadow_tiles": (texels, _BLOCKS), "shadow_reach": mesh.space.reach}
    for step in passes:
        uniforms = {**step.uniforms, **maps}
        result.append(replace(step, uniforms=uniforms, key=step.key and (step.key, texels)))
    return result


def _shadow_passes(look: Appearance, texels: int) -> list[Pass]:
    """Return the passes that draw the shadow maps, and what is derived from the maps."""
    spaces, key = look.light_spaces, object()
    target, clear = _target((len(spaces) * texels, texels)), (_EMPTY, 0.0, 0.0, 0.0)
    shadow_map = Pass("shadow_map", target, _draws(look, texels), clear, key=key)
    return [shadow_map, *_cones(spaces, texels, key)]


def _target(size: tuple[int, int], number: int = 0) -> Target:
    return Target(size=size, sampled=True, values="number", number=number)


def _texels(view: View, size: tuple[int, int], count: int, reach: float) -> int:
    """Return the width of each of `count` shadow maps of a sphere with radius `reach`, a power of
    two. At the mesh's centre, a texel covers at most one pixel, unless the limits forbid it."""
    depth = max(float(view.matrix[3, 3]), 1e-3)
    across = np.linalg.norm(view.matrix[:3, :2], axis=0) * size / depth * reach  # in pixels
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
        Pass("shadow_cones", _target(size, 1 + number), tuple(draws), key=(key, number))
        for number, draws in enumerate(steps)
    ]
    if any(space.tan_radius for space in spaces):  # hard shadows do not search for occluders
        passes.insert(1, _tops(len(spaces), (map_key, texels)))
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


def light_visibility_pass(
    resolved: ResolvedScene, view: View, blended_part: BlendedPart | None
) -> Pass:
    """Return the pass that draws the visible fraction of each light that casts shadows, in the
    order of ``Lighting.lights``. For ``blended_part`` see :func:`surface_pass`."""
    look, draws = resolved.appearance, []
    for part in look.parts:
        features = surface_features(part, look.shading) + shadow_features(look.lighting)
        program = Program("light_visibility.frag", features=features, lights=look.lighting.groups)
        draws.append(Draw.of_part(program, part))
    uniforms = scene_uniforms(resolved, view)
    visible = visible_draws(draws, blended_part)
    return Pass("light_visibility", Target(colors=MOST // 4), visible, uniforms=uniforms)
