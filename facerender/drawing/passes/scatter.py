"""The pass for subsurface scattering. ``shaders/host/scatter.frag`` reads the images of the shading
pass: radiance, irradiance, position and albedo."""

from __future__ import annotations

import numpy as np

from facerender.drawing.passes import Area, Draw, Pass, Target
from facerender.drawing.program import Program
from facerender.scenes.scattering import Scattering
from facerender.scenes.vectors import Vector
from facerender.scenes.view import View
from facerender.terms.scattering import scatter_uniforms


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
