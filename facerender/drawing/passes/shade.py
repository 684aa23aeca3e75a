"""The shading pass: ``shaders/host/shade.frag`` computes the radiance of all parts under all
lights."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.transparency import blended_draws, unblended
from facerender.drawing.program import part_uniforms, scene_uniforms, shade_program
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

    Parameters
    ----------
    samples : samples per pixel
    only : term to draw, "specular" or "diffuse"; None for the whole image
    scattering : scattering of the scene. If given, the pass also draws the input images of the
        scatter pass, and omits background and blended parts
    apart : whether to draw only the input images of the scatter pass
    refraction : refraction of the scene; None to leave out the light that parts refract

    Raises
    ------
    InputError : m lies outside a lobe's domain and ``shading.outside`` is "error", or a light is
        too near for its radius
    """
    scene, draws = resolved.scene, []
    specular = only != "diffuse"
    parts = resolved.parts(specular)
    if not specular:
        resolved = replace(resolved, shading=resolved.shading.replace(environment_samples=0))
    for resolved_part in parts:
        part, material = resolved_part.part, resolved_part.material
        program = shade_program(
            resolved, resolved_part, diffuse=only != "specular", emits=only is None
        )
        if samples > 1 and "ALPHA_MASK" in program.features:
            program = replace(program, features=(*program.features, f"TO_COVERAGE {samples}"))
        uniforms, sides = part_uniforms(part, material), material.double_sided
        draws.append(Draw(program, uniforms, part, material, double_sided=sides))
    if refraction:
        draws = refraction.refracted(draws)
    background = scene.background if scene.background and only is None else (0.0, 0.0, 0.0)
    uniforms = scene_uniforms(scene, view, resolved.lighting)
    if scattering:
        background = (0.0, 0.0, 0.0)
    drawn = Pass("shade", Target(samples=samples), tuple(draws), (*background, 0.0), uniforms)
    if scattering:
        drawn = _with_scatter_images(drawn, scattering, apart)
    shown = unblended(scene, drawn.draws)
    if not scattering:
        shown += blended_draws(scene, view, drawn.draws)
    return replace(drawn, draws=shown)


def _with_scatter_images(drawn: Pass, scattering: Scattering, apart: bool) -> Pass:
    """Return a shading pass that also draws the input images of the scatter pass."""
    from facerender.drawing.passes.scatter import ALBEDO, IMAGE, LAYERS

    features = ("SCATTER", *(("APART",) * apart))
    return replace(
        drawn,
        name=ALBEDO if apart else IMAGE,
        target=replace(drawn.target, colors=3 if apart else 4, sampled=True),
        draws=tuple(
            replace(
                draw,
                program=replace(draw.program, features=draw.program.features + features),
                uniforms={**draw.uniforms, "profile": number},
            )
            for draw, number in zip(drawn.draws, scattering.numbers, strict=True)
        ),
        others=LAYERS if apart else (*LAYERS, ALBEDO),
    )
