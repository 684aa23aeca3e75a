"""``facerender render``."""

from __future__ import annotations

import argparse
import json
import warnings
from typing import Any

from facerender.commands.common import check_outputs, parse_size
from facerender.commands.scene import WHERE, add_scene, files_read, job_of, load
from facerender.commands.streams import say, tell
from facerender.drawing.context import BACKENDS
from facerender.drawing.renderer import Renderer
from facerender.errors import FacerenderWarning, InputError
from facerender.job import Job, Output
from facerender.scenes.planned import Detail
from facerender.scenes.scene import ONLY
from facerender.shading import OUTSIDE, Shading
from facerender.terms import LOBES


def add(render: argparse.ArgumentParser) -> None:
    render.set_defaults(command=run)
    render.add_argument("-o", "--output", required=True, metavar="OUT", help=".png or .exr")
    terms, scene = add_scene(render)
    terms.add_argument("--lobe", choices=tuple(LOBES), help="(exact)")
    terms.add_argument(
        "--outside",
        choices=OUTSIDE,
        help="what a material gets whose m leaves the domain of the lobe (error)",
    )
    terms.add_argument(
        "--budget",
        metavar="ERROR",
        help="plan a cheaper frame within 1/255, 0.5%% or '0.02 flip', and draw that",
    )
    terms.add_argument(
        "--within", metavar="SHARE", help="of the pixels: where --budget must hold (100%%)"
    )
    scene.add_argument("--scene", metavar="FILE.toml", help="camera, lights, material, reflectance")
    scene.add_argument("--camera", metavar="WHERE", help=WHERE)
    scene.add_argument(
        "--triangles", type=int, metavar="N", help="simplify the mesh to so many (all of them)"
    )

    image = render.add_argument_group("image")
    image.add_argument("--size", default="1024", help="N or WxH in pixels (1024)")
    image.add_argument("--samples", type=int, default=4, help="per pixel; 1 for none (4)")
    image.add_argument("--exposure", type=float, default=0.0, help="of the PNG, in stops (0)")
    image.add_argument("--only", choices=ONLY, help="one term in place of the whole image")
    image.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    image.add_argument(
        "--no-cache",
        dest="cache",
        action="store_false",
        help="neither read nor write what is kept of meshes and plans in ~/.cache/facerender",
    )
    image.add_argument("--json", action="store_true", help="describe the image as JSON")


def run(options: argparse.Namespace) -> int:
    if options.budget is not None and options.only is not None:
        raise InputError(f"--budget plans the whole image: leave --only {options.only} out")
    if options.within is not None and options.budget is None:
        raise InputError(f"--within {options.within} is of a budget: say --budget ERROR")
    output = Output(options.output, options.only, options.exposure)
    size = parse_size(options.size)
    job, _ = job_of(options, [options.camera] if options.camera else [], size, (output,))
    check_outputs([output.path], files_read(options, job))
    scene, shading = load(job, options.cache), job.shading
    plan: dict[str, Any] = {}
    detail = Detail(job.image.samples, None)
    with Renderer.of(job, options.backend) as renderer:
        if options.budget is not None:
            from facerender.planning.cache import planned

            within = options.within or 1.0
            asked = scene, options.budget, shading, options.exposure, within, renderer
            plan = planned(*asked, cache=options.cache)
            shading, detail = Shading.from_dict(plan["shading"]), Detail(**plan["detail"])
        elif job.planned and job.planned.holds(renderer.size, renderer.samples):
            detail = job.planned.detail
        elif job.planned:
            warnings.warn(_unplanned(options.scene, job), FacerenderWarning, stacklevel=1)
        samples = min(detail.samples, renderer.samples)
        drawn = detail.of(scene)
        frame = renderer.render(drawn, shading, output.only, samples, detail.backs, detail.once)
        backend = renderer.context.backend
    frame.save(output.path, output.exposure)
    if options.json:
        facts = {
            "output": options.output,
            "size": job.image.size,
            "backend": backend,
            "only": frame.only,
            **frame.metadata,
            "warnings": options.warnings,
        }
        if plan:
            facts["plan"] = plan
        tell(json.dumps(facts, indent=2))
    else:
        tell(options.output)
        if plan:
            say(*plan["text"].splitlines()[-2:])
    return 0


def _unplanned(name: str, job: Job) -> str:
    width, height = job.image.size
    return (
        f"{name} was planned for {job.planned}: at {width} x {height} with {job.image.samples} its "
        "error is unknown; plan for this size and these samples"
    )
