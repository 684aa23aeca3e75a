"""``facerender views``: the standard views of one or several scans of a face, in one scale and
light, with a sheet of all views, and sheets of the changes from the first scan to the others."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from facerender import __version__
from facerender.commands import options as common
from facerender.commands.output import print_result
from facerender.commands.render import ahead, file_names
from facerender.commands.scene import check_inputs, fields_set, files_read, job_of, load
from facerender.comparison.pictures import changes
from facerender.drawing.context import BACKENDS
from facerender.drawing.frame import IMAGE_FORMATS, Frame
from facerender.drawing.renderer import Renderer
from facerender.errors import InputError, number_of, warn
from facerender.images.animation import MAX_COLUMNS, arranged
from facerender.images.files import pillow_bytes, png_bytes
from facerender.mesh.hints import known_millimetres
from facerender.mesh.mesh import Mesh
from facerender.mesh.registration import register
from facerender.scene.camera import Camera
from facerender.scene.job import ImageSettings, Output, load_scene
from facerender.scene.scene import Scene
from facerender.scene.view import target_of, to_scale, view_of
from facerender.system.files import make_folder, write_bytes
from facerender.values.fields import MEMORY
from facerender.values.vectors import Array, Float

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
    changes = common.SCENE_CHANGES | {
        "mesh": {"nargs": "+"},
        "camera": common.SCENE_CHANGES["camera"] | {"unset": "standard"},
        "lights": common.SCENE_CHANGES["lights"] | {"unset": "softbox"},
        "background": {"unset": ",".join(map(str, GREY))},
        "up": {"unset": "auto"},
    }
    common.add_options(
        views,
        _OPTIONS,
        **changes,
        size={"unset": common.SIDE},
        memory={"limits": MEMORY},
        output={"required": True},
        format={"choices": [form for form in IMAGE_FORMATS if form != "exr"], "default": "png"},
        backend=common.BACKEND | {"choices": BACKENDS},
    )


_OPTIONS = f"""
mesh
-o --output DIR | folder for the images | required
{common.SCENE}
[scene]
mm-per-pixel triangles
--labels NAME,... | names of the scans in files and sheets | names of the mesh files
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


def _units(first: Mesh, mesh: Mesh) -> float:
    """Return the length of a unit of the first mesh in units of another mesh."""
    return (known_millimetres(first) or 1.0) / (known_millimetres(mesh) or 1.0)


def _offset(first: Mesh, mesh: Mesh) -> Float:
    """Return how far the face of a mesh lies from that of the first, (3,) in units of the first; 0
    for a scan in the same place. Warn of scans that are not aligned."""
    goal, face = (scan.geometry.framing.face for scan in (first, mesh))
    if goal is None or face is None:
        return np.zeros(3)
    offset = face.eyes.mean(axis=0) / _units(first, mesh) - goal.eyes.mean(axis=0)
    if np.linalg.norm(offset) < _APART * goal.eye_distance:
        return np.zeros(3)
    name = f"the face of {mesh.name} is not where that of {first.name} is"
    warn(f"{name}: each is centred in its views, and changes are not drawn; give --register")
    return np.asarray(offset)


def _moved(camera: Camera, offset: Float, ratio: float) -> Camera:
    """Return an orthographic camera, moved by an offset, for a mesh with another unit."""
    target = tuple((ratio * (offset + np.array(camera.target))).tolist())
    return replace(camera, target=target, view_height=ratio * (camera.view_height or 0.0))


def _labels(options: argparse.Namespace) -> list[str]:
    """Return a name for the images of each mesh file: of --labels, or else its stem, or the text
    that replaces it, numbered if two are equal."""
    count, labels = len(options.mesh), (options.labels or "").split(",")
    if options.labels:
        if len({*labels}) != count or not all(labels):
            option = f"--labels {options.labels} with {number_of(count, 'scan')}"
            raise InputError(f"{option}: give a different name for each, such as before,after")
        return [f"{options.anonymous}-{x}" if options.anonymous else x for x in labels]
    stems = [options.anonymous or Path(path).stem for path in options.mesh]
    numbered = [f"{stem}-{number}" for number, stem in enumerate(stems, 1)]
    return numbered if len({*stems}) < count else stems


def run(options: argparse.Namespace) -> int:
    """Draw and write the views, and print the names of the files."""
    options = _with_defaults(options)
    settings = Output(f"a.{options.format}", **fields_set(options, "outputs").get("outputs", {}))
    step, jobs = common.step_log(options), []
    for path in options.mesh:
        one = argparse.Namespace(**{**vars(options), "mesh": path})
        job, cameras = job_of(one, ImageSettings(options.size).size if options.size else None)
        check_inputs(job)
        jobs.append(job)
    labels, several = _labels(options), len(jobs) > 1
    folder, size = make_folder(options.output), jobs[0].image.size
    names = [f"{label}-{view}" for label in labels for view in cameras]
    files = [*file_names("{name}", names), "sheet", *["changes"] * several]
    outputs = [replace(settings, path=str(folder / f"{f}.{options.format}")) for f in files]
    read = chain.from_iterable(files_read(one, job) for job in jobs)
    common.check_outputs([output.path for output in outputs], read)
    step("mesh")
    scenes = [load(job, not options.no_cache, ahead=options.memory is None) for job in jobs]
    first, residuals = scenes[0].mesh, {}
    for number, label in enumerate(labels[1:] * options.register, 1):
        registration = register(scenes[number].mesh, first)
        scenes[number] = replace(scenes[number], mesh=registration.mesh)
        residuals[label] = registration.residual
        if not options.json:
            distance = f"median residual {registration.residual:.2g} {registration.unit}"
            print_result(f"{label} registered to {labels[0]}: {distance}")
    frame = _frame_of(cameras.values(), scenes[0], size[0] / size[1])
    if options.mm_per_pixel is not None:
        frame = [to_scale(camera, first, options.mm_per_pixel, size) for camera in frame]
    offsets = [_offset(first, scene.mesh) for scene in scenes]
    if several and np.any(offsets):
        several = False
        del outputs[-1]
    step("OpenGL context")
    columns = len(cameras) if len(jobs) > 1 else min(len(cameras), MAX_COLUMNS)
    reduced = math.ceil(columns * size[0] / _WIDEST)
    cells: list[Array] = []
    reliefs: list[Float] = []
    with Renderer.of(jobs[0], options.backend, options.memory) as renderer:

        def drawn() -> Iterator[Frame]:
            for job, scene, offset in zip(jobs, scenes, offsets, strict=True):
                for camera in frame:
                    camera = _moved(camera, offset, _units(first, scene.mesh))
                    view = replace(scene, camera=camera)
                    terms = ("image", "depth") if several else ("image",)
                    frames = renderer.render_outputs(view, terms, job.shading)
                    if several:
                        reliefs.append(_relief(frames["depth"], view)[::reduced, ::reduced])
                    cell = frames["image"].srgb8(
                        settings.exposure, settings.tone, settings.scale_bar
                    )
                    cells.append(np.asarray(Image.fromarray(cell[..., :3]).reduce(reduced)))
                    yield frames["image"]

        for output, image in zip(outputs, ahead(drawn()), strict=False):
            image.save(output)
    titles = [*cameras] * len(jobs)
    if len(jobs) > 1:  # the first image of a row names the scan
        titles[:: len(cameras)] = [f"{label}: {titles[0]}" for label in labels]
    sheets, length = [arranged(cells, titles, columns)], known_millimetres(first)
    pixel = reduced * (frame[0].view_height or 0.0) / size[1] * (length or 1.0)
    unit, distances = "mm" if length else "mesh units", None
    if several:
        pairs = [*zip(reliefs[:columns] * (len(jobs) - 1), reliefs[columns:], strict=True)]
        sheet, distances = changes(pairs, cells[columns:], titles[columns:], pixel, unit)
        sheets.append(sheet)
        if not options.json:
            low, high = (f"{distance:.1f}" for distance in distances)
            print_result(f"changes from {low} (inwards) to {high} {unit} (outwards)")
    metadata = {"facerender": __version__, "scale": f"{pixel:.6g} {unit} per pixel"}
    for output, sheet in zip(outputs[len(names) :], sheets, strict=True):
        dpi = settings.dpi or (25.4 / pixel if length else None)
        png = options.format == "png"
        encode = partial(png_bytes, srgb=True) if png else partial(pillow_bytes, options.format)
        write_bytes(output.path, encode(sheet, metadata, dpi))
    paths = [output.path for output in outputs]
    if not options.json:
        print_result(*paths)
        return 0
    result = {
        "output": paths,
        "size": size,
        "scale": image.metadata["scale"],
        "mm_per_pixel": image.mm_per_pixel,
        "unit": unit,
        "residuals": residuals,
        "changes": distances,
        "warnings": options.warnings,
    }
    print_result(json.dumps(result, indent=2))
    return 0


def _relief(depth: Frame, scene: Scene) -> Float:
    """Return the height (H, W) of the surface above the plane through the target, towards the
    camera, in mm if the unit is known; NaN without a surface."""
    mesh = scene.mesh
    view = view_of(scene, 1.0)
    centre = (target_of(mesh, scene.camera) - view.position) @ view.forward * mesh.radius
    relief = (centre - depth.linear[..., 0]) * (known_millimetres(mesh) or 1.0)
    return np.where(depth.linear[..., 3] > 0.0, relief, np.nan)
