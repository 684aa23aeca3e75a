"""``facerender plan``."""

from __future__ import annotations

import argparse
import json
import math
import time

from facerender.commands import options as common
from facerender.commands.options import SIDE
from facerender.commands.output import print_message, print_result
from facerender.commands.scene import files_read, job_of, load, parse_sizes
from facerender.drawing.context import BACKENDS
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.glsl.library import LANGUAGES, TARGETS
from facerender.scene.job import Output
from facerender.system.files import write_text
from facerender.system.process import Progress, shows_bars


def add(plan: argparse.ArgumentParser) -> None:
    plan.set_defaults(command=run)
    plan.description = (
        "Find a cheaper frame of a scene: fewer samples, triangles and shading terms. The\n"
        "error at every pixel, or at a fraction of the pixels, stays within the budget. The\n"
        "reference has the exact lobe and all terms, maps, samples and triangles."
    )
    common.add_options(
        plan,
        _OPTIONS,
        **common.SCENE_CHANGES | {"within": common.SCENE_CHANGES["within"] | {"default": "100%"}},
        budget={"required": True, "limits": "at least 0"},
        cost={"default": "frame"},
        size={"unset": SIDE, "note": _SIZES, "metavar": "N|WxH|FROM..TO", "default": SIDE},
        exposure={"text": "exposure of the display", "default": Output.exposure},
        target={"choices": (*TARGETS, *LANGUAGES)},
        backend=common.BACKEND | {"choices": BACKENDS},
    )


_SIZES = "FROM..TO, such as 512..1024, also measures sizes between both ends"
_OPTIONS = f"""mesh
[search]
--budget ERROR | largest error of the planned frame | required | {common.BUDGET}
--cost COST | cost to minimise | frame | frame is the time of whole frames, drawn in turns with the
    full frame. Other values are the cost of a fragment, and leave samples and triangles unchanged:
    llvmpipe, navi21 (RDNA2) and vega10 (GCN5) from a table; auto is llvmpipe if the CPU draws,
    otherwise navi21; here is measured on this machine
{common.SCENE}
[where the error is measured]
size samples exposure backend
[results]
--json | print the whole plan as JSON
--emit OUT.glsl | file for the shader with the chosen terms and constants | none
--target | #version line or language of the shader of --emit | GLSL to include, without #version
--save-scene OUT.toml | file for the planned scene, which render and batch read with --scene | none
--error-map OUT.png | image of the error at each pixel, for the camera with the largest error | none
quiet verbose
"""


def run(options: argparse.Namespace) -> int:
    from facerender.planning.budget import Budget
    from facerender.planning.plan import plan

    # Bad values end the command before the mesh is loaded and the scene is drawn.
    Budget.parse(options.budget, options.exposure, options.within)
    sizes = parse_sizes(options.size)
    if options.target and not options.emit:
        raise InputError(f"--target {options.target} has no shader: add --emit OUT.glsl")
    job, cameras = job_of(options, sizes[-1])
    outputs = [options.emit, options.save_scene, options.error_map]
    common.check_outputs(outputs, files_read(options, job))
    if options.error_map and not options.error_map.lower().endswith(".png"):
        raise InputError(f"--error-map {options.error_map}: give a .png")
    scene = load(job)
    # A bar, --verbose and --quiet need no announcement.
    silent = not (options.quiet or options.verbose or shows_bars(quiet=False))
    with common.progress_bar(options) as progress, Renderer.of(job, options.backend) as renderer:
        planned = plan(
            scene,
            options.budget,
            full=job.shading,
            cameras=tuple(cameras.values()),
            sizes=sizes,
            within=options.within,
            cost=options.cost,
            exposure=options.exposure,
            renderer=renderer,
            progress=_announced(progress) if silent else progress,
        )
    if options.emit:
        write_text(options.emit, planned.shader(options.target))
    if options.save_scene:
        write_text(options.save_scene, planned.scene_toml())
    if options.error_map:
        planned.save_error_map(options.error_map)
    print_result(json.dumps(planned.as_dict(), indent=2) if options.json else planned.explain())
    return 0


_SILENT = 3.0  # seconds without output, after which a message announces a longer wait


def _announced(progress: Progress) -> Progress:
    """Return a progress function that prints a message once, in the first step after _SILENT."""
    end = time.monotonic() + _SILENT

    def report(step: str, fraction: float) -> None:
        nonlocal end
        progress(step, fraction)
        if time.monotonic() > end:
            end = math.inf
            remedy = "fewer with --light key and fewer --parts"
            print_message(f"facerender: planning may take minutes, {remedy}")

    return report
