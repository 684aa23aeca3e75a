"""``facerender render``: one image, or several views as files, an animation, a sheet or standard
output."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import string
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facerender.commands.common import SIDE, Options, check_inputs, check_outputs, step_log
from facerender.commands.output import print_bytes, print_message, print_result
from facerender.commands.scene import add_scene, files_read, job_of, load, plays, sequence
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import IMAGE_FORMATS, Frame
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError
from facerender.images.files import (
    FRAME_RATES,
    MAX_BYTES,
    MAX_SIDE,
    Format,
    check_opaque,
    format_of,
)
from facerender.scene.camera import Camera
from facerender.scene.detail import LevelOfDetail
from facerender.scene.file import ImageSettings, Pose
from facerender.scene.job import MeshFile, Output, parse_size
from facerender.scene.scene import ONLY, Scene
from facerender.scene.shading import OUTSIDE, Shading
from facerender.scene.vertices import posed
from facerender.scene.view import view_of
from facerender.system.process import MIB, limit
from facerender.terms import LOBES
from facerender.values.ranges import EXPOSURES, MEMORY, Range, range_of
from facerender.values.vectors import Vector

STANDARD_OUTPUT = "-"
FPS = 12.0  # default frame rate of animations of several views
CLIP_FPS = 25.0  # default frame rate of clips
_PIXEL_BYTES = 32  # memory per pixel of a sheet: 16 for linear RGBA, up to 16 to write the file


@dataclass(frozen=True)
class Destination:
    """The output files of a command.

    Attributes
    ----------
    files : file names, or STANDARD_OUTPUT alone
    kind : "each" for one file per image, "moving" for one animation, "sheet" for one image with
        all images in a grid
    count : number of images
    format : format of an image on standard output; None for files
    fps : images per second of an animation
    """

    files: tuple[str, ...]
    kind: Literal["each", "moving", "sheet"]
    count: int
    format: Format | None
    fps: float

    @classmethod
    def of(
        cls,
        path: str,
        names: Sequence[str],
        as_sheet: bool,
        format: Format | None,
        fps: float | None,
        transparent: bool,
        plays: bool = False,
    ) -> Destination:
        """Return the destination of images, before the first image is drawn.

        Parameters
        ----------
        path : file name, in which {index} and {name} are replaced, or STANDARD_OUTPUT
        format, fps : values of the options; None if they are not given
        plays : whether the images are the frames of a sequence, to which --fps applies

        Raises
        ------
        InputError : the path, the format or fps is invalid for these images
        """
        kind: Literal["each", "moving", "sheet"] = "sheet" if as_sheet else "each"
        rate = fps if fps is not None else CLIP_FPS if plays else FPS
        files: tuple[str, ...] = (path,)
        if path == STANDARD_OUTPUT:
            if len(names) > 1 and not as_sheet:
                raise InputError(
                    f"-o - takes one image, and there are {len(names)}: give --sheet or a file"
                )
            format = format or "png"
        elif format is not None:
            raise InputError(f"--format {format} is for -o - only: the file name sets the format")
        elif not as_sheet and _moves(path, len(names)):
            kind = "moving"
        else:
            files = file_names(path, ["sheet"] if as_sheet else names)
        if fps is not None and kind != "moving" and not plays:
            raise InputError(
                f"--fps {fps:g} is for a .gif, .webp or .mp4 of several views, or a clip, only"
            )
        if kind == "moving":
            from facerender.images.animation import check_animation

            check_animation(path, rate)
            if not path.lower().endswith(".webp"):
                check_opaque(path, transparent)
        elif (format or format_of(files[0])) == "jpeg":
            check_opaque("JPEG", transparent)
        return cls(files, kind, len(names), format, rate)

    def write(self, frames: Iterator[Frame], exposure: float, background: Vector | None) -> Frame:
        """Write each image as soon as it is drawn, and return the last image."""
        last = deque[Frame](maxlen=1)

        def remembered() -> Iterator[Frame]:
            for frame in frames:
                last.append(frame)
                yield frame

        images = remembered() if self.count == 1 else _ahead(remembered())
        if self.kind == "moving":
            from facerender.images.animation import save_animation

            save_animation(self.files[0], (frame.srgb8(exposure) for frame in images), self.fps)
            return last[0]
        if self.kind == "sheet":
            images = iter([sheet(images, self.count, background)])
        for file, frame in zip(self.files, images, strict=True):
            if self.format is not None:
                print_bytes(frame.encoded(self.format, exposure))
            else:
                frame.save(file, exposure)
        return last[0]


def _ahead(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Yield frames. A thread draws the next one while this thread encodes and writes: of the two,
    only drawing may change threads, because signals end the process in this thread."""
    with ThreadPoolExecutor(1) as executor:
        future = executor.submit(next, frames, None)
        while frame := future.result():
            future = executor.submit(next, frames, None)
            yield frame


def _moves(path: str, count: int) -> bool:
    """Return whether a file is an animation: any .gif or .mp4, or a .webp with several images
    whose file name contains neither {index} nor {name}."""
    suffix = os.path.splitext(path)[1].lower()
    return suffix in (".gif", ".mp4") or (suffix == ".webp" and count > 1 and not _has_fields(path))


def file_names(pattern: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the file name of each image.

    {index} becomes the image's index (from 000) in at least three digits, and {name} the image's
    name. If out.png has neither of these fields, several images are named out_000.png and so on.

    Raises
    ------
    InputError : the pattern has an unknown field in braces
    """
    digits = max(3, len(str(len(names) - 1)))
    if not _has_fields(pattern):
        if len(names) == 1:
            return (pattern,)
        root, suffix = os.path.splitext(pattern)
        pattern = f"{root.replace('{', '{{').replace('}', '}}')}_{{index}}{suffix}"
    pattern = pattern.replace("{index}", f"{{index:0{digits}d}}")
    try:
        return tuple(
            pattern.format(index=index, name=_plain(name)) for index, name in enumerate(names)
        )
    except (ValueError, LookupError, AttributeError):
        raise InputError(
            f"-o {pattern}: in braces give {{index}}, {{index:03d}} or {{name}}"
        ) from None


def is_several(path: str) -> bool:
    """Return whether an output can hold a sequence: an animation, or a name with {index}."""
    return _moves(path, 2) or _has_fields(path)


def _has_fields(pattern: str) -> bool:
    """Return whether a file name contains {index} or {name}. Other braces have no meaning."""
    try:
        return any(part[1] in ("index", "name") for part in string.Formatter().parse(pattern))
    except ValueError:
        return False


def _plain(name: str) -> str:
    """Return a camera's name, possibly from an untrusted file, as a safe part of a file name."""
    plain = re.sub(r"[^\w.+-]", "_", name)
    return plain.lstrip(".")[:80] or "_"


def check_sheet(count: int, size: tuple[int, int], memory: float | None) -> None:
    """Raise InputError if a sheet of images is too large.

    memory : limit of the process's memory in MiB; None for the free memory of the system
    """
    columns, rows = _grid(count)
    width, height = columns * size[0], rows * size[1]
    memory_limit = min(limit(memory), MAX_BYTES / MIB)
    if max(width, height) > MAX_SIDE or _PIXEL_BYTES * width * height > memory_limit * MIB:
        raise InputError(
            f"a sheet of {count} images is {width} x {height} pixels of {_PIXEL_BYTES} bytes: at "
            f"most {MAX_SIDE} a side, and {memory_limit:.0f} MiB; give a smaller size or fewer "
            "views"
        )


def sheet(frames: Iterable[Frame], count: int, background: Vector | None) -> Frame:
    """Return one frame with ``count`` images in a grid; empty cells show the background.

    The grid has as many columns as rows, or one column more. Each image is released after copying.
    """
    columns, rows = _grid(count)
    for index, frame in enumerate(frames):
        height, width = frame.linear.shape[:2]
        if index == 0:
            color = background if background is not None and frame.only is None else (0.0,) * 3
            size = rows * height, columns * width
            linear = np.full((*size, 4), (*color, 0.0), dtype=np.float32)
            grid = replace(frame, linear=linear)
        top, left = index // columns * height, index % columns * width
        linear[top : top + height, left : left + width] = frame.linear
    return grid


def _grid(count: int) -> tuple[int, int]:
    columns = math.ceil(math.sqrt(count))
    return columns, math.ceil(count / columns)


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
    image.add_number("fps N", rate, Range(*FRAME_RATES), f"{FPS:g}; {CLIP_FPS:g} of a clip")
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
    if options.json and options.output == STANDARD_OUTPUT:
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
    if playing and options.fps is None and not (is_several(output) or options.sheet):
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
        poses = sequence(job.pose, scene.mesh, options.fps or CLIP_FPS)
    names = [f"frame_{number:03d}" for number in range(len(poses))] if playing else [*cameras]
    transparent = job.background is None
    target = Destination.of(
        output, names, options.sheet, options.format, options.fps, transparent, playing
    )
    written = [] if output == STANDARD_OUTPUT else target.files
    check_outputs(written, files_read(options, job), None if options.output else output)
    scene = scene or loaded()
    step(f"OpenGL context for {scene.mesh!r}")
    width, height = job.image.size
    if target.kind == "sheet":
        check_sheet(target.count, (width, height), options.memory)
    for camera in cameras.values():
        view_of(replace(scene, camera=camera), width / height)
    plan: dict[str, Any] = {}
    with Renderer.of(job, options.backend, options.memory) as renderer:
        step(f"image on {renderer.context.renderer}")
        if options.budget is not None:
            from facerender.planning.plan import cached_plan

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
