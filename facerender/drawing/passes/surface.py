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
from facerender.scenes.material import Material
from facerender.scenes.mesh import Part
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
    texture coordinates and occlusion of a simplified scene, where a part has two lobes second m and
    lobe weight, and where it scatters how the mesh faces the eye; visibility as of the pass that
    shades."""
    two = any(material.two_lobes for material in scene.mesh.materials)
    parts = zip(scene.mesh.parts, scene.mesh.materials, strict=True)
    scatter = ("SCATTER",) * scatters
    draws = [
        Draw(
            Program("gbuffer.frag", features=_features(part, material, shading, two) + scatter),
            {**part_uniforms(part, material), "part": number},
            part,
            material,
        )
        for number, (part, material) in enumerate(parts, 1)
    ]
    uniforms = scene_uniforms(scene, view)
    drawn = Pass("surface", Target(colors=5 if two else 4), tuple(draws), uniforms=uniforms)
    return visibility.shaded(drawn) if visibility else drawn


def _features(part: Part, material: Material, shading: Shading, two_lobes: bool) -> tuple[str, ...]:
    """What a part has; every program of a pass writes to all of its targets."""
    names = surface_features(part, material, shading)
    return (*names, "TWO_LOBES") if two_lobes and not material.two_lobes else names
