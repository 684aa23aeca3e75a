"""The G-buffer pass, drawn by ``shaders/host/gbuffer.frag``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.transparency import BlendedPart, visible_draws
from facerender.drawing.program import Program, scene_uniforms, surface_features
from facerender.drawing.resolve import ResolvedScene
from facerender.scenes.scene import Scene
from facerender.scenes.view import View

if TYPE_CHECKING:
    from facerender.drawing.passes.refraction import Refraction


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
    optional = {
        "lobes": any(material.two_lobes for material in materials),
        "emitted": any(material.emits for material in materials),
        "layer": layer,
    }
    names = [name for name, is_drawn in optional.items() if is_drawn]
    return ("position", "normal", "albedo", "uv", *names)


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
    scene, shading = resolved.scene, resolved.shading
    images, draws = surface_images(scene, blended_part is not None), []
    further = ["SCATTER"] if scatters else []
    further += [f"{name.upper()} {index}" for index, name in enumerate(images[4:], 4)]
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    for number, (part, material) in enumerate(parts, 1):
        features = (
            *surface_features(part, material, shading),
            *("EMISSIVE",) * any(material.emissive),
            # Every program must write all images of the pass, also for parts with one lobe.
            *("TWO_LOBES",) * ("lobes" in images and not material.two_lobes),
            *further,
        )
        program = Program("gbuffer.frag", features=features)
        draws.append(Draw.of_part(program, part, material, part=number))
    if refraction:
        draws = refraction.refracted(draws)
    target = Target(colors=len(images))
    if blended_part is not None:  # two targets alternate, as each layer reads the previous one
        target = replace(target, sampled=True, number=blended_part.layer % 2)
    visible = visible_draws(scene, draws, blended_part)
    return Pass("surface", target, visible, uniforms=scene_uniforms(scene, view))
