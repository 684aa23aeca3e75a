"""Checked vectors and arrays, and directions from angles in degrees."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.errors import InputError, check_known, quoted, reason
from facerender.values.fields import Range, SizeRange, VectorRange

Vector = tuple[float, float, float]
Size = tuple[int, int]  # width and height of an image in pixels
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Array = NDArray[Any]

SHAPE_WEIGHTS = Range(-100.0, 100.0)  # accepted weights of morph targets
FARTHEST = 1e30  # largest coordinate of a position, in mesh units
MAX_RADIANCE = 1e9  # limit of colours and light, so that images do not overflow float32
MAX_RADII = 1e6  # largest distance of camera and lights from the mesh's centre, in mesh radii

MILLIMETRES = Range(1e-6, 1e6, "mm")  # length of a mesh unit
IMAGE_SIZES = SizeRange(1, 1 << 30, "pixels")  # of any image, also one that no driver can draw
POSITIONS = VectorRange(-FARTHEST, FARTHEST, "mesh units", single=False)
COLORS = VectorRange(0.0, MAX_RADIANCE)  # linear RGB of a colour or an irradiance
AZIMUTHS = Range(-3600.0, 3600.0, "degrees")
ROTATIONS = VectorRange(-3600.0, 3600.0, "degrees", single=False)  # see rotation_of()
ELEVATIONS = Range(-90.0, 90.0, "degrees")
# Keyed by the axis of a file that points up: angles of the shortest rotation from this axis to y.
# For -y, it keeps the direction of the face.
UPS: dict[str, Vector] = {
    **{"y": (0.0, 0.0, 0.0), "z": (-90.0, 0.0, 0.0), "x": (0.0, 0.0, 90.0)},
    **{"-y": (0.0, 0.0, 180.0), "-z": (90.0, 0.0, 0.0), "-x": (0.0, 0.0, -90.0)},
}
UP_NAMES = (*UPS, "auto")  # values of ``up``; "auto" turns the face upright that is found


def within_reach(name: str, position: Float) -> Float:
    """Check that float32 can resolve a position (3,) in the renderer's space, and return it."""
    if not (reach := np.abs(position).max()) <= MAX_RADII:
        far = f"{name} is {reach:.3g} mesh radii from the mesh's centre"
        raise InputError(f"{far}: give at most {MAX_RADII:g}")
    return position


def numbers_in(words: Iterable[str]) -> list[float]:
    """Parse numbers; return no numbers if a word is not a number."""
    try:
        return [*map(float, words)]
    except ValueError:
        return []


def check_array(name: str, value: Any, columns: int) -> None:
    """Raise InputError if a value is not a numeric array of shape (N, columns)."""
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "fiu"):
        raise InputError(f"{name} = {quoted(value)}: give an array of numbers")
    if value.shape[1:] != (columns,):
        raise InputError(f"{name} has the shape {value.shape}: give (N, {columns})")


def direction_to(azimuth: float, elevation: float) -> Float:
    """Return a unit vector from angles: azimuth 0 is +z (front), 90 is +x; elevation 90 is +y."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])


def pyrr_rotations() -> Any:
    """Return the module ``pyrr.matrix33``. Its import takes 16 ms, and few scenes need it."""
    with warnings.catch_warnings():
        # The docstrings of pyrr 0.10.3 have invalid escape sequences, of which Python warns when it
        # compiles them.
        warnings.simplefilter("ignore")
        from pyrr import matrix33
    return matrix33


def rotation_of(angles: ArrayLike) -> Float:
    """Return the matrix (3, 3), for column vectors, of rotations about x, then y, then z.

    angles : (3,), in degrees; the axes are fixed. Multiples of 90 degrees give exact elements
    """
    matrix33 = pyrr_rotations()
    x, y, z = np.radians(np.fmod(angles, 360.0))
    turns = matrix33.create_from_z_rotation(z) @ matrix33.create_from_y_rotation(y)
    matrix: Float = turns @ matrix33.create_from_x_rotation(x)
    exact = np.rint(matrix)
    return np.where(np.abs(matrix - exact) < 1e-15, exact + 0.0, matrix)


def axis_of(vector: Float) -> str:
    """Return the axis nearest to the direction of a vector (3,), one of UPS."""
    index = int(np.abs(vector).argmax())
    return "-" * bool(vector[index] < 0.0) + "xyz"[index]


def upright_of(axes: Float) -> tuple[str, float, Float]:
    """Return how a face with axes (3, 3), rows right, up and front, is turned upright: the value
    of ``load_mesh(up=...)``, a multiple of 90 degrees to rotate about y afterwards, and the matrix
    (3, 3) of these two rotations if they leave at most 15 degrees, or else of the face itself."""
    up = axis_of(axes[1])
    x, _, z = rotation_of(UPS[up]) @ axes[2]
    angle = 90.0 * round(-math.degrees(math.atan2(x, z)) / 90.0) % 360.0
    rotation = rotation_of((0.0, angle, 0.0)) @ rotation_of(UPS[up])
    cosine = ((rotation * axes).sum() - 1.0) / 2.0
    return up, angle, rotation if cosine >= math.cos(math.radians(15.0)) else axes


def axes_of(up: str, rotate: ArrayLike, upright: Float | None = None) -> Float | None:
    """Return the matrix (4, 4) from the axes of a file to mesh space; None if it changes nothing.

    up, rotate : see :func:`facerender.load_mesh`, also for the errors
    upright : rotation (3, 3) for ``up="auto"``; None for other values of ``up``
    """
    check_known("up", up, UPS if upright is None else UP_NAMES)
    angles = ROTATIONS.check("rotate", rotate)
    if up == "y" and not any(angles):
        return None  # without the import of pyrr
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(angles) @ (rotation_of(UPS[up]) if upright is None else upright)
    return None if (matrix == np.eye(4)).all() else matrix


def rows_of(
    name: str, array: ArrayLike, widths: tuple[int, ...], hint: str = "", count: int | None = None
) -> Float:
    """Return a float64 copy of an array. Check its shape, and that all its numbers are finite.

    widths : allowed numbers of columns
    count : required number of rows; None for any
    """
    try:
        values = np.asarray(array)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{name} cannot be an array ({reason(error)}): give rows") from None
    if values.dtype.kind not in "fiu" or values.ndim != 2 or values.shape[1] not in widths:
        expected = " or ".join(map(str, widths))
        problem = f"{name} has the shape {values.shape} and type {values.dtype}"
        raise InputError(f"{problem}: give rows of {expected} numbers{hint}")
    if not len(values) or count not in (None, len(values)):
        expected = f"{count}, one for each vertex" if count else "at least one"
        raise InputError(f"{name} has {len(values)} rows: give {expected}")
    rows = np.array(values, dtype=np.float64)
    if not (finite := np.isfinite(rows).all(axis=1)).all():
        bad = int(finite.argmin())
        problem = f"{int((~finite).sum())} rows are not finite"
        raise InputError(f"{name}[{bad}] = {rows[bad].tolist()}: {problem}; leave them out")
    return rows


def unit(vectors: Float) -> Float:
    """Return vectors (..., 3) scaled to length 1; zero vectors stay zero."""
    length = np.sqrt(np.einsum("...i,...i", vectors, vectors))[..., None]
    return np.asarray(vectors / np.maximum(length, 1e-300))


def transformed(
    positions: Array, normals: Array | None, matrix: Float
) -> tuple[Float, Float | None, bool]:
    """Return positions and normals after a transform, and whether the transform mirrors. The
    normals have any length; they are None if there are none or the matrix is singular.

    matrix : (4, 4), for column vectors
    """
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear)) if np.isfinite(matrix).all() else 0.0
    turned = None
    if normals is not None and determinant:
        with suppress(np.linalg.LinAlgError):
            turned = np.asarray(normals, dtype=np.float64) @ np.linalg.inv(linear)
    return positions @ linear.T + matrix[:3, 3], turned, determinant < 0.0
