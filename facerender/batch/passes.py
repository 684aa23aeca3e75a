"""The passes of a job and its camera: from plain data to the bytes of its files, and to what a
record of it tells. A renderer that is given draws; no OpenGL here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.batch.jobs import PASSES, file_name
from facerender.drawing.frame import Frame, data_view
from facerender.errors import InputError
from facerender.images.exr import exr_bytes, openexr
from facerender.images.write import png_bytes
from facerender.job import Job
from facerender.scenes.lod import simplified
from facerender.scenes.mesh import Mesh
from facerender.scenes.planned import LevelOfDetail
from facerender.scenes.scene import DATA, Only, Scene
from facerender.scenes.view import View, view_of

if TYPE_CHECKING:
    from facerender.drawing.renderer import Renderer

# Each a drawing of its own; the others are one drawing together.
_SHADED: dict[str, Only | None] = {"image": None, "specular": "specular", "diffuse": "diffuse"}
# What layers.exr calls the numbers of a pass. The last letter tells a compositing program how to
# show them: Y is grey; mask.A is Nuke's own layer.
_CHANNELS = {
    "image": ("R", "G", "B", "A"),
    "specular": ("specular.R", "specular.G", "specular.B"),
    "diffuse": ("diffuse.R", "diffuse.G", "diffuse.B"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "depth": ("Z",),
    "cosines": ("cosines.R", "cosines.G", "cosines.B"),
    "visibility": ("visibility.Y",),
    "mask": ("mask.A",),
    "parts": ("part.Y",),
}
_MOST = 65535  # in 16 bits


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a job became.

    Attributes
    ----------
    files : content by file name, such as "image.png"
    facts : plain data for a record: "facerender", "GL_RENDERER", "GL_VERSION", and "camera" as of
        :func:`camera_facts`; with the pass depth "depth_scale", the mesh's units in a step; with
        parts or layers "parts", how many the mesh has; of a planned job "planned", whether the plan
        holds for images of this size and these samples, and was drawn
    """

    files: dict[str, bytes]
    facts: dict[str, Any]


def check_passes(passes: Sequence[str]) -> None:
    """Raise InputError where a pass is unknown, or needs a package that is not installed."""
    for name in passes:
        if name not in PASSES:
            raise InputError(f"unknown pass {name!r}; known: {', '.join(PASSES)}")
    if "layers" in passes:
        openexr("layers.exr")


def draw(job: Job, mesh: Mesh, renderer: Renderer, passes: Sequence[str], exposure: float) -> Drawn:
    """Draw passes of a job; docs/passes.md tells what each file holds.

    The image, the specular and the diffuse term are drawn once each, and all data once together,
    however many passes want them. On one driver the same job gives the same bytes.

    Parameters
    ----------
    mesh : what ``job.mesh.load()`` gave
    renderer : made for the job's image settings
    passes : of PASSES
    exposure : of image, specular and diffuse as PNG, in stops

    Raises
    ------
    InputError : as of :func:`check_passes`, :meth:`facerender.Job.scene` and
        :meth:`facerender.Renderer.render`; more parts than parts.png can number
    """
    check_passes(passes)
    if "parts" in passes and len(mesh.parts) > _MOST:
        raise InputError(
            f"{mesh.name} has {len(mesh.parts)} parts, and parts.png numbers {_MOST}: ask for "
            "layers in place of parts"
        )
    metadata = {**renderer.metadata, "samples": "1"}  # of data
    facts: dict[str, Any] = {
        name: metadata[name] for name in ("facerender", "GL_RENDERER", "GL_VERSION")
    }
    detail = LevelOfDetail(job.image.samples, None)
    if job.planned:
        facts["planned"] = job.planned.holds(renderer.size, renderer.samples)
        detail = job.planned.detail if facts["planned"] else detail
    # Before the material is set, which makes another mesh: what is simplified once serves all jobs.
    drawn = mesh if detail.triangles is None else simplified(mesh, detail.triangles)
    scene = job.scene(drawn)
    view = view_of(scene, renderer.size[0] / renderer.size[1])
    facts["camera"] = camera_facts(view, mesh, renderer.size)

    needed = PASSES if "layers" in passes else passes
    frames = _shaded(job, scene, detail, renderer, needed)
    if not _SHADED.keys() >= set(needed):
        gbuffer = renderer.gbuffer(scene, job.shading, blended=False)
        for only in DATA:
            if only in needed:
                linear = data_view(gbuffer, scene, only)
                frames[only] = Frame(linear, only, scene.background is None, metadata)

    files = {}
    for name in filter(passes.__contains__, PASSES):
        if name == "layers":
            layers = _layers(frames)
            files[file_name(name)] = exr_bytes(file_name(name), layers, frames["image"].metadata)
            continue
        pixels: NDArray[Any]
        if name == "mask":
            pixels = np.uint8(255) * (frames[name].linear[..., 0] > 0.0)
        elif name == "parts":
            pixels = frames[name].linear[..., 0].astype(np.uint16)
        elif name == "depth":
            scale = facts["depth_scale"] = _depth_scale(view, mesh)
            depth = frames[name].linear[..., 0].astype(np.float64)
            pixels = np.round(depth / scale).astype(np.uint16)
        else:
            pixels = frames[name].srgb8(exposure)
        files[file_name(name)] = png_bytes(pixels, frames[name].metadata)
    if {"parts", "layers"} & set(passes):
        facts["parts"] = len(mesh.parts)
    return Drawn(files, facts)


def camera_facts(view: View, mesh: Mesh, size: tuple[int, int]) -> dict[str, Any]:
    """Return a camera as plain data, lengths in the mesh's units.

    Returns
    -------
    "width", "height"; "K", 3 x 3, and "Rt", 3 x 4, as of :meth:`View.intrinsics` and
    :meth:`View.extrinsics`, which are OpenCV's (x right, y down, z forward; from the mesh's space);
    "transform_matrix", 4 x 4, to the mesh's space from a camera as of OpenGL and NeRF (x right,
    y up, z backward)
    """
    pose = view.extrinsics(mesh)
    turn = pose[:, :3].T
    to_world = np.eye(4)
    to_world[:3, :3] = turn * (1.0, -1.0, -1.0)
    to_world[:3, 3] = -turn @ pose[:, 3]
    return {
        "width": size[0],
        "height": size[1],
        "K": view.intrinsics(size).tolist(),
        "Rt": pose.tolist(),
        "transform_matrix": to_world.tolist(),
    }


def transforms_frame(camera: Mapping[str, Any], file_path: str) -> dict[str, Any]:
    """Return an entry of "frames" in a transforms.json, as nerfstudio and instant-ngp read it.

    Parameters
    ----------
    camera : what :func:`camera_facts` gave
    file_path : of the image, relative to the folder of transforms.json
    """
    (fx, _, cx), (_, fy, cy), _ = camera["K"]
    return {
        "file_path": file_path,
        "w": camera["width"],
        "h": camera["height"],
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "transform_matrix": camera["transform_matrix"],
    }


def _shaded(
    job: Job, scene: Scene, detail: LevelOfDetail, renderer: Renderer, names: Sequence[str]
) -> dict[str, Frame]:
    values = replace(detail, samples=min(detail.samples, renderer.samples)).values
    return {
        name: renderer.render(scene, job.shading, only, **values)
        for name, only in _SHADED.items()
        if name in names
    }


def _depth_scale(view: View, mesh: Mesh) -> float:
    """Units of a mesh in a step of 16 bits: the farthest depth that it can have, which is that of
    its bounding sphere, is the last step. Cameras as far away as each other share it, whatever they
    see, on every driver."""
    farthest = 1.0 - float(view.eye @ view.forward)
    return max(farthest, 0.0) * mesh.radius / _MOST or 1.0  # where all is behind the camera


def _layers(frames: Mapping[str, Frame]) -> dict[str, NDArray[Any]]:
    """The channels of layers.exr: every pass as float32."""
    return {
        channel: frames[name].linear[..., index]
        for name, channels in _CHANNELS.items()
        for index, channel in enumerate(channels)
    }
