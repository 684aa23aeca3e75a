"""Reproduce figures 1 to 5 of the paper and measure its claims:

    python -m benchmarks.paper [-o out/reproduction] [--m 0.25]

Needs OpenGL and matplotlib. Claims are marked "not measured" if their compiler
is missing: a C compiler, or the compilers that ``benchmarks.prices.amd`` needs.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec

from benchmarks.paper import claims, figures
from benchmarks.paper.report import Reproduction
from facerender.drawing.context import Backend
from facerender.errors import FacerenderError, InputError, NotMeasured
from facerender.measure.measurement import environment
from facerender.system.process import Bar, Progress, no_progress


def reproduce(
    repeats: int = 25,
    size: tuple[int, int] = (270, 315),
    backend: Backend = "auto",
    progress: Progress = no_progress,
    m: float | None = None,
) -> Reproduction:
    """Reproduce the paper's figures and measure its claims.

    Parameters
    ----------
    repeats : number of repetitions of each time measurement
    size : width and height in pixels of one face in figure 5
    progress : called with the name of the current step and the finished fraction of it
    m : roughness for all figures and errors; None: the paper's values

    Raises
    ------
    InputError : matplotlib is not installed
    ContextError : no OpenGL context
    """
    if find_spec("matplotlib") is None:
        raise InputError("the figures need matplotlib: pip install matplotlib")
    progress("figures 1 to 4", 0.0)
    images = figures.charts(claims.SLOPES if m is None else [m])
    progress("figure 5", 0.0)
    face_m = figures.FACE_SLOPE if m is None else m
    images["fig5.png"] = figures.faces(size, backend, face_m)
    machine = environment(backend)
    progress("scalar code", 0.0)
    try:
        scalar, compiler = claims.scalar_cost(repeats)
        conditions = f"{compiler}; {machine['processor']}"
    except NotMeasured as error:
        scalar, compiler, conditions = {}, "none", str(error)
    glsl = claims.glsl_cost(
        repeats, backend, partial(progress, f"GLSL on {machine['GL_RENDERER']}")
    )
    renderer = machine["GL_RENDERER"]
    if machine["software"]:
        renderer += f" on {machine['processor']}"
    progress("AMD's compiler", 0.0)
    results = [
        *claims.error_claims(claims.ERROR_SLOPES if m is None else [m]),
        *claims.scalar_claims(scalar, conditions),
        *(claim for contest, cost in glsl.items() for claim in contest.claims(cost, renderer)),
        *claims.amd_claims(),
    ]
    costs = scalar | {
        f"{contest.title}: {form}": interval
        for contest, cost in glsl.items()
        for form, interval in cost.items()
    }
    facts = machine | {
        "C compiler": compiler,
        "C library": " ".join(platform.libc_ver()),
        "matplotlib": version("matplotlib"),
        "repeats": repeats,
    }
    return Reproduction(facts, results, costs, images, face_m)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write figures, JSON and an HTML page; return 0, or 2 if a requirement is missing."""
    parser = argparse.ArgumentParser("python -m benchmarks.paper", description=__doc__)
    parser.add_argument("-o", "--output", default="out/reproduction", metavar="DIR")
    roughness = "m of the figures and errors, in [1e-4, 0.7071)"
    parser.add_argument("--m", type=float, metavar="M", help=roughness)
    options = parser.parse_args(arguments)
    try:
        with Bar() as progress:
            result = reproduce(progress=progress, m=options.m)
        print(*result.write(options.output), sep="\n")
    except FacerenderError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
