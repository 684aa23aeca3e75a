"""Three numbers from what a user gave, and directions from angles. Angles in degrees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, shown

Vector = tuple[float, float, float]


def vector(name: str, value: Any) -> Vector:
    """Return three finite numbers; one number stands for three equal ones."""
    try:
        array = np.broadcast_to(np.asarray(value, dtype=np.float64), 3)
    except (TypeError, ValueError):
        array = np.array([math.nan])
    if not np.isfinite(array).all():
        raise InputError(f"{name} = {value!r}: give a finite number, or three")
    x, y, z = (float(component) for component in array)
    return x, y, z


def non_negative(name: str, value: Any) -> Vector:
    """Return three finite numbers, none below 0, such as a colour or an irradiance."""
    numbers = vector(name, value)
    if min(numbers) < 0.0:
        raise InputError(f"{name} = {numbers} is negative")
    return numbers


def check_array(name: str, value: Any, columns: int) -> None:
    """Raise InputError where a value is no array (N, columns) of numbers, or (N,) for 0 columns."""
    shape = (columns,) if columns else ()
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "fiu"):
        raise InputError(f"{name} = {shown(value)}: give an array of numbers")
    if value.ndim != 1 + len(shape) or value.shape[1:] != shape:
        wanted = f"(N, {columns})" if columns else "(N,)"
        raise InputError(f"{name} has the shape {value.shape}: give {wanted}")


def direction_to(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Unit vector from the subject: azimuth 0 is +z (in front), 90 is +x; elevation 90 is +y."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
