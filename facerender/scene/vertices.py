"""Poses of a job, and files of vertex positions, the frames of a moving mesh."""

from __future__ import annotations

import os
import sys
import zipfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.mesh.mesh import Mesh, tracked
from facerender.scene.file import Pose
from facerender.system.files import suffix_of
from facerender.system.process import MIB, limit


def posed(mesh: Mesh, pose: Pose) -> Mesh:
    """Return a mesh in a pose. Raises InputError if the mesh has no such shape or clip, or the file
    of vertices cannot be used; see :meth:`Mesh.with_pose` and :meth:`Mesh.with_positions`."""
    if pose.vertices is not None:
        arrays, name = _arrays(pose.vertices), clipped(Path(pose.vertices).name)
        count, frame = len(next(iter(arrays.values()))), pose.frame
        if frame >= count:
            raise InputError(f"{name} has {count} frames: frame = {frame} is not below {count}")
        positions = {key: array[frame] for key, array in arrays.items()}
        is_array = Path(pose.vertices).suffix.lower() == ".npy"
        mesh = mesh.with_positions(positions[""] if is_array else positions)
    elif pose.weights or pose.joints or pose.clip is not None or pose.time is not None:
        mesh = mesh.with_pose(pose.weights, joints=pose.joints, clip=pose.clip, time=pose.time)
    return tracked(mesh) if pose.track else mesh


def frame_count(path: str | os.PathLike[str]) -> int:
    """Return the number of frames in a file of vertices. For errors see :func:`posed`."""
    return len(next(iter(_arrays(os.fspath(path)).values())))


def _arrays(path: str) -> Mapping[str, NDArray[Any]]:
    """Return the arrays (frames, vertices, 3) of a file, keyed by part name; "" for a .npy."""
    suffix_of(path, (".npy", ".npz"), "vertices", "a file of vertices", sys.maxsize)
    status = os.stat(path)
    return _opened(path, status.st_size, status.st_mtime_ns)


@lru_cache(4)
def _opened(path: str, size: int, modified: int) -> Mapping[str, NDArray[Any]]:
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
