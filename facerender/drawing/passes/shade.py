"""Radiance of every part under all lights, drawn by ``shaders/host/shade.frag``."""

from __future__ import annotations

import numpy as np

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.visibility import Visibility
from facerender.drawing.program import Lighting, part_uniforms, scene_uniforms, shade_program
from facerender.scenes.mesh import slope_range
from facerender.scenes.scene import Only, Scene
from facerender.scenes.view import View
from facerender.shading import Shading


def shade_pass(
    scene: Scene,
    view: View,
    shading: Shading,
    samples: int,
    only: Only | None = None,
    visibility: Visibility | None = None,
) -> Pass:
    """Return the pass that shades a simplified scene.

    Parameters
    ----------
    only : "specular" or "diffuse" in place of the whole image
    visibility : what was drawn before, with so many samples; None to shade triangles as they are
        drawn

    Raises
    ------
    InputError : m lies outside a lobe's domain, and the shading asks for an error then
    """
    lighting = Lighting.of(scene, shading)
    draws = []
    for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
        terms, smallest = [], 0.0
        if only != "diffuse":
            smallest, largest = slope_range(part, material)
            terms = [term.for_slopes(smallest, largest, shading.outside) for term in lighting.terms]
        coupled = shading.diffuse == "coupled"
        program = shade_program(
            part, material, scene, lighting, terms, smallest, only != "specular", coupled
        )
        draws.append(Draw(program, part_uniforms(part, material), part, material))
    background = scene.background if scene.background and only is None else (0.0, 0.0, 0.0)
    uniforms = scene_uniforms(scene, view, lighting)
    drawn = Pass("shade", Target(samples=samples), tuple(draws), (*background, 0.0), uniforms)
    return visibility.shaded(drawn, {"background": np.asarray(background)}) if visibility else drawn
