"""``facerender plan``."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from facerender.commands.common import (
    add_field,
    add_flag,
    add_verbose,
    check_outputs,
    parse_sizes,
    progress_bar,
)
from facerender.commands.scene import add_scene, files_read, job_of, load
from facerender.commands.streams import print_result
from facerender.drawing.context import BACKENDS
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError, reason
from facerender.glsl.library import LANGUAGES, TARGETS
from facerender.job import ImageSettings, Output
from facerender.system.atomic import write_text


def add(plan: argparse.ArgumentParser) -> None:
    plan.set_defaults(command=run)
    plan.description = (
        "A cheaper frame of a scene (samples, triangles, shading) whose error at every pixel, "
        "or at a fraction of them, stays within a budget, against the exact lobe with all terms, "
        "maps, samples and triangles."
    )
    budget = "1/255, 0.5%% or '0.02 flip'"
    plan.add_argument("--budget", required=True, metavar="ERROR", help=budget)
    within = "fraction of the pixels that each image covers that must meet the budget (100%%)"
    plan.add_argument("--within", default="100%", metavar="FRACTION", help=within)
    plan.add_argument(
        "--cost",
        default="frame",
        metavar="OF",
        help="frame, whole ones of which a few are measured; or of a fragment, which leaves "
        "samples and triangles as they are: llvmpipe, navi21 (RDNA2) or vega10 (GCN5) from a "
        "table; auto, llvmpipe where the CPU draws, RDNA2 elsewhere; or here, to measure (frame)",
    )
    add_flag(plan, "verify-cost", "measure the chosen frame beside the full one, in turns")
    _, scene = add_scene(plan)
    file = "camera, lights, material, reflectance"
    scene.add_argument("--from", dest="scene", metavar="FILE.toml", help=file)
    images = plan.add_argument_group("where the error is measured")
    sizes = "N or WxH in pixels; 512..1024 for both and what is between (1024)"
    images.add_argument("--size", default="1024", help=sizes)
    add_field(images, ImageSettings, "samples", "samples per pixel")
    add_field(images, Output, "exposure", "of the display", default=Output.exposure)
    images.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")

    output = plan.add_argument_group("results")
    add_flag(output, "json", "every figure")
    output.add_argument("--emit", metavar="OUT.glsl", help="the shader, with these choices made")
    target = "of the shader: begin with its #version, or another language"
    output.add_argument("--target", choices=(*TARGETS, *LANGUAGES), help=target)
    pinned = "the scene with this shading, for facerender render --scene"
    output.add_argument("--scene", dest="pinned", metavar="OUT.toml", help=pinned)
    output.add_argument("--error-map", metavar="OUT.png", help="of the camera with the largest")
    add_verbose(output)


def run(options: argparse.Namespace) -> int:
    from facerender.planning.budget import Budget
    from facerender.planning.plan import plan

    Budget.parse(options.budget, options.exposure, options.within)
    sizes = parse_sizes(options.size)
    if options.target and not options.emit:
        raise InputError(f"--target {options.target} is of a shader: say --emit OUT.glsl")
    job, cameras = job_of(options, sizes[-1])
    check_outputs([options.emit, options.pinned, options.error_map], files_read(options, job))
    if options.error_map and not options.error_map.lower().endswith(".png"):
        raise InputError(f"--error-map {options.error_map}: give a .png")
    _check_pinned(options.pinned)
    scene = load(job)
    with progress_bar(options) as progress, Renderer.of(job, options.backend) as renderer:
        planned = plan(
            scene,
            options.budget,
            full=job.shading,
            cameras=tuple(cameras.values()),
            sizes=sizes,
            within=options.within,
            cost=options.cost,
            verify_cost=options.verify_cost,
            exposure=options.exposure,
            renderer=renderer,
            progress=progress,
        )
    if options.emit:
        write_text(options.emit, planned.shader(options.target))
    if options.pinned:
        write_text(options.pinned, _PINNED + planned.scene_toml())
    if options.error_map:
        planned.save_error_map(options.error_map)
    print_result(json.dumps(planned.as_dict(), indent=2) if options.json else planned.explain())
    return 0


_PINNED = "# Written by facerender plan.\n"


def _check_pinned(name: str | None) -> None:
    """A scene that somebody wrote is not replaced: --scene names one to read elsewhere."""
    if name is None or not os.path.isfile(name):
        return
    try:
        start = Path(name).read_bytes()[: len(_PINNED)]
    except OSError as error:
        raise InputError(f"cannot read {name}: {reason(error)}") from None
    if start != _PINNED.encode():
        raise InputError(
            f"{name} exists, and is not of facerender plan: --from {name} reads a scene; give "
            "--scene another name"
        )
