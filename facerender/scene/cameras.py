"""Load cameras from scene files, glTF files, and JSON or NumPy files with camera matrices."""

from __future__ import annotations

import json
import math
import os
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import ArrayLike

from facerender.errors import InputError, clipped, quoted, reason
from facerender.loading.gltf import scene_nodes
from facerender.loading.gltf_document import chunks, document_of
from facerender.loading.source import GLTF
from facerender.scene.camera import CAMERA_FILES, MAX_CAMERAS, Camera, named, world_to_camera
from facerender.scene.job import MAX_TEXT_BYTES, load_scene
from facerender.system.files import read_file, suffix_of
from facerender.values.fields import PATH, build
from facerender.values.vectors import IMAGE_SIZES, Float, axes_of

_DISTORTION = ("distortion", "dist", "distCoeffs", "D")  # names of the distortion coefficients
_VECTORS = ("t", "size", *_DISTORTION)
_MATRICES = ("R", "Rt", "K", "extrinsics", "intrinsics")


def load_cameras(
    path: str | os.PathLike[str],
    size: int | tuple[int, int] | None = None,
    *,
    up: str = "y",
    rotate: ArrayLike = (0.0, 0.0, 0.0),
) -> dict[str, Camera]:
    """Return the cameras of a file, keyed by their names. A camera without a name gets a key such
    as "rig_000": the file name without suffix (for glTF "camera") and the camera's index.

    Parameters
    ----------
    path : camera file in one of these formats

        - .toml: [[cameras]] or [camera], see :func:`facerender.load_scene`
        - .json: one table, a list of tables, or the key "cameras" with a list of tables. A table
          has the fields of :class:`Camera`, or intrinsics "K" (3 x 3), a pose ("Rt", 3 x 4 or
          4 x 4, or "R" and "t"), "width" and "height". The keys "name" and "distortion" ("dist",
          "distCoeffs" or "D") are optional. Or a transforms.json with "frames", as
          ``facerender batch --transforms``, nerfstudio and instant-ngp write it
        - .npz: arrays named like the keys of a .json table; an extra first axis is the camera index
        - .glb, .gltf: cameras, with their pose in the scene, and vertical angle of view, or height
          of an orthographic view
    size : width and height of the images in pixels; used if the file has intrinsics without a size
    up, rotate : as in :func:`facerender.load_mesh`, for cameras in the glTF file of the mesh.
        Cameras of other files are in mesh space

    Raises InputError if the file cannot be read, has no camera, or has an invalid camera.
    """
    size = None if size is None else IMAGE_SIZES.check("size", size)
    file = PATH.check("camera file", path)
    suffix = suffix_of(file, (*CAMERA_FILES, *GLTF), "camera", "a camera file")
    name = clipped(Path(path).name)
    if (axes := axes_of(up, rotate)) is not None and suffix not in GLTF:
        raise InputError(f"{name} is no glTF file: leave up and rotate out, and rotate its cameras")
    try:
        if suffix in GLTF:
            return gltf_cameras(read_file(path, "a camera file"), name, axes)
        if suffix == ".toml":
            scene = load_scene(path)
            cameras = scene.get("cameras", [scene["camera"]] if "camera" in scene else [])
        else:
            content = read_file(path, "a camera file", MAX_TEXT_BYTES)
            tables = _json(content, size) if suffix == ".json" else _arrays(content)
            cameras = [_camera(table, size) for table in tables]
    except InputError as error:
        message = str(error)
        raise InputError(message if name in message else f"{name}: {message}") from None
    if not cameras:
        raise InputError(f"{name} has no cameras: add [[cameras]]")
    return named(cameras, Path(path).stem)


def gltf_cameras(content: bytes, name: str, axes: Float | None) -> dict[str, Camera]:
    """Return the cameras of a glTF scene, keyed by the name of the node or, if the node has no
    name, by the name of the camera. For ``axes`` see :func:`axes_of`."""
    document = document_of(chunks(content, name)[0], name)
    cameras = []
    for index, world in scene_nodes(document, name, axes)[1].items():
        node = document["nodes"][index]
        if "camera" not in node:
            continue
        camera = document["cameras"][node["camera"]]
        label = node.get("name") or camera.get("name") or ""
        with np.errstate(all="ignore"):
            scale = np.linalg.norm(world[:3, :3], axis=0)
            pose = world_to_camera(world / [*scale, 1.0])
        lens: dict[str, Any] = {}
        if "orthographic" in camera:
            lens["view_height"] = 2.0 * abs(camera["orthographic"]["ymag"])
        elif "perspective" in camera:
            lens["fov"] = math.degrees(camera["perspective"]["yfov"])
        else:
            raise InputError(f"camera {quoted(label)} of {name} has no projection: give one")
        cameras.append(Camera(**lens, extrinsics=pose, name=label))
    if not cameras:
        raise InputError(f"{name} has no camera: give another file or camera angles")
    return named(cameras, "camera")


def _json(content: bytes, size: tuple[int, int] | None) -> list[Any]:
    try:
        tables = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"its JSON cannot be read ({reason(error)})") from None
    shared = tables if isinstance(tables, dict) else {}
    tables = shared.get("cameras", tables)
    if isinstance(frames := shared.get("frames"), list):
        tables = [_of_frame(shared, frame, size) for frame in frames[: MAX_CAMERAS + 1]]
    tables = tables if isinstance(tables, list) else [tables]
    if len(tables) > MAX_CAMERAS:
        raise InputError(f"it has {len(tables)} cameras, but the limit is {MAX_CAMERAS}")
    return tables


def _of_frame(shared: dict[str, Any], frame: Any, size: tuple[int, int] | None) -> dict[str, Any]:
    """Convert an item of "frames" in a transforms.json of nerfstudio or instant-ngp to a table with
    matrices. The file's table ``shared`` has the intrinsics of frames without their own."""
    table = dict(zip("wh", size or (), strict=False))
    table |= {**shared, **frame} if isinstance(frame, dict) else {}
    model = table.get("camera_model", "OPENCV")
    is_fisheye = table.get("k4") or table.get("is_fisheye")
    if is_fisheye or model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        raise InputError(f"camera_model = {quoted(model)}, or k4: give OPENCV, without fisheye")
    try:
        pose = world_to_camera(np.array(table["transform_matrix"], dtype=np.float64))
        width, height = float(table["w"]), float(table["h"])
        focal = table.get("fl_x") or width / 2.0 / math.tan(float(table["camera_angle_x"]) / 2.0)
        focal_y = focal
        if "camera_angle_y" in table:
            focal_y = height / 2.0 / math.tan(float(table["camera_angle_y"]) / 2.0)
        x, y = table.get("cx", width / 2.0), table.get("cy", height / 2.0)
        k = [[focal, 0.0, x], [0.0, table.get("fl_y", focal_y), y], [0.0, 0.0, 1.0]]
        coefficients = [float(table.get(key, 0.0)) for key in ("k1", "k2", "p1", "p2", "k3")]
        lens = {"distortion": coefficients} if any(coefficients) else {}
        return {"K": k, "Rt": pose, "width": int(width), "height": int(height), **lens}
    except (KeyError, IndexError, TypeError, ValueError, ArithmeticError) as error:
        cause = f"a frame cannot be read ({type(error).__name__} {reason(error)})"
        keys = "transform_matrix, w, h (or --size), and fl_x or camera_angle_x"
        raise InputError(f"{cause}: give {keys}") from None


def _arrays(content: bytes) -> list[dict[str, Any]]:
    try:
        with ZipFile(BytesIO(content)) as file:
            if sum(entry.file_size for entry in file.infolist()) > MAX_TEXT_BYTES:
                raise ValueError(f"more than {MAX_TEXT_BYTES} bytes")
        with np.load(BytesIO(content), allow_pickle=False) as arrays:
            values = {key: np.asarray(arrays[key]) for key in arrays.files}
    except Exception as error:  # NumPy, zipfile and zlib raise many exceptions
        raise InputError(f"it is not a NumPy file ({reason(error)}); write it again") from None
    pose = next((values[key] for key in ("Rt", "R", "extrinsics") if key in values), None)
    if pose is None:
        names = clipped(", ".join(values)) or "none"
        raise InputError(f"it has no pose (arrays: {names}): give K, R and t")
    count = len(pose) if (several := pose.ndim == 3) else 1
    tables: list[dict[str, Any]] = [{} for _ in range(min(count, MAX_CAMERAS))]
    for key, value in values.items():
        if key == "t" and value.shape[-1:] == (1,):
            value = value[..., 0]
        if key in _DISTORTION:  # OpenCV writes one row or one column
            apart = several and value.ndim > 1 and len(value) == count and value[0].size > 1
            value = value.reshape(count, -1) if apart else value.reshape(-1)
        depth = 2 if key in _MATRICES else int(key in _VECTORS)
        shared = value.ndim == depth
        if not shared and not (several and value.ndim == depth + 1 and len(value) == count):
            axes = f"{quoted(key)} has {value.ndim} axes"
            raise InputError(f"{axes}: give one matrix, or one per camera")
        for i, table in enumerate(tables):
            table[key] = (value if shared else value[i]).tolist()
    return tables


def _camera(table: Any, size: tuple[int, int] | None) -> Camera:
    """Convert a table with matrices, or with fields of Camera, to a camera."""
    if not isinstance(table, dict):
        raise InputError(f"camera = {quoted(table)}: give a table")
    # Records of batches have transform_matrix in addition to the same pose in Rt.
    fields = {key: value for key, value in table.items() if key != "transform_matrix"}
    if "R" in fields and "t" in fields:
        try:
            turn, shift = (np.array(fields.pop(key), float) for key in ("R", "t"))
            fields["extrinsics"] = np.column_stack([turn, shift.reshape(3)]).tolist()
        except (TypeError, ValueError, OverflowError):
            raise InputError("camera R and t: give 3 x 3 numbers and 3 numbers") from None
    if "Rt" in fields:
        pose = fields.pop("Rt")
        is_4x4 = isinstance(pose, list) and pose[3:] == [[0, 0, 0, 1]]
        fields["extrinsics"] = pose[:3] if is_4x4 else pose
    if "K" in fields:
        fields["intrinsics"] = fields.pop("K")
    for key in _DISTORTION:
        if key in fields:
            rows = fields.pop(key)
            nested = isinstance(rows, list) and all(isinstance(row, list) for row in rows)
            fields["distortion"] = [*chain(*rows)] if nested else rows
    if "width" in fields and "height" in fields:
        fields["size"] = [fields.pop("width"), fields.pop("height")]
    if "intrinsics" in fields and size is not None:
        fields.setdefault("size", list(size))
    fields["name"] = str(fields.get("name", ""))
    return build(Camera, fields, "camera")
