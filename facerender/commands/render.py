"""``facerender render``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from facerender.commands import views
from facerender.commands.common import SIDE, Options, check_inputs, check_outputs, step_log
from facerender.commands.scene import add_scene, files_read, job_of, load, plays, sequence
from facerender.commands.streams import print_message, print_result
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import IMAGE_FORMATS
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.write import FRAME_RATES
from facerender.job import MeshFile, Output, parse_size
from facerender.loading.vertices import posed
from facerender.scenes.camera import Camera
from facerender.scenes.file import ImageSettings, Pose
from facerender.scenes.lod import LevelOfDetail
from facerender.scenes.scene import ONLY, Scene
from facerender.scenes.view import view_of
from facerender.shading import OUTSIDE, Shading
from facerender.terms import LOBES
from facerender.terms.ranges import EXPOSURES, MEMORY, Range, range_of


def add(render: argparse.ArgumentParser) -> None:
    render.set_defaults(command=run)
    render.description = (
        "Render a mesh file, or the built-in head, to an image, and print the name of the\n"
        "image. Several cameras, or the frames of a clip, give several files, an animation\n"
        "or a sheet. Options override a scene file."
    )
    kinds = ".png, .jpg or .webp (8-bit sRGB), .exr (linear float32), or - for standard output"
    note = (
        "Several views write OUT_000.png and so on, or replace {index} and {name} in OUT; a .gif, "
        ".webp or .mp4 holds all views. Requires pip install 'facerender[exr]' for .exr, "
        "'facerender[mp4]' for .mp4"
    )
    Options(render).add_output("OUT", f"output file: {kinds}", ".png", note)
    terms, scene = add_scene(render)
    text, note = "exact lobe, or an approximation", "facerender measure prints their errors"
    terms.add_option("--lobe", text, "exact", note, choices=tuple(LOBES))
    text = (
        "action if m is outside the lobe's valid range: stop with an error, or use the exact lobe"
    )
    terms.add_option("--outside", text, Shading.outside, choices=OUTSIDE)
    text, default = "point at the centre of the image", "the centre of --frame"
    target = str(range_of(Camera, "target"))
    scene.add_option("--target X,Y,Z", text, default, "", target, "mesh units", dest="looked_at")
    note = "Requires pip install 'facerender[lod]'"
    scene.add_field(MeshFile, "triangles N", "simplify the mesh to N triangles", "all", note)

    planned = Options(render, "planned frame")
    planned.add_budget("largest error of a cheaper frame to plan and render")

    image = Options(render, "image")
    image.add_size(f"{SIDE}, or the size in the camera file")
    image.add_samples()
    exposure = "exposure of all formats except .exr"
    image.add_field(Output, "exposure STOPS", exposure, default=Output.exposure)
    note = "parts gives each part a colour, or in an .exr file the number of the part"
    image.add_option("--only", "term or data to render", "the whole image", note, choices=ONLY)
    opacity = "smallest opacity at which a blended part counts as a surface in data"
    image.add_field(ImageSettings, "alpha_threshold ALPHA", opacity)
    image.add_option("--format", "format of -o -", "png", choices=IMAGE_FORMATS)
    image.add_flag("sheet", "arrange all views in one image")
    rate = "images per second of an animation, or of a clip"
    image.add_number(
        "fps N", rate, Range(*FRAME_RATES), f"{views.FPS:g}; {views.CLIP_FPS:g} of a clip"
    )
    image.add_backend(BACKENDS)
    image.add_flag("no-cache", "do not use the cache in ~/.cache/facerender")
    memory, note = "limit of the estimated memory", "A scene that needs more is refused"
    image.add_number("memory MIB", memory, MEMORY, "the free memory", note)
    image.add_flag("json", "print output files, driver, terms and warnings as JSON")
    image.add_verbose()


def _check(options: argparse.Namespace) -> None:
    """Raise InputError for options that exclude each other."""
    if options.budget is not None and options.only is not None:
        raise InputError(f"--budget plans the whole image: leave --only {options.only} out")
    if options.within is not None and options.budget is None:
        raise InputError(f"--within {options.within} has no budget: add --budget ERROR")
    if options.json and options.output == views.STANDARD_OUTPUT:
        raise InputError("-o - and --json both write to standard output: leave one of them out")


def _scenes(
    scene: Scene, poses: Sequence[Pose], cameras: Sequence[Camera], previous_pose: Pose | None
) -> Iterator[Scene]:
    """Yield the scene in each pose, for each camera.

    previous_pose : pose before the first pose if motion is drawn, else None
    """
    previous_scene = (
        replace(scene, mesh=posed(scene.mesh, previous_pose)) if previous_pose else None
    )
    for pose in poses:
        posed_scene = replace(scene, mesh=posed(scene.mesh, pose))
        for camera in cameras:
            previous_view = previous_scene and replace(previous_scene, camera=camera)
            yield replace(posed_scene, camera=camera, before=previous_view)
        previous_scene = previous_scene and posed_scene


def _check_views(options: argparse.Namespace, output: str, playing: bool, cameras: int) -> None:
    """Raise InputError for options that do not fit a clip, or the number of cameras."""
    if playing and options.fps is None and not (views.is_several(output) or options.sheet):
        raise InputError(
            f"-o {output} holds one image of the clip: give --time SECONDS (or --vertices "
            "FILE,FRAME), or for all frames a .gif, an .mp4 or {index} in the name"
        )
    if playing and cameras > 1:
        raise InputError(f"a clip has one view, and there are {cameras}: give one --camera")
    if options.budget is not None and (playing or cameras > 1):
        count = "a clip" if playing else cameras
        raise InputError(
            f"--budget plans one view, and there are {count}: give one --camera, or run "
            "facerender plan with all cameras and render its scene with --scene"
        )


def run(options: argparse.Namespace) -> int:
    """Draw and write the images of a command line, and print their names."""
    _check(options)
    output = options.output or f"{Path(options.mesh or 'head').stem}.png"
    job, cameras = job_of(options, parse_size(options.size) if options.size else None)
    check_inputs(job)
    playing = plays(options, job.pose)
    _check_views(options, output, playing, len(cameras))
    EXPOSURES.check("exposure", options.exposure)
    step = step_log(options)
    unposed_job = replace(job, pose=Pose(), before=Pose())
    poses = [job.pose]

    def loaded() -> Scene:
        step("mesh")
        return load(unposed_job, not options.no_cache, ahead=options.memory is None)

    scene = loaded() if playing else None  # the number of frames depends on the mesh
    if scene is not None:
        poses = sequence(job.pose, scene.mesh, options.fps or views.CLIP_FPS)
    names = [f"frame_{number:03d}" for number in range(len(poses))] if playing else [*cameras]
    transparent = job.background is None
    target = views.Destination.of(
        output, names, options.sheet, options.format, options.fps, transparent, playing
    )
    written = [] if output == views.STANDARD_OUTPUT else target.files
    check_outputs(written, files_read(options, job), None if options.output else output)
    scene = scene or loaded()
    step(f"OpenGL context for {scene.mesh!r}")
    width, height = job.image.size
    if target.kind == "sheet":
        views.check_sheet(target.count, (width, height), options.memory)
    for camera in cameras.values():
        view_of(replace(scene, camera=camera), width / height)
    plan: dict[str, Any] = {}
    with Renderer.of(job, options.backend, options.memory) as renderer:
        step(f"image on {renderer.context.renderer}")
        if options.budget is not None:
            from facerender.planning.cache import cached_plan

            scene, poses = replace(scene, mesh=posed(scene.mesh, job.pose)), [Pose()]
            limits = options.budget, job.shading, options.exposure, options.within or 1.0
            plan = cached_plan(scene, *limits, renderer, cache=not options.no_cache)
            shading, detail = Shading.from_dict(plan["shading"]), LevelOfDetail(**plan["detail"])
        else:
            shading, detail = job.shading, job.detail(renderer.samples, options.scene)
        keywords = replace(detail, samples=min(detail.samples, renderer.samples)).values
        previous_pose = None
        if options.only == "motion":  # the first frame of a sequence has no motion
            previous_pose = poses[0] if playing else job.before
        frames = (
            renderer.render(detail.of(posed_scene), shading, options.only, **keywords)
            for posed_scene in _scenes(scene, poses, [*cameras.values()], previous_pose)
        )
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
