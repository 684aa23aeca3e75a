"""``facerender render``."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import Any

from facerender.commands.common import (
    add_field,
    add_flag,
    add_verbose,
    check_outputs,
    step_log,
)
from facerender.commands.scene import add_scene, files_read, job_of, load
from facerender.commands.streams import print_message, print_result
from facerender.commands.views import STANDARD_OUTPUT, Destination, check_sheet
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import FORMATS
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.job import ImageSettings, MeshFile, Output, parse_size
from facerender.scenes.lod import LevelOfDetail
from facerender.scenes.scene import ONLY
from facerender.scenes.view import view_of
from facerender.shading import OUTSIDE, Shading
from facerender.terms import LOBES
from facerender.terms.ranges import EXPOSURES


def add(render: argparse.ArgumentParser) -> None:
    render.set_defaults(command=run)
    render.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT",
        help=".png, .exr, .jpg or .webp; of several views OUT_000.png and so on, or with {index} "
        "and {name} in it, or one .gif, .webp or .mp4; - for standard output",
    )
    terms, scene = add_scene(render)
    terms.add_argument("--lobe", choices=tuple(LOBES), help="(exact)")
    outside = f"action if m is outside the lobe's valid range ({Shading.outside})"
    terms.add_argument("--outside", choices=OUTSIDE, help=outside)
    budget = "plan a cheaper frame within 1/255, 0.5%% or '0.02 flip', and draw that"
    terms.add_argument("--budget", metavar="ERROR", help=budget)
    within = "fraction of pixels that must meet the budget (100%%)"
    terms.add_argument("--within", metavar="FRACTION", help=within)
    scene.add_argument("--scene", metavar="FILE.toml", help="camera, lights, material, reflectance")
    target = "what images have in their centre, in the mesh's units (the centre of the frame)"
    scene.add_argument("--target", dest="looked_at", metavar="X,Y,Z", help=target)
    add_field(scene, MeshFile, "triangles", "simplify the mesh to N", "all", metavar="N")

    image = render.add_argument_group("image")
    image.add_argument("--size", help="N or WxH in pixels (1024, or as --camera FILE says)")
    add_field(image, ImageSettings, "samples", "samples per pixel")
    add_field(image, Output, "exposure", "of all but an EXR", default=Output.exposure)
    image.add_argument("--only", choices=ONLY, help="one term in place of the whole image")
    image.add_argument("--format", choices=FORMATS, help="of standard output, -o - (png)")
    add_flag(image, "sheet", "all views beside each other in one image")
    fps = "views per second, of a .gif, .webp or .mp4 (12)"
    image.add_argument("--fps", type=float, metavar="N", help=fps)
    image.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    add_flag(image, "no-cache", "neither read nor write the cache in ~/.cache/facerender")
    memory = "fail if the estimated memory exceeds N MiB (what the system has left)"
    image.add_argument("--memory", type=float, metavar="N", help=memory)
    add_flag(image, "json", "describe the image as JSON")
    add_verbose(image)


def _check(options: argparse.Namespace) -> None:
    """Raise InputError for options that exclude each other."""
    if options.budget is not None and options.only is not None:
        raise InputError(f"--budget plans the whole image: leave --only {options.only} out")
    if options.within is not None and options.budget is None:
        raise InputError(f"--within {options.within} is of a budget: say --budget ERROR")
    if options.json and options.output == STANDARD_OUTPUT:
        raise InputError("-o - and --json both write to standard output: leave one of them out")


def run(options: argparse.Namespace) -> int:
    _check(options)
    job, cameras = job_of(options, parse_size(options.size) if options.size else None)
    if options.budget is not None and len(cameras) > 1:
        raise InputError(
            f"--budget plans one view, and there are {len(cameras)}: give one --camera, or all of "
            "them to facerender plan, and its scene to render --scene"
        )
    EXPOSURES.check("exposure", options.exposure)
    transparent = job.background is None
    target = Destination.of(
        *(options.output, [*cameras], options.sheet, options.format, options.fps, transparent)
    )
    written = [] if options.output == STANDARD_OUTPUT else target.files
    check_outputs(written, files_read(options, job))
    step = step_log(options)
    step("mesh")
    scene = load(job, not options.no_cache, ahead=options.memory is None)
    step(f"OpenGL, for {scene.mesh!r}")
    width, height = job.image.size
    if target.kind == "sheet":
        check_sheet(target.count, (width, height), options.memory)
    for camera in cameras.values():
        view_of(replace(scene, camera=camera), width / height)
    plan: dict[str, Any] = {}
    with Renderer.of(job, options.backend, options.memory) as renderer:
        step(f"image, by {renderer.context.renderer}")
        if options.budget is not None:
            from facerender.planning.cache import cached_plan

            within = options.within or 1.0
            asked = scene, options.budget, job.shading, options.exposure, within, renderer
            plan = cached_plan(*asked, cache=not options.no_cache)
            shading, detail = Shading.from_dict(plan["shading"]), LevelOfDetail(**plan["detail"])
        else:
            shading, detail = job.shading, job.detail(renderer.samples, options.scene)
        simplified = detail.of(scene)
        values = replace(detail, samples=min(detail.samples, renderer.samples)).values
        scenes = (replace(simplified, camera=camera) for camera in cameras.values())
        frames = (renderer.render(each, shading, options.only, **values) for each in scenes)
        frame = target.write(frames, options.exposure, scene.background)
    if options.json:
        facts = {
            "output": target.files[0] if len(target.files) == 1 else target.files,
            "size": job.image.size,
            "backend": renderer.context.backend,
            "only": frame.only,
            **frame.metadata,
            "warnings": options.warnings,
            **({"plan": plan} if plan else {}),
        }
        print_result(json.dumps(facts, indent=2))
        return 0
    if written:
        print_result(*written)
    if plan and not options.quiet:
        print_message(*plan["text"].splitlines()[-2:])
    return 0
