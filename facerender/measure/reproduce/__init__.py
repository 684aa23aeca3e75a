"""Redraws figures 1 to 5 of S. O. Romanyuk et al., Proc. SPIE 11456, 114560E (2020), and holds the
paper's claims against what is measured here."""

from __future__ import annotations

import platform
from dataclasses import asdict
from functools import partial
from importlib.metadata import version

from facerender.drawing.context import Backend
from facerender.errors import NotMeasured
from facerender.measure import plots
from facerender.measure.reproduce import claims, figures
from facerender.measure.reproduce.page import Reproduction
from facerender.measure.run import environment
from facerender.system.progress import Progress, no_progress


def reproduce(
    repeats: int = 25,
    size: tuple[int, int] = (360, 420),
    backend: Backend = "auto",
    progress: Progress = no_progress,
) -> Reproduction:
    """Draw the paper's figures and measure what it claims.

    Parameters
    ----------
    repeats : of every measurement of time
    size : of one face in figure 5, in pixels
    progress : called with what is done now and the share of it that is done

    Raises
    ------
    InputError : matplotlib is not installed
    ContextError : no OpenGL context
    """
    plots.check()
    progress("figures 1 to 4", 0.0)
    drawn = figures.charts()
    progress("figure 5", 0.0)
    drawn["fig5.png"] = figures.faces(size, backend)
    machine = environment(backend)
    progress("scalar code", 0.0)
    try:
        scalar, compiler = claims.scalar_cost(repeats)
        where = f"{compiler}; {machine.processor}"
    except NotMeasured as error:
        scalar, compiler, where = {}, "none", str(error)
    glsl = claims.glsl_cost(repeats, backend, partial(progress, f"GLSL on {machine.GL_RENDERER}"))
    renderer = machine.GL_RENDERER
    if machine.software:
        renderer += f" on {machine.processor}"
    progress("AMD's compiler", 0.0)
    held = [
        *claims.error_claims(),
        *claims.scalar_claims(scalar, where),
        *(claim for contest, cost in glsl.items() for claim in contest.claims(cost, renderer)),
        *claims.amd_claims(),
    ]
    costs = scalar | {
        f"{contest.title}: {form}": interval
        for contest, cost in glsl.items()
        for form, interval in cost.items()
    }
    facts = asdict(machine) | {
        "C compiler": compiler,
        "C library": " ".join(platform.libc_ver()),
        "matplotlib": version("matplotlib"),
        "repeats": repeats,
    }
    return Reproduction(facts, held, costs, drawn)
