"""``facerender render``: one image, or several views as files, an animation, a sheet or standard
output."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from facerender.commands import options as common
from facerender.commands import scene as scenes
from facerender.commands.output import print_bytes, print_message, print_result
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import IMAGE_FORMATS, NO_SCALE, Frame
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.files import FRAME_RATES, MAX_BYTES, MAX_SIDE, check_opaque, format_of
from facerender.scene.camera import Camera
from facerender.scene.detail import LevelOfDetail
from facerender.scene.job import ImageSettings, Output
from facerender.scene.pose import Pose, posed
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading
from facerender.scene.view import mm_per_pixel, to_scale, view_of
from facerender.system.process import MIB, limit
from facerender.terms.lobe import LOBES
from facerender.values.fields import MEMORY, Range

STANDARD_OUTPUT = "-"
FPS = 12.0  # default frame rate of animations of several views
CLIP_FPS = 25.0  # default frame rate of clips
_PIXEL_BYTES = 32  # memory per pixel of a sheet: 16 for linear RGBA, up to 16 to write the file


class Destination(NamedTuple):
    """The output files of a command."""

    files: tuple[str, ...]  # file names, or STANDARD_OUTPUT alone
    # A file per image, one animation, or one image with all images in a grid.
    layout: Literal["each", "moving", "sheet"]
    output: Output  # settings of the images; the suffix of its path is their format


def destination(
    options: argparse.Namespace, path: str, names: Sequence[str], transparent: bool, fps: float
) -> Destination:
    """Return the destination of images, before the first image is drawn. Raise InputError if the
    path, or an option, does not fit these images.

    path, names : output of the command, and the names of the images
    fps : images per second, if they are an animation
    """
    output = Output("image.png", **scenes.fields_set(options, "outputs")["outputs"])
    result = Destination((path,), "sheet" if options.sheet else "each", output)
    name = f"image.{options.format or 'png'}"
    if path == STANDARD_OUTPUT:
        if len(names) > 1 and not options.sheet:
            count = f"takes one image, and there are {len(names)}"
            raise InputError(f"-o - {count}: give --sheet or a file")
    elif options.format is not None:
        remedy = "the file name sets the format"
        raise InputError(f"--format {options.format} is for -o - only: {remedy}")
    elif not options.sheet and _moves(path, len(names)):
        result = result._replace(layout="moving")
    else:
        result = result._replace(files=file_names(path, ["sheet"] if options.sheet else names))
        name = result.files[0]
    if result.layout == "moving":
        from facerender.images.animation import check_animation

        check_animation(path, fps)
        if output.bits != 8 or output.dpi is not None:
            raise InputError(f"--bits 16 and --dpi: {path} is an animation; leave them out")
        if not path.lower().endswith(".webp"):
            check_opaque(path, transparent)
        return result
    if format_of(name) == "jpeg":
        check_opaque("JPEG", transparent)
    return result._replace(output=replace(output, path=name))


def write(target: Destination, frames: Iterator[Frame], count: int, fps: float) -> Frame:
    """Write each of ``count`` images as soon as it is drawn, and return the last image."""
    last, output = deque[Frame](maxlen=1), target.output

    def remembered() -> Iterator[Frame]:
        for frame in frames:
            last.append(frame)
            if target.layout == "moving":
                frame.warn_of_clipping(output.exposure, output.tone)
            yield frame

    # One image gains nothing from a thread.
    images = remembered() if count == 1 else ahead(remembered())
    if target.layout == "moving":
        from facerender.images.animation import save_animation

        settings = output.exposure, output.tone, output.scale_bar
        save_animation(target.files[0], (frame.srgb8(*settings) for frame in images), fps)
        return last[0]
    if target.layout == "sheet":
        images = iter([sheet(images, count)])
    for file, frame in zip(target.files, images, strict=True):
        if file == STANDARD_OUTPUT:
            print_bytes(frame.encoded(output))
        else:
            frame.save(replace(output, path=file))
    return last[0]


def ahead(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Yield frames. A thread draws the next one while this thread encodes and writes: of the two,
    only drawing may change threads, because signals end the process in this thread."""
    with ThreadPoolExecutor(1) as executor:
        future = executor.submit(next, frames, None)
        while frame := future.result():
            future = executor.submit(next, frames, None)
            yield frame


# Fields of file names. Other braces have no meaning.
_FIELD = re.compile(r"\{(index|name)(:[^{}]*)?\}")


def _moves(path: str, count: int) -> bool:
    """Return whether a file is an animation: any .gif or .mp4, or a .webp with several images
    whose file name contains neither {index} nor {name}."""
    suffix = os.path.splitext(path)[1].lower()
    several = suffix == ".webp" and count > 1 and not _FIELD.search(path)
    return suffix in (".gif", ".mp4") or several


def file_names(pattern: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the file name of each image. {index} becomes the image's index (from 000) in at least
    three digits, or as many as in {index:04d}, and {name} the image's name. If out.png has neither
    of these fields, several images are named out_000.png and so on."""
    if not _FIELD.search(pattern) and len(names) > 1:
        pattern = "{}_{{index}}{}".format(*os.path.splitext(pattern))
    digits = max(3, len(str(len(names) - 1)))

    def replaced(field: re.Match[str], index: int, name: str) -> str:
        if not re.fullmatch(r"(index(:0?\d*d)?|name)", field[0][1:-1]):
            raise InputError(f"-o {pattern}: in braces give {{index}}, {{index:03d}} or {{name}}")
        if field[1] == "index":
            return f"{index:{(field[2] or f':0{digits}d')[1:]}}"
        # Names of cameras may come from an untrusted file.
        return re.sub(r"[^\w.+-]", "_", name).lstrip(".")[:80] or "_"

    return tuple(
        _FIELD.sub(partial(replaced, index=index, name=name), pattern)
        for index, name in enumerate(names)
    )


def check_sheet(count: int, size: tuple[int, int], memory: float | None) -> None:
    """Raise InputError if a sheet of images is too large. ``memory`` is the limit of the process's
    memory in MiB; None for the free memory of the system."""
    columns, rows = _grid(count)
    width, height = columns * size[0], rows * size[1]
    memory_limit = min(limit(memory), MAX_BYTES / MIB)
    if max(width, height) > MAX_SIDE or _PIXEL_BYTES * width * height > memory_limit * MIB:
        raise InputError(
            f"a sheet of {count} images is {width} x {height} pixels of {_PIXEL_BYTES} bytes: at "
            f"most {MAX_SIDE} a side, and {memory_limit:.0f} MiB; give a smaller size or fewer "
            "views"
        )


def sheet(frames: Iterable[Frame], count: int) -> Frame:
    """Return one frame with ``count`` images in a grid; empty cells show the background. Each image
    is released after copying."""
    columns, rows = _grid(count)
    scales = set[float | None]()
    for index, frame in enumerate(frames):
        height, width = frame.linear.shape[:2]
        if index == 0:
            # Without a background, as in data images, 0 means that no surface is there.
            linear = np.zeros((rows * height, columns * width, 4), dtype=np.float32)
            grid = replace(frame, linear=linear)
            if frame.background is not None:
                back = np.broadcast_to(frame.background, (height, width, 3))
                linear[..., :3] = np.tile(back, (rows, columns, 1))
                grid = replace(grid, background=linear[..., :3].copy())
        top, left = index // columns * height, index % columns * width
        linear[top : top + height, left : left + width] = frame.linear
        scales.add(frame.mm_per_pixel)
    return replace(grid, mm_per_pixel=scales.pop() if len(scales) == 1 else None)


def _grid(count: int) -> tuple[int, int]:
    """Return columns and rows of a grid: as many columns as rows, or one column more."""
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)


def add(render: argparse.ArgumentParser) -> None:
    render.set_defaults(command=run)
    render.description = (
        "Render a mesh file, or the built-in head, to an image, and print the name of the\n"
        "image. Several cameras, or the frames of a clip, give several files, an animation\n"
        "or a sheet. Options override a scene file."
    )
    common.add_options(
        render,
        _OPTIONS,
        **common.SCENE_CHANGES,
        budget={"limits": "at least 0"},
        lobe={"choices": tuple(LOBES)},
        target={"dest": "looked_at"},
        size={"unset": f"{common.SIDE}, or the size in the camera file"},
        exposure={"default": Output.exposure},
        tone={"default": Output.tone},
        format={"choices": IMAGE_FORMATS},
        fps={"limits": Range(*FRAME_RATES)},
        memory={"limits": MEMORY},
        backend=common.BACKEND | {"choices": BACKENDS},
    )


_OPTIONS = f"""
-o --output OUT | output file: .png, .tif, .jpg or .webp (sRGB), .exr (linear float32), or - for
    standard output | the mesh's name with .png {common.NEW_FILE} | Several views write OUT_000.png
    and so on, or replace {{index}} and {{name}} in OUT; a .gif, .webp or .mp4 holds all views.
    Requires pip install 'facerender[exr]' for .exr, 'facerender[mp4]' for .mp4
mesh
{common.SCENE}
[reflectance]
lobe outside
[scene]
target mm-per-pixel triangles
[planned frame]
--budget ERROR | largest error of a cheaper frame to plan and render | none | {common.BUDGET}
[image]
size samples exposure tone bits dpi scale_bar only alpha_threshold
--format | format of -o - | png
--sheet | arrange all views in one image
--fps N | images per second of an animation, or of a clip | {FPS:g}; {CLIP_FPS:g} of a clip
backend
--no-cache | do not use the cache in ~/.cache/facerender
--memory MIB | limit of the estimated memory | the free memory | A scene that needs more is refused
--json | print output files, driver, terms and warnings as JSON
anonymous id quiet verbose
"""


def _scenes(
    scene: Scene, poses: Sequence[Pose], cameras: Sequence[Camera], previous_pose: Pose | None
) -> Iterator[Scene]:
    """Yield the scene in each pose, for each camera. If motion is drawn, ``previous_pose`` is the
    pose before the first one, else None."""
    previous_scene = (
        replace(scene, mesh=posed(scene.mesh, previous_pose)) if previous_pose else None
    )
    for pose in poses:
        posed_scene = replace(scene, mesh=posed(scene.mesh, pose))
        for camera in cameras:
            previous_view = previous_scene and replace(previous_scene, camera=camera)
            yield replace(posed_scene, camera=camera, before=previous_view)
        previous_scene = previous_scene and posed_scene


def _check(options: argparse.Namespace, output: str, playing: bool, cameras: int) -> None:
    """Raise InputError for options that exclude each other, or do not fit a clip, or the number of
    cameras."""
    if options.budget is not None and options.only is not None:
        raise InputError(f"--budget plans the whole image: leave --only {options.only} out")
    if options.budget is not None and options.tone != "linear":
        raise InputError(f"--budget limits errors of tone linear: leave --tone {options.tone} out")
    if options.within is not None and options.budget is None:
        raise InputError(f"--within {options.within} has no budget: add --budget ERROR")
    if options.json and output == STANDARD_OUTPUT:
        raise InputError("-o - and --json both write to standard output: leave one of them out")
    one_image = not (_moves(output, 2) or _FIELD.search(output) or options.sheet)
    if playing and options.fps is None and one_image:
        raise InputError(
            f"-o {output} holds one image of the clip: give --time SECONDS (or --vertices "
            "FILE,FRAME), or for all frames a .gif, an .mp4 or {index} in the name"
        )
    if options.fps is not None and not (playing or (cameras > 1 and _moves(output, cameras))):
        files = "a .gif, .webp or .mp4 of several views, or a clip, only"
        raise InputError(f"--fps {options.fps:g} is for {files}")
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
    size = ImageSettings(options.size).size if options.size else None
    job, cameras = scenes.job_of(options, size)
    scenes.check_inputs(job)
    output = options.output or f"{job.stem}.png"
    playing = scenes.plays(options, job.pose)
    _check(options, output, playing, len(cameras))
    step = common.step_log(options)
    # The mesh is loaded and dressed once; each frame of a clip then only moves it.
    unposed_job = replace(job, pose=Pose(), before=Pose())
    poses = [job.pose]

    def loaded() -> Scene:
        step("mesh")
        return scenes.load(unposed_job, not options.no_cache, ahead=options.memory is None)

    scene = loaded() if playing else None  # the number of frames depends on the mesh
    if scene is not None:
        poses = scenes.sequence(job.pose, scene.mesh, options.fps or CLIP_FPS)
    names = [f"frame_{number:03d}" for number in range(len(poses))] if playing else [*cameras]
    fps = (CLIP_FPS if playing else FPS) if options.fps is None else options.fps
    target = destination(options, output, names, job.background is None, fps)
    written = [] if output == STANDARD_OUTPUT else target.files
    # Before the mesh is loaded and the context is created, which take longer than all checks.
    default = None if options.output else output
    common.check_outputs(written, scenes.files_read(options, job), default)
    scene = scene or loaded()
    step(f"OpenGL context for {scene.mesh!r}")
    width, height = job.image.size
    if options.mm_per_pixel is not None:
        arguments = scene.mesh, options.mm_per_pixel, job.image.size
        cameras = {name: to_scale(camera, *arguments) for name, camera in cameras.items()}
        scene = replace(scene, camera=next(iter(cameras.values())))
    if target.layout == "sheet":
        check_sheet(len(names), (width, height), options.memory)
    # A camera that cannot see the mesh is an error before the first image is written.
    for camera in cameras.values():
        view_of(seen := replace(scene, camera=camera), width / height)
        if options.scale_bar and mm_per_pixel(seen, job.image.size) is None:
            raise InputError(NO_SCALE)
    plan: dict[str, Any] = {}
    with Renderer.of(job, options.backend, options.memory) as renderer:
        step(f"image on {renderer.context.renderer}")
        if options.budget is not None:
            from facerender.planning.plan import cached_plan

            scene, poses = replace(scene, mesh=posed(scene.mesh, job.pose)), [Pose()]
            limits = options.budget, job.shading, options.exposure, options.within or 1.0
            cache = not (options.no_cache or job.anonymous)
            plan = cached_plan(scene.labelled, *limits, renderer, cache=cache)
            shading, detail = Shading.from_dict(plan["shading"]), LevelOfDetail(**plan["detail"])
        else:
            shading, detail = job.shading, job.detail(renderer.samples, options.scene)
        # A plan may ask for more samples than the renderer was created for.
        keywords = replace(detail, samples=min(detail.samples, renderer.samples)).values
        previous_pose = None
        if options.only == "motion":  # the first frame of a sequence has no motion
            previous_pose = poses[0] if playing else job.before
        frames = (
            renderer.render(detail.of(posed_scene), shading, options.only, **keywords)
            for posed_scene in _scenes(scene, poses, [*cameras.values()], previous_pose)
        )
        frame = write(target, frames, len(names), fps)
    if options.json:
        result = {
            "output": target.files[0] if len(target.files) == 1 else target.files,
            "size": job.image.size,
            "backend": renderer.context.backend,
            "only": frame.only,
            "mm_per_pixel": frame.mm_per_pixel,
            **frame.metadata,
            "warnings": options.warnings,
            **({"plan": plan} if plan else {}),
        }
        print_result(json.dumps(result, indent=2))
        return 0
    if written:
        print_result(*written)
    if plan and not options.quiet:
        print_message(*plan["text"].splitlines()[-2:])
    return 0
