"""Three numbers from what a user gave, and directions from angles. Angles in degrees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, shown
from facerender.terms.ranges import Range, VectorRange

Vector = tuple[float, float, float]

FARTHEST = 1e30  # of places, in the mesh's units
HIGHEST = 1e9  # of radiance, irradiance and albedo: what is drawn stays in float32
MOST_RADII = 1e6  # of the mesh, between its centre and what sees or lights it

POSITIONS = VectorRange(-FARTHEST, FARTHEST)
COLORS = VectorRange(0.0, HIGHEST)  # linear RGB, also of irradiance
AZIMUTHS = Range(-3600.0, 3600.0, "degrees")
ELEVATIONS = Range(-90.0, 90.0, "degrees")


def within_reach(name: str, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a place in the renderer's space, (3,), that float32 tells from its neighbours.

    Raises
    ------
    InputError : it is more than MOST_RADII from the mesh's centre
    """
    if not (np.abs(place) <= MOST_RADII).all():
        raise InputError(
            f"{name} is {np.abs(place).max():.3g} radii of the mesh from its centre: give "
            f"{MOST_RADII:g} at most"
        )
    return place


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
