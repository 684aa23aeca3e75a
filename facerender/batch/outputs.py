"""Outputs of a job: from its plain data to the bytes of its files and the facts of its record, with
the camera. No OpenGL here: a renderer is a parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.batch.jobs import OUTPUTS, check_outputs, file_name
from facerender.drawing.frame import Frame, data_view
from facerender.errors import InputError
from facerender.images.exr import exr_bytes, openexr
from facerender.images.write import png_bytes
from facerender.job import Job
from facerender.scenes.lod import LevelOfDetail, simplified
from facerender.scenes.mesh import Mesh
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
    """The files of a job.

    Attributes
    ----------
    files : content by file name, such as "image.png"
    facts : plain data for a record: "facerender", "GL_RENDERER", "GL_VERSION", and "camera" as of
        :func:`camera_facts`; with the pass depth "depth_scale", the mesh's units per value; with
        parts or layers "parts", their number; for a planned scene "planned", whether it was planned
        for images of this size and these samples, and was drawn as planned
    """

    files: dict[str, bytes]
    facts: dict[str, Any]


def draw(
    job: Job, mesh: Mesh, renderer: Renderer, outputs: Sequence[str], exposure: float
) -> Drawn:
    """Draw outputs of a job; docs/outputs.md describes their files.

    The image, the specular and the diffuse term are drawn once each, and all data once together,
    for any number of outputs. With one OpenGL driver the same job gives the same bytes.

    Parameters
    ----------
    mesh : the result of ``job.mesh.load()``
    renderer : made for the job's image settings
    outputs : names of OUTPUTS
    exposure : of image, specular and diffuse as PNG, in stops

    Raises
    ------
    InputError : as of :func:`check_outputs`, :meth:`facerender.Job.scene` and
        :meth:`facerender.Renderer.render`; more parts than parts.png can number; layers.exr without
        OpenEXR
    """
    check_outputs(outputs)
    if "layers" in outputs:
        openexr("layers.exr")
    if "parts" in outputs and len(mesh.parts) > _MOST:
        raise InputError(
            f"{mesh.name} has {len(mesh.parts)} parts, and parts.png numbers {_MOST}: ask for "
            "layers in place of parts"
        )
    detail = job.detail(renderer.samples)
    facts: dict[str, Any] = {
        name: renderer.metadata[name] for name in ("facerender", "GL_RENDERER", "GL_VERSION")
    }
    if job.planned:
        facts["planned"] = job.planned.holds(renderer.size, renderer.samples)
    # Before the material is set, which makes another mesh: a simplified mesh serves all jobs.
    drawn = mesh if detail.triangles is None else simplified(mesh, detail.triangles)
    scene = job.scene(drawn)
    view = view_of(scene, renderer.size[0] / renderer.size[1])
    facts["camera"] = camera_facts(view, mesh, renderer.size)
    frames = _frames(job, scene, detail, renderer, OUTPUTS if "layers" in outputs else outputs)
    if "depth" in outputs:
        facts["depth_scale"] = _depth_scale(view, mesh)
    files = {}
    for name in filter(outputs.__contains__, OUTPUTS):
        file = file_name(name)
        if name == "layers":
            files[file] = exr_bytes(file, _layers(frames), frames["image"].metadata)
        else:
            pixels = _pixels(frames[name], name, exposure, facts.get("depth_scale", 1.0))
            files[file] = png_bytes(pixels, frames[name].metadata)
    if {"parts", "layers"} & set(outputs):
        facts["parts"] = len(mesh.parts)
    return Drawn(files, facts)


def _frames(
    job: Job, scene: Scene, detail: LevelOfDetail, renderer: Renderer, outputs: Sequence[str]
) -> dict[str, Frame]:
    """Return the frames that outputs need, by name."""
    values = replace(detail, samples=min(detail.samples, renderer.samples)).values
    frames = {
        name: renderer.render(scene, job.shading, only, **values)
        for name, only in _SHADED.items()
        if name in outputs
    }
    if not _SHADED.keys() >= set(outputs):
        gbuffer = renderer.gbuffer(scene, job.shading, blended=False)
        metadata = {**renderer.metadata, "samples": "1"}
        for only in DATA:
            if only in outputs:
                linear = data_view(gbuffer, scene, only)
                frames[only] = Frame(linear, only, scene.background is None, metadata)
    return frames


def _pixels(frame: Frame, name: str, exposure: float, depth_scale: float) -> NDArray[Any]:
    """Return the values of a PNG."""
    if name == "mask":
        return np.uint8(255) * (frame.linear[..., 0] > 0.0)
    if name == "parts":
        return frame.linear[..., 0].astype(np.uint16)
    if name == "depth":
        depth = frame.linear[..., 0].astype(np.float64)
        return np.round(depth / depth_scale).astype(np.uint16)
    return frame.srgb8(exposure)


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


def _depth_scale(view: View, mesh: Mesh) -> float:
    """Units of a mesh in a step of 16 bits: the farthest depth that it can have, which is that of
    its bounding sphere, is the last step. Cameras as far away as each other share it, whatever they
    see, on every driver."""
    farthest = 1.0 - float(view.position @ view.forward)
    return max(farthest, 0.0) * mesh.radius / _MOST or 1.0  # where all is behind the camera


def _layers(frames: Mapping[str, Frame]) -> dict[str, NDArray[Any]]:
    """The channels of layers.exr: every pass as float32."""
    return {
        channel: frames[name].linear[..., index]
        for name, channels in _CHANNELS.items()
        for index, channel in enumerate(channels)
    }
