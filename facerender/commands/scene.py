"""The job that the scene options of a command describe: the scene file, changed by the options.

Options and file have the keys of :class:`Job`; they are merged, and the job is built once. This
module only adds what the command line alone has: cameras by name and from files, several views, and
options that exclude each other."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from facerender.commands.options import FIELDS, WHERE, mesh_files
from facerender.drawing.prepare import resolved_parts, start_maps
from facerender.errors import InputError, clipped, quoted, warn
from facerender.loading import MeshFile, load_mesh
from facerender.loading.source import GLTF
from facerender.material import parse_part
from facerender.mesh.mesh import Mesh
from facerender.scene.background import is_image
from facerender.scene.camera import (
    CAMERA_FILES,
    MAX_CAMERAS,
    STANDARD_ANGLES,
    TURNS,
    Camera,
    named,
    orbiting,
    turntable,
)
from facerender.scene.environment import STUDIO, wanted
from facerender.scene.job import ImageSettings, Job, load_scene
from facerender.scene.pose import Pose
from facerender.scene.scene import Scene
from facerender.system.files import check_file
from facerender.texture.texture import Kind
from facerender.values.fields import build, merged
from facerender.values.vectors import MILLIMETRES, axes_of, numbers_in

# Keys of a scene file's shading that a plan may have set, each with the options that it pins.
_PINS = {
    "m": ("m", "roughness_map"),
    "ks": ("ks", "specular_map"),
    "normal_map": ("normal_map",),
    "two_lobes": ("second_slope", "lobe_weight", "lobe_map"),
    "ambient": ("ambient",),
    "environment": ("environment",),
    **{name: (name,) for name in ("environment_samples", "environment_lights")},
    "specular_lights": ("light",),
}


def fields_set(options: argparse.Namespace, *keys: str) -> dict[str, Any]:
    """Return the tables of a job with the fields that the options set; keys of FIELDS. The options
    --size and --vertices have forms of their own, see :func:`job_of`."""
    tables = {}
    for key in keys:
        names = [word.partition("=")[0] for word in FIELDS[key][1].split()]
        names = [name for name in names if name not in ("size", "vertices")]
        tables[key] = values_of(options, *names)
    if "mesh" in tables and options.mesh is not None:
        tables["mesh"]["path"] = options.mesh
    return {key: table for key, table in tables.items() if table}


def values_of(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of those named options that the command line sets."""
    return {name: value for name in names if (value := getattr(options, name, None)) is not None}


def job_of(
    options: argparse.Namespace, size: tuple[int, int] | None
) -> tuple[Job, dict[str, Camera]]:
    """Return the job that options and scene file describe, and the cameras, keyed by name.

    The cameras come from the options, otherwise from the scene file. If neither has a camera, one
    default camera is used.

    size : image size; None for the size of the first camera, or else the default size
    """
    if (side := getattr(options, "mm_per_pixel", None)) is not None:
        MILLIMETRES.check("mm_per_pixel", side)
    if options.m is not None and options.roughness_map is not None:
        raise InputError("--m and --roughness-map exclude each other: leave one of them out")
    file = load_scene(options.scene) if options.scene else {}
    _check_pins(options, file)
    # A map on the command line replaces the file's number, which would otherwise win.
    if options.roughness_map is not None:
        file.get("material", {}).pop("m", None)
    tables = _with_records(
        file, fields_set(options, "mesh", "material", "shading", "image", "pose")
    )
    # Texts: the job's records parse them, as in a scene file.
    tables |= values_of(options, "environment", "ambient", "background")
    if options.anonymous:
        tables["anonymous"] = options.anonymous
    if rig := [options.lights] * bool(options.lights) + (options.light or []):
        tables["lights"] = rig
    tables["pose"] = _pose(options, tables.get("pose", Pose()))
    tables["parts"] = part_materials(options, file.get("parts", {}))
    job = Job(**tables)
    size = size or (job.image.size if "size" in tables.get("image", {}) else None)
    if job.outputs or job.landmarks:
        warn(f"the outputs and landmarks of {options.scene} are not used: name the image with -o")
    camera, cameras = _cameras(options, job, size, "camera" in file)
    # A calibrated camera has the size of its photographs; --size and [image] size come first.
    image = replace(job.image, size=size or camera.size or ImageSettings.size)
    job = replace(job, camera=camera, cameras=(), image=image)
    _check_unused(options, job)
    if options.shadows is not None:
        lights = tuple(replace(light, shadow=options.shadows) for light in job.lights)
        shading = job.shading
        if not options.shadows and options.environment_lights is None:
            shading = shading.replace(environment_lights=0)
        job = replace(job, lights=lights, shading=shading)
    return job, cameras


def check_inputs(job: Job) -> None:
    """Raise InputError if an input file of a job is missing, before other checks refer to it."""
    if job.mesh.path is not None:
        _ = job.mesh.source  # reads the file
    for path, expected in _files(job):
        check_file(path, expected, sys.maxsize)


def _with_records(file: Mapping[str, Any], tables: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a scene file, changed by tables; records keep their other fields."""
    both = dict(file)
    for key, table in tables.items():
        if isinstance(old := both.get(key, {}), dict):
            both[key] = merged(old, table)
        else:
            both[key] = replace(old, **table)
    return both


def _check_unused(options: argparse.Namespace, job: Job) -> None:
    """Raise InputError for samples of light that the scene does not have."""
    for name in ("environment_samples", "environment_lights"):
        if (number := getattr(options, name)) and job.environment is None:
            option = f"--{name.replace('_', '-')} {number}"
            raise InputError(f"{option} has no environment map: add --environment FILE")
    tables = job.material, *job.parts.values()
    scatters = any(table.get("scattering") not in (None, "none") for table in tables)
    if options.scatter_samples and not scatters:
        raise InputError(
            f"--scatter-samples {options.scatter_samples} has no subsurface scattering: add "
            "--scattering skin"
        )


def _check_pins(options: argparse.Namespace, file: Mapping[str, Any]) -> None:
    """Raise InputError for options without effect, because the scene file pins the same value, and
    for changes of a plan's material."""
    material, pinned, planned = file.get("material", {}), file.get("shading", {}), "planned" in file
    for name, value in fields_set(options, "material").get("material", {}).items():
        if planned and value != material.get(name, value):
            option = f"--{name.replace('_', '-')}"
            raise InputError(
                f"{options.scene} was planned for {name} = {material[name]}: leave {option} out, "
                f"or plan again with {option} {value}"
            )
    remedy = "plan again with it" if planned else "remove that line from the file"
    for key, names in _PINS.items():
        for name, value in values_of(options, *names).items():
            if key in pinned and value != material.get(name):
                raise InputError(
                    f"{options.scene} pins {key} = {pinned[key]} of the shading: leave "
                    f"--{name.replace('_', '-')} out, or {remedy}"
                )


def part_materials(
    options: argparse.Namespace, tables: Mapping[str, Mapping[str, Any]] = {}
) -> dict[str, dict[str, Any]]:
    """Return the materials of parts of a scene file, changed by --part. Later options win."""
    parts = {name: dict(table) for name, table in tables.items()}
    for name, table in map(parse_part, options.part or ()):
        parts[name] = {**parts.pop(name, {}), **table}
    return parts


# --- poses ---------------------------------------------------------------------------------------


def _pose(options: argparse.Namespace, pose: Pose | Mapping[str, Any]) -> Pose:
    """Return the pose, changed by the options that have a form of their own."""
    base = build(Pose, pose, "pose")
    changes: dict[str, Any] = {}
    for option, count, form in (
        ("weight", 1, "WEIGHT, such as jawOpen=0.6"),
        ("joint", 3, "X,Y,Z, such as head=0,20,0"),
    ):
        entries = {}
        for text in getattr(options, option) or ():
            name, _, words = text.rpartition("=")
            numbers = numbers_in(words.split(","))
            if not name or len(numbers) != count:
                raise InputError(f"--{option} {quoted(text)}: give NAME={form}")
            entries[name] = numbers[0] if count == 1 else numbers
        if entries:
            changes[f"{option}s"] = {**getattr(base, f"{option}s"), **entries}
    if options.vertices is not None:
        file, frame = _vertices(options.vertices)
        changes |= {"vertices": file, "frame": frame or 0}
    return replace(base, **changes)


def _vertices(text: str) -> tuple[str, int | None]:
    """Parse a path and the index of a frame from ``FILE[,FRAME]``; without FRAME, None."""
    file, comma, frame = text.rpartition(",")
    if not comma or not frame.isdecimal():
        file, frame = text, ""
    if not file:
        raise InputError(f"--vertices {quoted(text)}: give FILE[,FRAME]")
    return file, int(frame[:10]) if frame else None


def plays(options: argparse.Namespace, pose: Pose) -> bool:
    """Return whether the options name a sequence: a clip without a time, or a file of vertices
    without a frame."""
    if options.vertices is not None:
        return _vertices(options.vertices)[1] is None
    return pose.clip is not None and pose.time is None


def sequence(pose: Pose, mesh: Mesh, fps: float) -> list[Pose]:
    """Return the poses of a clip at a frame rate, or of all frames in a file of vertices.

    Raises
    ------
    InputError : the mesh has no such clip, the file cannot be used, or there are too many frames
    """
    if pose.vertices is not None:
        from facerender.scene.pose import frame_count

        return [replace(pose, frame=number) for number in range(frame_count(pose.vertices))]
    mesh.with_pose(clip=pose.clip)  # only checks the clip
    seconds = mesh.clips[str(pose.clip)]
    # The tolerance keeps the last frame of a clip whose length is a rounded number of frames.
    count = math.floor(seconds * fps + 1e-6) + 1
    if count > MAX_CAMERAS:
        raise InputError(
            f"the clip {pose.clip} has {count} frames at --fps {fps:g}: give a rate with at most "
            f"{MAX_CAMERAS} frames"
        )
    return [replace(pose, time=min(number / fps, seconds)) for number in range(count)]


# --- files ---------------------------------------------------------------------------------------


def files_read(options: argparse.Namespace, job: Job) -> Iterator[str | Path | None]:
    """Yield the input files that the options and the job name, and all possible paths of files that
    the mesh file refers to."""
    yield from (options.scene, job.mesh.path, *(path for path, _ in _files(job)))
    yield from (text for text in options.camera or () if text.lower().endswith(CAMERA_FILES))
    yield from mesh_files(job.mesh)


def _files(job: Job) -> Iterator[tuple[str, str]]:
    """Yield the input files of a job except its mesh file, each with a description for messages."""
    yield from ((path, "an image file") for path in job.mesh.files if path != job.mesh.path)
    yield from ((p.vertices, "a file of vertices") for p in (job.pose, job.before) if p.vertices)
    if is_image(job.background):
        yield str(job.background), "an image file"
    if job.environment is not None and job.environment.file != STUDIO:
        yield job.environment.file, wanted(job.environment.file)


def load(job: Job, cache: bool = False, ahead: bool = True) -> Scene:
    """Load the scene of a job.

    Parameters
    ----------
    cache : whether the disk cache is used for the mesh and its decoded maps
    ahead : whether threads start to decode the maps before the renderer is created
    """
    read_only = not ahead or job.anonymous is not None  # the cache contains names
    scene = job.scene(load_mesh(job.mesh, cache="read" if cache and read_only else cache))
    # Threads decode the maps while this one creates the context.
    albedo: Kind = "linear-color" if job.image.float_albedo else "color"
    if ahead:
        start_maps(resolved_parts(scene.mesh, albedo, job.shading.slope_filter))
    return scene


# --- cameras -------------------------------------------------------------------------------------


def _cameras(
    options: argparse.Namespace, job: Job, size: tuple[int, int] | None, in_file: bool
) -> tuple[Camera, dict[str, Camera]]:
    """Return the job's camera, and all cameras, keyed by name. If an option sets an orbiting
    camera, fields that the option does not set come from the file's camera.

    in_file : whether the scene file has a camera; otherwise the first of its camera path counts
    """
    camera, path = job.camera, [*job.cameras]
    if path and not in_file:
        camera = path[0]
    changes = values_of(options, "fov", "frame", "orthographic")
    if job.anonymous is not None:
        changes["name"] = ""  # names come from files
    if (target := getattr(options, "looked_at", None)) is not None:
        changes["target"] = target
    if not options.camera:
        camera, *path = (replace(file_camera, **changes) for file_camera in (camera, *path))
        return camera, named(path or [camera], "camera")
    # An option replaces the position of the file's camera, but keeps its angle of view and target.
    camera = replace(orbiting(camera), **changes)
    cameras: dict[str, Camera] = {}
    for text in options.camera:
        for name, view in _views(text, camera, changes, job.mesh, size).items():
            cameras[name if name not in cameras else f"{name}_{len(cameras):03d}"] = view
    return next(iter(cameras.values())), cameras


def _views(
    text: str,
    camera: Camera,
    changes: Mapping[str, Any],
    mesh: MeshFile,
    size: tuple[int, int] | None,
) -> dict[str, Camera]:
    """Return the cameras of one --camera option, keyed by name.

    camera, changes : camera whose fields an orbiting camera inherits; values of :class:`Camera`
        fields, which replace the values in camera files
    """
    word, _, argument = text.partition(":")
    if word == "turntable":
        count, comma, ends = (argument or "8").partition(",")
        arc = numbers_in(ends.split(".."))
        if not count.isdecimal() or int(count[:9]) not in TURNS:
            raise InputError(f"--camera {text}: give turntable:N, with {TURNS} views")
        if comma and len(arc) != 2:
            raise InputError(f"--camera {text}: give turntable:N,FROM..TO, in degrees")
        turns = turntable(camera, int(count), arc if comma else None)
        return {f"turntable_{i:03d}": turn for i, turn in enumerate(turns)}
    if word == "gltf" or text.lower().endswith(CAMERA_FILES):
        cameras = _file_cameras(text, mesh, size)
        views = {name: replace(view, **changes) for name, view in cameras.items()}
        return named(views.values(), "camera") if "name" in changes else views
    texts = STANDARD_ANGLES if text == "standard" else [text]
    return {
        text.replace(",", "_"): orbiting(camera, **{**Camera.parse(text, WHERE), **changes})
        for text in texts
    }


def _file_cameras(text: str, mesh: MeshFile, size: tuple[int, int] | None) -> dict[str, Camera]:
    from facerender.scene.cameras import gltf_cameras, load_cameras

    word, colon, name = text.partition(":")
    if word != "gltf":
        return load_cameras(text, size)
    if mesh.path is None or mesh.source.suffix not in GLTF:
        raise InputError(f"--camera {text}: the mesh is not a .glb or .gltf; give another camera")
    # The cameras turn with the file's axes, which "auto" finds only when the mesh is loaded.
    if mesh.up == "auto":
        raise InputError(f"--camera {text} needs the axis of the file: give --up z, not auto")
    axes = axes_of(mesh.up or "y", mesh.rotate or (0.0, 0.0, 0.0))
    cameras = gltf_cameras(mesh.source.content, mesh.source.name, axes)
    if not colon:
        return cameras
    if name not in cameras:
        names = ", ".join(map(clipped, cameras))
        raise InputError(f"--camera {text}: {mesh.path} has no such camera; it has {names}")
    return {name: cameras[name]}


def parse_sizes(text: str) -> list[tuple[int, int]]:
    """Parse a size such as 1024, or a range such as 512..1024.

    A range gives both ends and sizes between the ends. Each size is the previous one times a
    constant factor of at most sqrt(2).
    """
    first, *last = (
        build(ImageSettings, {"size": end}, "image").size for end in text.split("..", 1)
    )
    if not last:
        return [first]
    ranges = [*zip(first, *last, strict=True)]
    if not all(low <= high for low, high in ranges):
        raise InputError(f"sizes {text!r}: give the smaller size first, such as 512..1024")
    steps = math.ceil(2.0 * max(math.log2(high / low) for low, high in ranges) - 1e-9)
    widths, heights = (np.geomspace(low, high, steps + 1).round() for low, high in ranges)
    return [(int(width), int(height)) for width, height in zip(widths, heights, strict=True)]
