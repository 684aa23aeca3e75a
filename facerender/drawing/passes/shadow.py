"""The shadow map pass, and the pass that draws each light's visible fraction at pixel centres. The
reference reads this fraction."""

from __future__ import annotations

from collections.abc import Hashable
from weakref import ref

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.transparency import BlendedPart, mask_features, unblended
from facerender.drawing.passes.visibility import Visibility
from facerender.drawing.program import (
    SHADOW_MAP,
    Program,
    light_visibility_program,
    part_uniforms,
    scene_uniforms,
    surface_features,
)
from facerender.drawing.resolve import ResolvedScene
from facerender.drawing.triangle_setup import triangle_setup_of
from facerender.errors import InputError
from facerender.scenes.light import LightSpace
from facerender.scenes.material import Material
from facerender.scenes.mesh import drawn_alpha
from facerender.scenes.scene import Scene
from facerender.scenes.view import View
from facerender.shading import Shading

TEXELS = 1024  # width and height of a light's shadow map
MOST = 16  # largest number of lights that cast shadows; one texture holds their maps in a row
_EMPTY = -1e30  # z, in light space, of texels without a surface


def shadow_passes(resolved: ResolvedScene) -> list[Pass]:
    """Return the pass that draws all shadow maps, or [] if no light casts shadows.

    The shadow maps are reused until the mesh, an alpha mask or a light changes. Blended parts, and
    texels that an alpha mask discards, cast no shadow.

    Raises
    ------
    InputError : more than MOST lights cast shadows, or a light with shadows is inside the mesh
    """
    scene = resolved.scene
    spaces = resolved.lighting.spaces(scene.mesh)
    if not spaces:
        return []
    if len(spaces) > MOST:
        raise InputError(
            f"{len(spaces)} lights cast shadows: at most {MOST} may; turn off the other shadows"
        )
    target = Target(size=(len(spaces) * TEXELS, TEXELS), sampled=True, values="number")
    draws = tuple(
        draw for number, space in enumerate(spaces) for draw in _draws(scene, number, space)
    )
    mesh = scene.mesh
    key = (
        *(ref(part) for part in mesh.parts),
        *(_cut(each) for each in mesh.materials),
        *(mesh.center.tobytes(), mesh.radius),
        *(space.matrix.tobytes() for space in spaces),
    )
    return [Pass(SHADOW_MAP, target, draws, (_EMPTY, 0.0, 0.0, 0.0), key=key)]


def _draws(scene: Scene, number: int, space: LightSpace) -> list[Draw]:
    uniforms = {"to_light": space.matrix, "top": space.top}
    area = (number * TEXELS, 0, TEXELS, TEXELS)
    draws = []
    for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
        alpha = drawn_alpha(part, material)
        if alpha == "blend" or material.transmission > 0.0:
            continue
        features = mask_features(surface_features(part, material, Shading()))
        program = Program("shadow_map.frag", "shadow_map.vert", features)
        if alpha == "mask":
            own = {**part_uniforms(part, material), **uniforms}
            draws.append(Draw(program, own, part, material, area=area))
        else:
            draws.append(
                Draw(program, uniforms, setup=triangle_setup_of(part, scene.mesh), area=area)
            )
    return draws


def _cut(material: Material) -> Hashable:
    """Return the values of a material that its shadow depends on, for the ``Pass.key`` of shadow
    maps."""
    if material.transmission > 0.0:
        return "no shadow"
    map_ = material.opacity_map and ref(material.opacity_map)
    own = material.opacity, material.alpha_cutoff, material.by_second("opacity_map")
    return (material.alpha, map_, *own) if material.alpha != "opaque" else None


def light_visibility_pass(
    resolved: ResolvedScene,
    view: View,
    visibility: Visibility | None = None,
    blended_part: BlendedPart | None = None,
) -> Pass:
    """Return the pass that draws the visible fraction of each light that casts shadows.

    The lights are in the order of ``Lighting.lights``.

    visibility : see :func:`shade_pass`
    blended_part : see :func:`surface_pass`
    """
    scene, lighting = resolved.scene, resolved.lighting
    draws = [
        Draw(
            light_visibility_program(part, material, resolved.shading, lighting),
            part_uniforms(part, material),
            part,
            material,
        )
        for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    ]
    uniforms = scene_uniforms(scene, view, lighting)
    shown = unblended(scene, draws) if blended_part is None else blended_part.alone(scene, draws)
    drawn = Pass("light_visibility", Target(colors=MOST // 4), shown, uniforms=uniforms)
    return visibility.shaded(drawn) if visibility else drawn
