"""What shading reads at each pixel's centre, drawn by ``shaders/host/gbuffer.frag``."""

from __future__ import annotations

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.transparency import BlendedPart, unblended
from facerender.drawing.passes.visibility import Visibility
from facerender.drawing.program import (
    Program,
    part_uniforms,
    scene_uniforms,
    surface_features,
)
from facerender.drawing.resolve import ResolvedScene
from facerender.scenes.view import View


def surface_pass(
    resolved: ResolvedScene,
    view: View,
    visibility: Visibility | None = None,
    scatters: bool = False,
    blended_part: BlendedPart | None = None,
) -> Pass:
    """Return the pass that draws position and part, normal and m, albedo and specular weight,
    texture coordinates and occlusion of a scene, where a part has two lobes second m and
    lobe weight, where one shines what it gives off, and where it scatters how the mesh faces the
    camera; visibility as of the pass that shades.

    blended_part : draw one layer of this part, with its opacity, in place of all that is not
        blended, and in a last image depth and number of the triangle as it is drawn
    """
    scene, shading = resolved.scene, resolved.shading
    two = any(material.two_lobes for material in scene.mesh.materials)
    shines = any(any(material.emissive) for material in scene.mesh.materials)
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    further = ("SCATTER",) * (scatters and blended_part is None)
    further += (f"EMITTED {4 + two}",) * shines
    further += (f"LAYER {4 + two + shines}",) * (blended_part is not None)
    draws = [
        Draw(
            Program(
                "gbuffer.frag",
                features=(
                    *surface_features(part, material, shading),
                    *("EMISSIVE",) * any(material.emissive),
                    # every program of a pass writes to all of its targets
                    *("TWO_LOBES",) * (two and not material.two_lobes),
                    *further,
                ),
            ),
            {**part_uniforms(part, material), "part": number},
            part,
            material,
        )
        for number, (part, material) in enumerate(parts, 1)
    ]
    uniforms = scene_uniforms(scene, view)
    shown = unblended(scene, draws) if blended_part is None else blended_part.alone(scene, draws)
    target = Target(colors=4 + two + shines)
    if blended_part is not None:  # a layer reads the one before
        target = Target(colors=target.colors + 1, sampled=True, number=blended_part.layer % 2)
    drawn = Pass("surface", target, shown, uniforms=uniforms)
    return visibility.shaded(drawn) if visibility else drawn
