"""Poses of a mesh: weights of shapes, angles of joints, a clip's time, or a frame of a file of
vertex positions. A pose is plain data; :func:`posed` applies it to a mesh."""

from __future__ import annotations

import os
import sys
import zipfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from facerender.errors import InputError, clipped, quoted, reason
from facerender.mesh.mesh import Mesh, tracked
from facerender.system.files import suffix_of
from facerender.system.process import MIB, limit
from facerender.values.fields import PATH, SWITCH, TEXT, Entries, IntegerRange, Range, field, record
from facerender.values.vectors import ROTATIONS, SHAPE_WEIGHTS, Array, Vector


@record("pose ")
class Pose:
    """Pose of a mesh. Without values, it is the pose that the mesh file stores."""

    weights: Mapping[str, float] = field(
        Entries(SHAPE_WEIGHTS, "weight", "names of shapes"),
        text="weight of each shape (morph target) by name; see :meth:`facerender.Mesh.with_pose`",
        default_factory=dict,
    )
    clip: str | None = field(
        TEXT, None, "animation of the mesh file", unset="none; the first with a time"
    )
    time: float | None = field(Range(0.0, 1e6, "s"), None, "time in the clip", unset="0")
    vertices: str | None = field(
        PATH,
        None,
        "file of vertex positions, of which a pose is one frame",
        "The file is .npy of shape (frames, vertices, 3), or .npz with such an array for each part",
        "the mesh file's",
    )
    frame: int = field(
        IntegerRange(0, 1 << 30), 0, "index of the frame in ``vertices``; 0 without vertices"
    )
    track: bool = field(
        SWITCH,
        False,
        "orbiting cameras follow the head of a moving mesh",
        "By default, cameras frame the stored pose and stay",
    )
    joints: Mapping[str, Vector] = field(
        Entries(ROTATIONS, "joint", "names of joints"),
        text="angles x, y, z in degrees by name of the joint; see "
        ":meth:`facerender.Mesh.with_pose`",
        default_factory=dict,
    )

    def __post_init__(self) -> None:
        moves = self.weights or self.joints or self.clip is not None or self.time is not None
        if self.vertices is not None and moves:
            excluded = "weights, joints, clip and time: leave one of them out"
            raise InputError(f"pose vertices = {quoted(self.vertices)} exclude {excluded}")
        if self.frame and self.vertices is None:
            raise InputError(f"pose frame = {self.frame} needs vertices: give the file as well")


def posed(mesh: Mesh, pose: Pose) -> Mesh:
    """Return a mesh in a pose, see :meth:`Mesh.with_pose` and :meth:`Mesh.with_positions`."""
    if pose.vertices is not None:
        arrays, count = _arrays(pose.vertices), frame_count(pose.vertices)
        if pose.frame >= count:
            start = f"{clipped(Path(pose.vertices).name)} has {count} frames"
            raise InputError(f"{start}: frame = {pose.frame} is not below {count}")
        positions = {key: array[pose.frame] for key, array in arrays.items()}
        is_array = Path(pose.vertices).suffix.lower() == ".npy"
        mesh = mesh.with_positions(positions[""] if is_array else positions)
    elif pose.weights or pose.joints or pose.clip is not None or pose.time is not None:
        mesh = mesh.with_pose(pose.weights, joints=pose.joints, clip=pose.clip, time=pose.time)
    return tracked(mesh) if pose.track else mesh


def frame_count(path: str | os.PathLike[str]) -> int:
    """Return the number of frames in a file of vertices. For errors see :func:`posed`."""
    return len(next(iter(_arrays(os.fspath(path)).values())))


def _arrays(path: str) -> Mapping[str, Array]:
    """Return the arrays (frames, vertices, 3) of a file, keyed by part name; "" for a .npy."""
    suffix_of(path, (".npy", ".npz"), "vertices", "a file of vertices", sys.maxsize)
    status = os.stat(path)
    return _opened(path, status.st_size, status.st_mtime_ns)


@lru_cache(4)
def _opened(path: str, size: int, modified: int) -> Mapping[str, Array]:
    name = clipped(Path(path).name)
    try:
        if Path(path).suffix.lower() == ".npy":
            arrays = {"": np.load(path, mmap_mode="r", allow_pickle=False)}
        else:
            with zipfile.ZipFile(path) as file:
                needed = sum(entry.file_size for entry in file.infolist())
            if needed > limit(None) * MIB:
                raise ValueError(f"its arrays have {needed} bytes, more than the free memory")
            with np.load(path, allow_pickle=False) as file:
                arrays = {**file}
    except MemoryError:
        raise InputError(f"{name} does not fit into memory: give fewer frames") from None
    except Exception as error:  # NumPy and zipfile raise many exceptions for damaged files
        raise InputError(f"{name} is damaged: {reason(error)}; write it with numpy.save") from None
    if not arrays:
        raise InputError(f"{name} has no arrays: give (frames, vertices, 3) for each part")
    for key, array in arrays.items():
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "fiu":
            raise InputError(
                f"{name}{f', array {clipped(key, 40)}' * bool(key)}, has the shape {array.shape} "
                f"and type {array.dtype}: give numbers of shape (frames, vertices, 3)"
            )
    counts = {*map(len, arrays.values())}
    if len(counts) > 1 or 0 in counts:
        raise InputError(f"the arrays of {name} have {sorted(counts)} frames: give equal numbers")
    return arrays
