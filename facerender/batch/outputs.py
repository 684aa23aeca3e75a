"""The input files of a table of jobs, and the outputs of a job.

Each mesh, map, environment map, file of vertices and landmark file is read once to check it; poses
and landmarks must fit their meshes. Outputs are the contents of a job's files, and the data of its
record, including the camera. OpenGL is used through the caller's renderer only."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender.batch.jobs import FILES, OUTPUTS, Row, check_outputs, file_name
from facerender.drawing.frame import Frame
from facerender.errors import InputError, clipped
from facerender.images.files import exr_bytes, openexr, png_bytes
from facerender.loading import load_mesh
from facerender.material import MAPS
from facerender.mesh.mesh import Mesh
from facerender.scene.environment import STUDIO, EnvironmentFile, load_environment
from facerender.scene.file import Pose
from facerender.scene.job import Job
from facerender.scene.landmarks import load_landmarks, located
from facerender.scene.vertices import frame_count, posed
from facerender.scene.view import View, view_of
from facerender.texture.texture import Texture

if TYPE_CHECKING:
    from facerender.drawing.renderer import Renderer


_File = tuple[Any, ...]  # kind of a file, its path, and options with which it is read
_Use = tuple[str, str | None]  # a key of Pose, or "landmarks", with a name or path
_Call = Callable[..., Any]
_Place = tuple[int, str]  # number of a row, and its position as a text for messages
_OPTIONS = ("allow_outside", "as_is", "parts", "hide")  # keys of a mesh that change its vertices


def file_faults(rows: Iterable[tuple[str, Row]]) -> list[str]:
    """Return a message for each input file that cannot be used, and for each shape, clip, file of
    vertices and landmark file that does not fit its mesh.

    A message names the first row with this file; for a clip and a file of vertices, the row with
    the largest time or frame. Maps that a mesh file names are decoded, too.

    rows : pairs of a row's position, as a text for messages, and the row
    """
    first_places: dict[_File, _Place] = {}
    uses: dict[_File, dict[_Use, tuple[float, _Place]]] = {}  # by mesh, with the time or frame
    for position, row in rows:
        place = row.number, position
        for file in (mesh := _mesh_of(row), *_files(row)):
            first_places.setdefault(file, place)
        mesh_uses = uses.setdefault(mesh, {})
        for use, moment in _uses(row):
            if use not in mesh_uses or moment > mesh_uses[use][0]:
                mesh_uses[use] = moment, place
    faults: dict[tuple[_File, str], _Place] = {}

    def attempt(file: _File, place: _Place, name: str, call: _Call, *arguments: Any) -> Any:
        """Return the result of a call, or note its error and return None."""
        try:
            return call(*arguments)
        except InputError as error:
            text = str(error)
        except MemoryError:
            text = f"{name} does not fit into memory: make it smaller"
        except Exception as error:  # as in the worker, a reader may raise any exception
            text = f"{name} cannot be read: {clipped(str(error))}"
        faults.setdefault((file, text), place)
        return None

    unread = set[str]()
    for file in first_places.keys() - uses.keys():
        if attempt(file, first_places[file], file[1], _READ[file[0]], *file[1:]) is None:
            unread.add(file[1])
    for file, mesh_uses in uses.items():
        name = file[1] or "the built-in head"
        mesh = attempt(file, first_places[file], name, _read_mesh, *file[1:])
        for use, (moment, place) in mesh_uses.items():
            if mesh is not None and use[1] not in unread:
                attempt(file, place, use[1] or "its clip", _check_use, mesh, *use, moment)
    places = sorted((place, text) for (_, text), place in faults.items())
    return [f"{position}: {text}" for (_, position), text in places]


def _mesh_of(row: Row) -> _File:
    mesh = row.tables.get("mesh", {})
    options = {name: mesh[name] for name in _OPTIONS if name in mesh}
    return "mesh", mesh.get("path"), "albedo" in mesh, json.dumps(options)


def _files(row: Row) -> Iterator[_File]:
    """Yield the files of a row, without the mesh."""
    for key, names in FILES.items():
        kind = {"mesh": "map", "environment": "environment"}.get(key, "vertices")
        table = row.tables.get(key, {})
        for path in (table.get(name) for name in names if name != "path"):
            if path and path != STUDIO:
                yield kind, path
    if "landmarks" in row.tables:
        yield "landmarks", row.tables["landmarks"]


def _uses(row: Row) -> Iterator[tuple[_Use, float]]:
    """Yield the names and files that must fit the row's mesh, each with its time or frame."""
    moves = not {"motion", "layers"}.isdisjoint(row.outputs)
    for key in ("pose", "before") if moves else ("pose",):
        pose = row.tables.get(key, {})
        for kind in ("weights", "joints"):
            yield from (((kind, name), 0.0) for name in pose.get(kind, ()))
        if "vertices" in pose:
            yield ("vertices", pose["vertices"]), pose.get("frame", 0)
        elif "clip" in pose or "time" in pose:
            yield ("clip", pose.get("clip")), pose.get("time", 0.0)
    if "landmarks" in row.tables:
        yield ("landmarks", row.tables["landmarks"]), 0.0


def _check_use(mesh: Mesh, kind: str, name: Any, moment: Any) -> None:
    """Raise InputError if a mesh lacks a shape, joint or clip, or other data do not fit it."""
    if kind == "landmarks":
        load_landmarks(name).positions(mesh)
    elif kind == "vertices":
        posed(mesh, Pose(vertices=name, frame=moment))
    elif kind == "clip":
        posed(mesh, Pose(clip=name, time=moment))
    elif kind == "joints":
        posed(mesh, Pose(joints={name: (0.0, 0.0, 0.0)}))
    elif name not in mesh.shapes:
        posed(mesh, Pose({name: 0.0}))


def _read_mesh(path: str | None, replaced: bool, options: str) -> Mesh:
    """Load a mesh and decode its maps; ``replaced``: whether a row replaces the albedo map."""
    albedo = Texture.from_array([[[1.0, 1.0, 1.0]]]) if replaced else None
    mesh = load_mesh(path, albedo=albedo, **json.loads(options))
    textures = {getattr(material, name) for material in mesh.materials for name in MAPS}
    for texture in textures - {None}:
        texture.texels()
    return mesh


_READ: dict[str, _Call] = {
    "map": lambda path: Texture.open(path).texels(),
    "environment": lambda path: load_environment(EnvironmentFile(path)),
    "vertices": frame_count,
    "landmarks": load_landmarks,
}


# Channel names in layers.exr. The last letter of a name selects how compositing programs show the
# channel: Y is grey. mask.A is the name of Nuke's own mask layer.
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
    "motion": ("motion.X", "motion.Y"),
}
_MOST = 65535  # Largest 16-bit value.


@dataclass(frozen=True, eq=False)
class Drawn:
    """The frames of a job."""

    outputs: list[str]  # Names from OUTPUTS.
    frames: Mapping[str, Frame]  # Keyed by the name of the output, without "layers".
    exposure: float  # Of image.png, specular.png and diffuse.png, in stops.
    # Plain data for the record: "facerender", "GL_RENDERER", "GL_VERSION"; "mesh", the path or
    # "built-in"; and "camera" from :func:`camera_facts`. With output depth, "depth_scale": mesh
    # units per step of the 16-bit depth. With output parts or layers, "parts": their names. For a
    # planned scene, "planned": whether the plan covers this size and number of samples, and was
    # therefore used. For a job with landmarks, "landmarks" from :func:`landmark_facts`.
    facts: dict[str, Any]

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
                scale = self.facts.get("depth_scale", 1.0)
                files[file] = _png(self.frames[name], name, self.exposure, scale)
        return files


def draw(
    job: Job, mesh: Mesh, renderer: Renderer, outputs: Sequence[str], exposure: float
) -> Drawn:
    """Draw the outputs of a job; docs/batch.md describes their files.

    layers.exr has motion if the poses of the job and of the frame before differ. On the same OpenGL
    driver, the same job gives the same bytes.

    Parameters
    ----------
    mesh, renderer : ``job.mesh.load()``, and a renderer with the job's image settings
    outputs : names from OUTPUTS
    exposure : exposure of image.png, specular.png and diffuse.png, in stops

    Raises
    ------
    InputError : :func:`check_outputs`, :meth:`facerender.Job.scene` or
        :meth:`facerender.Renderer.render` raises this error; the landmarks cannot be read or do
        not fit the mesh; the mesh has more than 65535 parts, the maximum of parts.png; OpenEXR is
        missing, which layers.exr needs
    """
    check_outputs(outputs)
    if "layers" in outputs:
        openexr("layers.exr")
    if "parts" in outputs and len(mesh.parts) > _MOST:
        raise InputError(
            f"{mesh.name} has {len(mesh.parts)} parts, but parts.png holds at most {_MOST}: use "
            "the output layers instead of parts"
        )
    detail = job.detail(renderer.samples)
    facts: dict[str, Any] = {
        name: renderer.metadata[name] for name in ("facerender", "GL_RENDERER", "GL_VERSION")
    }
    facts["mesh"] = job.mesh.path or "built-in"
    if job.planned:
        facts["planned"] = job.planned.holds(renderer.size, renderer.samples)
    moves = "motion" in outputs or ("layers" in outputs and job.pose != job.before)
    full_scene = job.scene(mesh, moves)
    scene = detail.of(full_scene)
    view = view_of(scene, renderer.size[0] / renderer.size[1])
    facts["camera"] = camera_facts(view, scene.mesh, renderer.size)
    needed = set(outputs)
    if "layers" in outputs:
        needed |= {*OUTPUTS} - ({"motion"} if scene.before is None else set())
    needed |= {"depth"} if job.landmarks else set()
    names = [name for name in OUTPUTS if name in needed and name != "layers"]
    options = replace(detail, samples=min(detail.samples, renderer.samples)).values
    frames = renderer.render_outputs(scene, names, job.shading, **options)
    if job.landmarks:
        # Landmarks count the vertices of the whole mesh, also if a simplified mesh is drawn.
        facts["landmarks"] = landmark_facts(job.landmarks, view, full_scene.mesh, frames["depth"])
    if "depth" in outputs:
        # 65535 stands for the far side of the bounding sphere: the scale depends only on the camera
        # and this sphere, not on the visible surface or the driver.
        farthest = max(1.0 - float(view.position @ view.forward), 0.0)
        facts["depth_scale"] = farthest * scene.mesh.radius / _MOST or 1.0  # 1 if all is behind.
    if {"parts", "layers"} & set(outputs):
        facts["parts"] = [part.name for part in mesh.parts]
    return Drawn([name for name in OUTPUTS if name in outputs], frames, exposure, facts)


def _png(frame: Frame, name: str, exposure: float, depth_scale: float) -> bytes:
    """Return the content of a PNG file."""
    pixels: NDArray[Any]
    if name == "parts":
        pixels, values = frame.linear[..., 0].astype(np.uint16), "number of the part from 1"
    elif name == "depth":
        depth = frame.linear[..., 0].astype(np.float64)
        pixels = np.round(depth / depth_scale).astype(np.uint16)
        values = f"{depth_scale:.9g} mesh units per step"
    elif name == "motion":
        pixels, values = _flow(frame.linear), "1/64 pixel per step, 0 at 32768"
    elif name == "mask":
        pixels, values = np.uint8(255) * (frame.linear[..., 0] > 0.0), "0 at 0, 255 at 1"
    else:
        return frame.encoded("png", exposure)
    return png_bytes(pixels, {**frame.metadata, "range": values})


def _flow(linear: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return motion vectors in KITTI's 16-bit encoding of optical flow: 64 x + 2^15 in red, 64 y +
    2^15 in green, and in blue 1 where the values are valid. Values beyond the range, about 512
    pixels, are clamped and not valid. Source: Geiger et al. (2013), "Vision meets robotics", and
    its development kit."""
    steps = np.round(64.0 * linear[..., :2].astype(np.float64) + 32768.0)
    valid = linear[..., 3:] > 0.0
    pixels = np.zeros((*linear.shape[:2], 3), dtype=np.uint16)
    pixels[..., :2] = np.clip(steps, 0.0, _MOST) * valid
    within = ((steps >= 0.0) & (steps <= _MOST)).all(axis=-1, keepdims=True)
    pixels[..., 2:] = valid & within
    return pixels


def landmark_facts(path: str, view: View, mesh: Mesh, depth: Frame) -> list[dict[str, Any]]:
    """Return the landmarks of a file as plain data.

    Parameters
    ----------
    mesh : mesh with all vertices, in its pose
    depth : frame of the term depth

    Returns
    -------
    for each landmark "name"; "x" and "y" in pixels, as of :meth:`facerender.Renderer.landmarks`, or
    None behind the camera; "depth" in mesh units; and "visible"
    """
    landmarks = load_landmarks(path)
    points = landmarks.positions(mesh)
    pixels, depths, visible = located(view, mesh, points, depth.linear)
    places = [(x, y) if x == x else (None, None) for x, y in pixels.tolist()]
    rows = zip(landmarks.names, places, depths.tolist(), visible.tolist(), strict=True)
    return [{"name": n, "x": x, "y": y, "depth": d, "visible": v} for n, (x, y), d, v in rows]


def camera_facts(view: View, mesh: Mesh, size: tuple[int, int]) -> dict[str, Any]:
    """Return a camera as plain data; lengths are in mesh units.

    Returns
    -------
    "width", "height" : image size in pixels
    "K" : 3 x 3 intrinsic matrix from :meth:`View.intrinsics`
    "Rt" : 3 x 4 matrix of :meth:`View.extrinsics`, from mesh space to OpenCV's camera space
        (x right, y down, z forward)
    "transform_matrix" : 4 x 4 matrix from the camera space of OpenGL and NeRF (x right, y up,
        z backward) to mesh space
    "distortion" : see :class:`facerender.Camera`; only if the camera has a lens distortion
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
        **({"distortion": list(view.distortion)} if view.distortion else {}),
    }


def transforms_frame(camera: Mapping[str, Any], file_path: str) -> dict[str, Any]:
    """Return one item of the list "frames" in a transforms.json for nerfstudio and instant-ngp.

    Parameters
    ----------
    camera : the result of :func:`camera_facts`
    file_path : path of the image, relative to the folder of transforms.json

    Raises
    ------
    InputError : the distortion has k4, k5 or k6, which the format lacks: its k4 has another meaning
    """
    coefficients: list[float] = camera.get("distortion", [])
    if any(coefficients[5:]):
        raise InputError(
            f"{file_path}: its camera has the distortion coefficients k4 to k6, which "
            "transforms.json cannot store: run the batch again without --transforms"
        )
    (fx, _, cx), (_, fy, cy), _ = camera["K"]
    return {
        "file_path": file_path,
        "w": camera["width"],
        "h": camera["height"],
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), coefficients, strict=False)),
        "transform_matrix": camera["transform_matrix"],
    }


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
