"""The shading pass: ``shaders/host/shade.frag`` computes the radiance of all parts under all
lights."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.transparency import blended_parts, unblended
from facerender.drawing.program import scene_uniforms, shade_program
from facerender.drawing.resolve import ResolvedScene
from facerender.scenes.scene import Only
from facerender.scenes.view import View

if TYPE_CHECKING:
    from facerender.drawing.passes.refraction import Refraction
    from facerender.scenes.scattering import Scattering


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

    samples : samples per pixel
    only : term to draw, "specular" or "diffuse"; None for the whole image
    scattering : scattering of the scene. If given, the pass also draws the input images of the
        scatter pass, and omits background and blended parts
    apart : whether to draw only the input images of the scatter pass
    refraction : refraction of the scene; None to leave out the light that parts refract

    For errors see ``ResolvedScene.terms`` and ``ResolvedScene.slopes``.
    """
    scene, draws = resolved.scene, []
    specular, count = only != "diffuse", len(scene.mesh.parts)
    slopes = resolved.slopes if specular else [(0.0, 0.0)] * count
    terms = resolved.terms if specular and resolved.lighting.shining else [None] * count
    rows = zip(scene.mesh.parts, scene.mesh.materials, terms, slopes, strict=True)
    for part, material, term, (smallest_m, _) in rows:
        program = shade_program(resolved, part, material, term, smallest_m, only)
        if samples > 1 and "ALPHA_MASK" in program.features:
            program = program.having(f"TO_COVERAGE {samples}")
        draws.append(Draw.of_part(program, part, material))
    if refraction:
        draws = refraction.refracted(draws)
    uniforms = scene_uniforms(scene, view, resolved.lighting)
    if scattering:
        for index, (draw, number) in enumerate(zip(draws, scattering.numbers, strict=True)):
            program = draw.program.having("SCATTER", *("APART",) * apart)
            values = {**draw.uniforms, "profile": number}
            draws[index] = replace(draw, program=program, uniforms=values)
        target = Target(3 if apart else 4, samples, sampled=True)
        names = ("albedo", "light", "place") if apart else ("image", "light", "place", "albedo")
        opaque = unblended(scene, draws)
        return Pass(names[0], target, opaque, uniforms=uniforms, others=names[1:])
    background = (only is None and scene.background) or (0.0, 0.0, 0.0)
    blends = (
        replace(draws[blended.part], order=blended.order, depth="blend")
        for blended in blended_parts(scene, view)
    )
    all_draws = (*unblended(scene, draws), *blends)
    return Pass("shade", Target(samples=samples), all_draws, (*background, 0.0), uniforms)
