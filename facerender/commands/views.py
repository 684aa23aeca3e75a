"""``facerender views``: the standard views of one or several scans of a face, in one scale and
light, with a sheet of all views, and sheets of the changes from the first scan to the others."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from facerender.commands.options import (
    BACKEND,
    SCENE,
    SCENE_CHANGES,
    SIDE,
    add_options,
    check_outputs,
    step_log,
)
from facerender.commands.output import print_result
from facerender.commands.render import ahead, file_names
from facerender.commands.scene import check_inputs, fields_set, files_read, job_of, load
from facerender.comparison.pictures import changes, picture
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import IMAGE_FORMATS, Frame
from facerender.drawing.renderer import Renderer
from facerender.errors import warn
from facerender.images.animation import MAX_COLUMNS, arranged
from facerender.mesh.hints import known_millimetres
from facerender.mesh.mesh import Mesh
from facerender.mesh.registration import register
from facerender.scene.camera import Camera
from facerender.scene.job import ImageSettings, Output, load_scene
from facerender.scene.scene import Scene
from facerender.scene.view import target_of, to_scale, view_of
from facerender.system.files import make_folder
from facerender.values.fields import MEMORY

GREY = (0.18, 0.18, 0.18)  # the background, neutral
_WIDEST = 8192  # largest width of a sheet, in pixels
_APART = 0.5  # largest distance of the eyes of two scans of one frame, in eye distances


def add(views: argparse.ArgumentParser) -> None:
    views.set_defaults(command=run)
    views.description = (
        "Render the standard views of a scan of a face (frontal, both obliques, both\n"
        "laterals, basal, superior) in one orthographic scale, with soft light that follows\n"
        "the camera, and a sheet of all views. Further scans of the face get the same frame,\n"
        "and a sheet of the changes from the first scan."
    )
    changes = SCENE_CHANGES | {
        "mesh": {"nargs": "+"},
        "camera": SCENE_CHANGES["camera"] | {"unset": "standard"},
        "lights": SCENE_CHANGES["lights"] | {"unset": "softbox"},
        "background": {"unset": ",".join(map(str, GREY))},
        "up": {"unset": "auto"},
    }
    add_options(
        views,
        _OPTIONS,
        **changes,
        size={"unset": SIDE},
        memory={"limits": MEMORY},
        output={"required": True},
        format={"choices": IMAGE_FORMATS, "default": "png"},
        backend=BACKEND | {"choices": BACKENDS},
    )


_OPTIONS = f"""
mesh
-o --output DIR | folder for the images | required
{SCENE}
[scene]
mm-per-pixel triangles
--register | align further scans with the first by their upper faces
[image]
size samples exposure tone bits dpi scale_bar
--format | format of the images | png
backend
--no-cache | do not use the cache in ~/.cache/facerender
--memory MIB | limit of the estimated memory | the free memory
--json | print output files, scale, residuals and warnings as JSON
anonymous id quiet verbose
"""


def _with_defaults(options: argparse.Namespace) -> argparse.Namespace:
    """Return the options with the defaults of this command, which a scene file replaces."""
    options = copy(options)
    file = load_scene(options.scene) if options.scene else {}
    if not (options.camera or {"camera", "cameras"} & {*file}):
        options.camera = ["standard"]
    if not (options.light or options.lights or options.environment or "lights" in file):
        options.lights = "softbox"
    if options.background is None and "background" not in file:
        options.background = GREY
    if options.up is None and options.rotate is None:
        options.up = "auto"
    return options


def _frame_of(cameras: Iterable[Camera], scene: Scene, aspect: float) -> list[Camera]:
    """Return orthographic cameras whose frame is stated in numbers, so that it fits other meshes,
    too. The first camera sets the scale of all."""
    framed, height = [], 0.0
    for camera in cameras:
        frame = "head" if camera.frame == "auto" else camera.frame
        camera = replace(camera, orthographic=True, frame=frame)
        height = height or view_of(replace(scene, camera=camera), aspect).height(scene.mesh)
        target = scene.mesh.to_mesh_space(target_of(scene.mesh, camera)).tolist()
        framed.append(replace(camera, target=tuple(target), view_height=height, zoom=Camera.zoom))
    return framed


def _moved(cameras: Sequence[Camera], first: Mesh, mesh: Mesh) -> list[Camera]:
    """Return the cameras of the first mesh for another mesh, whose unit may differ. If its face
    lies elsewhere, they keep their scale and move by the distance of the faces, with a warning."""
    lengths = [known_millimetres(scan) or 1.0 for scan in (first, mesh)]
    ratio, away = lengths[0] / lengths[1], np.zeros(3)
    faces = [scan.geometry.framing.face for scan in (first, mesh)]
    if faces[0] and faces[1]:
        away = faces[1].eyes.mean(axis=0) / ratio - faces[0].eyes.mean(axis=0)
        if np.linalg.norm(away) < _APART * faces[0].eye_distance:
            away *= 0.0
        else:
            name = f"the face of {mesh.name} is not where that of {first.name} is"
            warn(f"{name}: its views are centred on its own face; give --register to align it")
    return [
        replace(
            camera,
            target=tuple((ratio * (away + np.array(camera.target))).tolist()),
            view_height=ratio * (camera.view_height or 0.0),
        )
        for camera in cameras
    ]


def _labels(paths: Sequence[str], anonymous: str | None) -> list[str]:
    """Return a name for the images of each mesh file: its stem, or the text ``anonymous`` that
    replaces it, numbered if two are equal."""
    stems = [anonymous or Path(path).stem for path in paths]
    numbered = [f"{stem}-{number}" for number, stem in enumerate(stems, 1)]
    return numbered if len({*stems}) < len(stems) else stems


def _registered(
    scenes: Sequence[Scene], labels: Sequence[str], quiet: bool
) -> tuple[list[Scene], dict[str, float]]:
    """Return the scenes, with their meshes in the space of the first, and the median distances that
    remain, by label. Print the distances."""
    moved, residuals = [scenes[0]], {}
    for scene, label in zip(scenes[1:], labels[1:], strict=True):
        registration = register(scene.mesh, scenes[0].mesh)
        moved.append(replace(scene, mesh=registration.mesh))
        residuals[label] = registration.residual
        if not quiet:
            distance = f"median residual {registration.residual:.2g} {registration.unit}"
            print_result(f"{label} registered to {labels[0]}: {distance}")
    return moved, residuals


def run(options: argparse.Namespace) -> int:
    """Draw and write the views, and print the names of the files."""
    options = _with_defaults(options)
    settings = fields_set(options, "outputs").get("outputs", {})
    Output(f"a.{options.format}", **settings)  # checks them
    step, jobs = step_log(options), []
    for path in options.mesh:
        one = argparse.Namespace(**{**vars(options), "mesh": path})
        job, cameras = job_of(one, ImageSettings(options.size).size if options.size else None)
        check_inputs(job)
        jobs.append(job)
    labels, several = _labels(options.mesh, options.anonymous), len(jobs) > 1
    folder, size = make_folder(options.output), jobs[0].image.size
    names = [f"{label}-{view}" for label in labels for view in cameras]
    files = [*file_names("{name}", names), "sheet", *["changes"] * several]
    outputs = [Output(str(folder / f"{file}.{options.format}"), **settings) for file in files]
    read = chain.from_iterable(files_read(one, job) for job in jobs)
    check_outputs([output.path for output in outputs], read)
    step("mesh")
    scenes = [load(job, not options.no_cache, ahead=options.memory is None) for job in jobs]
    residuals: dict[str, float] = {}
    if options.register:
        scenes, residuals = _registered(scenes, labels, options.json)
    first = scenes[0].mesh
    frame = _frame_of(cameras.values(), scenes[0], size[0] / size[1])
    if options.mm_per_pixel is not None:
        frame = [to_scale(camera, first, options.mm_per_pixel, size) for camera in frame]
    step("OpenGL context")
    columns = len(cameras) if several else min(len(cameras), MAX_COLUMNS)
    reduced = math.ceil(columns * size[0] / _WIDEST)
    cells: list[NDArray[np.uint8]] = []
    reliefs: list[NDArray[np.float64]] = []
    with Renderer.of(jobs[0], options.backend, options.memory) as renderer:

        def drawn() -> Iterator[Frame]:
            for job, scene in zip(jobs, scenes, strict=True):
                for camera in _moved(frame, first, scene.mesh):
                    view = replace(scene, camera=camera)
                    terms = ("image", "depth") if several else ("image",)
                    frames = renderer.render_outputs(view, terms, job.shading)
                    if several:
                        reliefs.append(_relief(frames["depth"], view)[::reduced, ::reduced])
                    yield frames["image"]

        for output, image in zip(outputs, ahead(drawn()), strict=False):
            image.save(output)
            cell = image.srgb8(output.exposure, output.tone, output.scale_bar)
            cells.append(np.asarray(Image.fromarray(cell[..., :3]).reduce(reduced)))
    titles = [*cameras] * len(jobs)
    if several:  # the first image of a row names the scan
        titles[:: len(cameras)] = [f"{label}: {titles[0]}" for label in labels]
    sheets = [arranged(cells, titles, columns)]
    if several:
        length = known_millimetres(first)
        pixel = reduced * view_of(replace(scenes[0], camera=frame[0]), size[0] / size[1]).pixel(
            first, size, 1.0
        )
        scale = pixel * (length or 1.0), "mm" if length else "mesh units"
        pairs = [*zip(reliefs[:columns] * (len(jobs) - 1), reliefs[columns:], strict=True)]
        sheets.append(changes(pairs, cells[columns:], titles[columns:], *scale))
    for output, sheet in zip(outputs[len(names) :], sheets, strict=True):
        millimetres = image.mm_per_pixel and reduced * image.mm_per_pixel
        output = replace(output, exposure=0.0, tone="linear", scale_bar=False)
        replace(picture(sheet, {}), mm_per_pixel=millimetres).save(output)
    paths = [output.path for output in outputs]
    if not options.json:
        print_result(*paths)
        return 0
    result = {
        "output": paths,
        "size": size,
        "scale": image.metadata["scale"],
        "mm_per_pixel": image.mm_per_pixel,
        "residuals": residuals,
        "warnings": options.warnings,
    }
    print_result(json.dumps(result, indent=2))
    return 0


def _relief(depth: Frame, scene: Scene) -> NDArray[np.float64]:
    """Return the height (H, W) of the surface above the plane through the target, towards the
    camera, in mm if the unit is known; NaN without a surface."""
    mesh = scene.mesh
    view = view_of(scene, 1.0)
    centre = (target_of(mesh, scene.camera) - view.position) @ view.forward * mesh.radius
    relief = (centre - depth.linear[..., 0]) * (known_millimetres(mesh) or 1.0)
    return np.where(depth.linear[..., 3] > 0.0, relief, np.nan)
