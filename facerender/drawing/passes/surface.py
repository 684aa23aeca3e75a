"""What shading reads at each pixel's centre, drawn by ``shaders/host/gbuffer.frag``."""

from __future__ import annotations

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.visibility import Visibility
from facerender.drawing.program import (
    Program,
    part_uniforms,
    scene_uniforms,
    surface_features,
)
from facerender.scenes.scene import Scene
from facerender.scenes.view import View
from facerender.shading import Shading


def surface_pass(
    scene: Scene,
    view: View,
    shading: Shading,
    visibility: Visibility | None = None,
    scatters: bool = False,
) -> Pass:
    """Return the pass that draws position and part, normal and m, albedo and specular weight,
    texture coordinates and occlusion of a simplified scene; where it scatters how the mesh faces
    the eye as well. Visibility as of the pass that shades."""
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    scatter = ("SCATTER",) * scatters
    draws = [
        Draw(
            Program("gbuffer.frag", features=surface_features(part, material, shading) + scatter),
            {**part_uniforms(part, material), "part": number},
            part,
            material,
        )
        for number, (part, material) in enumerate(parts, 1)
    ]
    uniforms = scene_uniforms(scene, view)
    drawn = Pass("surface", Target(colors=4), tuple(draws), uniforms=uniforms)
    return visibility.shaded(drawn) if visibility else drawn
