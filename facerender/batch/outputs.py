"""The input files of a table of jobs, and the outputs of a job.

Each mesh, map, environment map, file of vertices and landmark file is read once to check it; poses
and landmarks must fit their meshes. Outputs are the contents of a job's files, and the data of its
record, including the camera. OpenGL is used through the caller's renderer only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.batch.jobs import OUTPUTS, Row, file_name
from facerender.drawing.frame import Frame
from facerender.errors import InputError, clipped
from facerender.images.files import exr_bytes, openexr, png_bytes
from facerender.images.image import Tone
from facerender.loading import MeshFile, load_mesh
from facerender.material import MAPS
from facerender.mesh.mesh import Mesh
from facerender.scene.environment import STUDIO, load_environment
from facerender.scene.job import Job
from facerender.scene.landmarks import load_landmarks, located
from facerender.scene.pose import Pose, frame_count, posed
from facerender.scene.view import View, view_of
from facerender.texture.texture import Texture

if TYPE_CHECKING:
    from facerender.drawing.renderer import Renderer


_File = tuple[str, Any]  # name in _READ, and a path, or a MeshFile without maps
_Location = tuple[int, str]  # number of a row, and its position as a text for messages
# Fields of a mesh that select and check its content. Jobs that differ in its maps, orientation or
# number of triangles share a MeshFile of these fields, so that the file is read once.
_OPTIONS = ("path", "allow_outside", "as_is", "parts", "hide")
_WHITE = Texture.from_array([[[1.0, 1.0, 1.0]]])


def file_faults(rows: Iterable[tuple[str, Row, Job]]) -> list[str]:
    """Return a message for each input file that cannot be used, and for each shape, clip, file of
    vertices and landmark file that does not fit its mesh. Maps of mesh files are decoded, too. A
    message has the position of the first row with this file; for a clip and a file of vertices, of
    the row with the largest time or frame."""
    locations: dict[_File, _Location] = {}  # of the first row with a file
    # Poses and landmark files that must fit a mesh, by mesh and text, with the time or frame.
    uses: dict[_File, dict[str, tuple[float, _Location, Pose | str]]] = {}
    for position, row, job in rows:
        location = row.number, position
        mesh_file, *files = _files(job)
        for file in (mesh_file, *files):
            locations.setdefault(file, location)
        mesh_uses = uses.setdefault(mesh_file, {})
        moves = not {"motion", "layers"}.isdisjoint(row.outputs)
        for pose in (*_single(job.pose), *(_single(job.before) if moves else ())):
            key, moment = str(replace(pose, time=None, frame=0)), pose.time or pose.frame
            if key not in mesh_uses or moment > mesh_uses[key][0]:
                mesh_uses[key] = moment, location, pose
        if job.landmarks:
            mesh_uses.setdefault(job.landmarks, (0.0, location, job.landmarks))
    faults: dict[tuple[_File, str], _Location] = {}

    def attempt(
        file: _File, location: _Location, name: str, call: Callable[..., Any], *arguments: Any
    ) -> Any:
        """Return the result of a call, or note its error and return None."""
        try:
            return call(*arguments)
        except InputError as error:
            text = str(error)
        except MemoryError:
            text = f"{name} does not fit into memory: make it smaller"
        except Exception as error:  # as in the worker, a reader may raise any exception
            text = f"{name} cannot be read: {clipped(str(error))}"
        faults.setdefault((file, text), location)
        return None

    def read(file: _File) -> Any:
        name = file[1].path or "the built-in head" if file in uses else file[1]
        return attempt(file, locations[file], name, _READ[file[0]], file[1])

    unread = {path for key, path in locations.keys() - uses.keys() if read((key, path)) is None}
    for file, mesh_uses in uses.items():
        mesh = read(file)  # a large table has many meshes: one is in memory at a time
        for _, location, use in mesh_uses.values():
            path = use.vertices if isinstance(use, Pose) else use
            if mesh is not None and path not in unread:
                attempt(file, location, path or "its pose", _check_use, mesh, use)
    ordered = sorted((location, text) for (_, text), location in faults.items())
    return [f"{position}: {text}" for (_, position), text in ordered]


def _files(job: Job) -> Iterator[_File]:
    """Yield the files of a job, the mesh first."""
    # If a job replaces the albedo map, the map of the mesh file need not be readable.
    options = {name: getattr(job.mesh, name) for name in _OPTIONS}
    yield "mesh", MeshFile(**options, albedo=job.mesh.albedo and _WHITE)
    yield from (("map", path) for path in job.mesh.files if path is not job.mesh.path)
    if job.environment and job.environment.file != STUDIO:
        yield "environment", job.environment.file
    yield from (("vertices", pose.vertices) for pose in (job.pose, job.before) if pose.vertices)
    if job.landmarks:
        yield "landmarks", job.landmarks


def _single(pose: Pose) -> Iterator[Pose]:
    """Yield poses, each with one shape, joint, clip or file of vertices of a pose."""
    yield from (Pose({name: 0.0}) for name in pose.weights)
    yield from (Pose(joints={name: (0.0, 0.0, 0.0)}) for name in pose.joints)
    if pose.vertices is not None or pose.clip is not None or pose.time is not None:
        yield replace(pose, weights={}, joints={}, track=False)


def _check_use(mesh: Mesh, use: Pose | str) -> None:
    """Raise InputError if a mesh lacks a shape, joint or clip, or other data do not fit it."""
    if isinstance(use, str):
        load_landmarks(use).positions(mesh)
    elif {*mesh.shapes}.isdisjoint(use.weights):  # else, the shape of the pose exists
        posed(mesh, use)


def _read_mesh(file: MeshFile) -> Mesh:
    """Load a mesh and decode its maps."""
    mesh = load_mesh(file)
    textures = {getattr(material, name) for material in mesh.materials for name in MAPS}
    for texture in textures - {None}:
        texture.texels()
    return mesh


_READ: dict[str, Callable[[Any], Any]] = {
    "mesh": _read_mesh,
    "map": lambda path: Texture.open(path).texels(),
    "environment": load_environment,
    "vertices": frame_count,
    "landmarks": load_landmarks,
}


# Channel names in layers.exr. The last letter of a name selects how compositing programs show the
# channel: Y is grey. mask.A is the name of Nuke's own mask layer.
_CHANNELS = {
    **{"image": ("R", "G", "B", "A"), "depth": ("Z",), "visibility": ("visibility.Y",)},
    **{n: tuple(f"{n}.{c}" for c in "RGB") for n in ("specular", "diffuse", "albedo", "cosines")},
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "mask": ("mask.A",),
    "parts": ("part.Y",),
    "motion": ("motion.X", "motion.Y"),
}
_MAX = 65535  # Largest 16-bit value.


@dataclass(frozen=True, eq=False)
class Drawn:
    """The frames of a job."""

    outputs: list[str]  # Names from OUTPUTS.
    frames: Mapping[str, Frame]  # Keyed by the name of the output, without "layers".
    exposure: float  # Of image.png, specular.png and diffuse.png, in stops.
    tone: Tone  # Of the same images.
    # Items of the job's record: driver, mesh and camera, and for some jobs depth_scale, parts,
    # planned and landmarks; docs/batch.md describes them.
    details: dict[str, Any]

    @cached_property
    def files(self) -> dict[str, bytes]:
        """The contents of the files, keyed by the file name, such as "image.png"."""
        files = {}
        for name in self.outputs:
            file = file_name(name)
            if name == "layers":
                image, mask = self.frames["image"], self.frames["mask"]
                moved = self.frames.get("motion", image)
                metadata = {**mask.metadata, **moved.metadata, **image.metadata}
                del metadata["only"]
                files[file] = exr_bytes(file, _layers(self.frames), metadata)
            else:
                scale = self.details.get("depth_scale", 1.0)
                files[file] = _png(self.frames[name], name, self.exposure, self.tone, scale)
        return files


def draw(
    job: Job, mesh: Mesh, renderer: Renderer, outputs: Sequence[str], exposure: float, tone: Tone
) -> Drawn:
    """Draw outputs of a job, with names from OUTPUTS, which docs/batch.md describes. On the same
    OpenGL driver, the same job gives the same bytes.

    mesh, renderer : ``job.mesh.load()``, and a renderer with the job's image settings
    exposure, tone : of image.png, specular.png and diffuse.png
    """
    if "layers" in outputs:
        openexr("layers.exr")
    if "parts" in outputs and len(mesh.parts) > _MAX:
        problem = f"has {len(mesh.parts)} parts, but parts.png holds at most {_MAX}"
        raise InputError(f"{mesh.name} {problem}: use the output layers instead of parts")
    detail = job.detail(renderer.samples)
    record: dict[str, Any] = {
        name: renderer.metadata[name] for name in ("facerender", "GL_RENDERER", "GL_VERSION")
    }
    record["mesh"] = job.anonymous or PurePath(job.mesh.path or "built-in").name
    if job.planned:
        record["planned"] = job.planned.covers(renderer.size, renderer.samples)
    moves = "motion" in outputs or ("layers" in outputs and job.pose != job.before)
    full_scene = job.scene(mesh, moves)
    scene = detail.of(full_scene)
    view = view_of(scene, renderer.size[0] / renderer.size[1])
    record["camera"] = camera_record(view, scene.mesh, renderer.size)
    needed = set(outputs)
    if "layers" in outputs:
        needed |= {*OUTPUTS} - ({"motion"} if scene.before is None else set())
    needed |= {"depth"} if job.landmarks else set()
    names = [name for name in OUTPUTS if name in needed and name != "layers"]
    options = replace(detail, samples=min(detail.samples, renderer.samples)).values
    frames = renderer.render_outputs(scene, names, job.shading, **options)
    for name in {*frames} & {*outputs}:  # in this thread, which records the warnings of the job
        frames[name].warn_of_clipping(exposure, tone)
    if job.landmarks:
        # Landmarks count the vertices of the whole mesh, also if a simplified mesh is drawn.
        rows = landmark_record(job.landmarks, view, full_scene.mesh, frames["depth"])
        if job.anonymous is not None:
            rows = [row | {"name": f"landmark{i}"} for i, row in enumerate(rows, 1)]
        record["landmarks"] = rows
    if "depth" in outputs:
        # 65535 stands for the far side of the bounding sphere: the scale depends only on the camera
        # and this sphere, not on the visible surface or the driver.
        farthest = max(1.0 - float(view.position @ view.forward), 0.0)
        record["depth_scale"] = farthest * scene.mesh.radius / _MAX or 1.0  # 1 if all is behind.
    if {"parts", "layers"} & set(outputs):
        record["parts"] = [part.name for part in scene.labelled.mesh.parts]
    return Drawn([name for name in OUTPUTS if name in outputs], frames, exposure, tone, record)


def _png(frame: Frame, name: str, exposure: float, tone: Tone, depth_scale: float) -> bytes:
    """Return the content of a PNG file."""
    pixels: NDArray[Any]
    if name == "parts":
        pixels, values = frame.linear[..., 0].astype(np.uint16), "number of the part from 1"
    elif name == "depth":
        depth = frame.linear[..., 0].astype(np.float64)
        covered = frame.linear[..., 3] > 0.0  # 0 stands for no surface
        pixels = np.round(depth / depth_scale).clip(covered, _MAX).astype(np.uint16)
        values = f"{depth_scale:.9g} mesh units per step"
    elif name == "motion":
        pixels, values = _flow(frame.linear), "1/64 pixel per step, 0 at 32768"
    elif name == "mask":
        pixels, values = np.uint8(255) * (frame.linear[..., 0] > 0.0), "0 at 0, 255 at 1"
    else:
        return frame.encoded("png", exposure, tone)
    return png_bytes(pixels, {**frame.metadata, "range": values})


def _flow(linear: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return motion vectors in KITTI's 16-bit encoding of optical flow: 64 x + 2^15 in red, 64 y +
    2^15 in green, and in blue 1 where the values are valid. Values beyond the range, about 512
    pixels, are clamped and not valid. Source: Geiger et al. (2013), "Vision meets robotics", and
    its development kit."""
    steps = np.round(64.0 * linear[..., :2].astype(np.float64) + 32768.0)
    valid = linear[..., 3:] > 0.0
    pixels = np.zeros((*linear.shape[:2], 3), dtype=np.uint16)
    pixels[..., :2] = np.clip(steps, 0.0, _MAX) * valid
    within = ((steps >= 0.0) & (steps <= _MAX)).all(axis=-1, keepdims=True)
    pixels[..., 2:] = valid & within
    return pixels


def landmark_record(path: str, view: View, mesh: Mesh, depth: Frame) -> list[dict[str, Any]]:
    """Return "name", "x", "y", "depth" and "visible" of each landmark of a file, as
    :meth:`facerender.Renderer.landmarks` does; x and y are None behind the camera. The mesh has all
    vertices, in its pose; the frame has the term depth."""
    landmarks = load_landmarks(path)
    points = landmarks.positions(mesh)
    pixels, depths, visible = located(view, mesh, points, depth.linear)
    coordinates = [(x, y) if x == x else (None, None) for x, y in pixels.tolist()]
    rows = zip(landmarks.names, coordinates, depths.tolist(), visible.tolist(), strict=True)
    return [{"name": n, "x": x, "y": y, "depth": d, "visible": v} for n, (x, y), d, v in rows]


def camera_record(view: View, mesh: Mesh, size: tuple[int, int]) -> dict[str, Any]:
    """Return a camera as plain data, with lengths in mesh units: image size in pixels, intrinsic
    matrix "K" or, for an orthographic camera, "view_height", extrinsic matrix "Rt",
    "transform_matrix" and "distortion"; see docs/batch.md."""
    extrinsics = view.extrinsics(mesh)
    rotation = extrinsics[:, :3].T
    to_world = np.eye(4)
    to_world[:3, :3] = rotation * (1.0, -1.0, -1.0)
    to_world[:3, 3] = -rotation @ extrinsics[:, 3]
    camera: dict[str, Any] = {"width": size[0], "height": size[1]}
    if view.orthographic:
        camera["view_height"] = view.height(mesh)
    else:
        camera["K"] = view.intrinsics(size).tolist()
    camera["Rt"] = extrinsics.tolist()
    camera["transform_matrix"] = to_world.tolist()
    return camera | ({"distortion": list(view.distortion)} if view.distortion else {})


def transforms_frame(camera: Mapping[str, Any], file_path: str) -> dict[str, Any]:
    """Return one item of "frames" in a transforms.json for nerfstudio and instant-ngp, from the
    result of :func:`camera_record` and the path of the image, relative to the transforms.json."""
    coefficients: list[float] = camera.get("distortion", [])
    if any(coefficients[5:]):  # The format has a k4, with another meaning.
        problem = "the distortion coefficients k4 to k6, which transforms.json cannot store"
        remedy = "run the batch again without --transforms"
        raise InputError(f"{file_path}: its camera has {problem}: {remedy}")
    if "K" not in camera:
        problem = "is orthographic, which transforms.json cannot store"
        raise InputError(f"{file_path}: its camera {problem}: run the batch without --transforms")
    (fx, _, cx), (_, fy, cy), _ = camera["K"]
    size = {"w": camera["width"], "h": camera["height"]}
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    lens |= zip(("k1", "k2", "p1", "p2", "k3"), coefficients, strict=False)
    to_world = {"transform_matrix": camera["transform_matrix"]}
    return {"file_path": file_path, **size, **lens, **to_world}


def _layers(frames: Mapping[str, Frame]) -> dict[str, NDArray[Any]]:
    """Return the float32 channels of layers.exr, keyed by the channel name. Compositing programs
    expect albedo without background."""
    covered = frames["mask"].linear[..., 0]
    return {
        channel: frames[name].linear[..., index] * (covered if name == "albedo" else np.float32(1))
        for name, channels in _CHANNELS.items()
        if name in frames
        for index, channel in enumerate(channels)
    }
