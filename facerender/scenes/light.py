"""Lights: distant ones and points. Angles in degrees, lengths in the mesh's units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range
from facerender.scenes.vectors import Vector, direction_to, non_negative, vector


@dataclass(frozen=True)
class Light:
    """A distant light, or a point light when it has a position.

    Parameters
    ----------
    azimuth, elevation : degrees, the direction in which a distant light stands, as for the camera
    irradiance : what a surface facing the light receives, one number or linear RGB; of a point
        light: at the centre of the mesh. pi shows a white diffuse surface as 1.
    position : of a point light, in the mesh's units; azimuth and elevation then do not count
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    irradiance: float | Vector = math.pi
    position: Vector | None = None

    def __post_init__(self) -> None:
        check_range("light azimuth", self.azimuth, -3600, 3600)
        check_range("light elevation", self.elevation, -90, 90)
        irradiance = non_negative("light irradiance", self.irradiance)
        object.__setattr__(self, "irradiance", irradiance)
        if self.position is not None:
            object.__setattr__(self, "position", vector("light position", self.position))

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector towards a distant light."""
        return direction_to(self.azimuth, self.elevation)


# Key and rim are high and oblique, where the highlight of skin shows.
LIGHTS: Mapping[str, Light] = {
    "key": Light(azimuth=-50.0, elevation=42.0, irradiance=(3.6, 3.4, 3.1)),
    "rim": Light(azimuth=100.0, elevation=33.0, irradiance=(2.4, 2.5, 2.7)),
    "fill": Light(azimuth=50.0, elevation=5.0, irradiance=(0.34, 0.36, 0.4)),
    "front": Light(azimuth=0.0, elevation=10.0, irradiance=2.5),
    "top": Light(azimuth=0.0, elevation=75.0, irradiance=2.5),
}


def parse_light(text: str) -> Light:
    """Read a light from ``NAME``, ``AZIMUTH,ELEVATION[,IRRADIANCE]`` or
    ``point:X,Y,Z[,IRRADIANCE]``, the irradiance being E or R,G,B.

    Raises
    ------
    InputError : neither a known name nor numbers of that form
    """
    if text in LIGHTS:
        return LIGHTS[text]
    kind, _, rest = text.rpartition(":")
    try:
        values = [float(word) for word in rest.split(",")]
        count = {"": 2, "point": 3}[kind]
        where, irradiance = values[:count], values[count:] or [math.pi]
        if len(where) != count or len(irradiance) not in (1, 3):
            raise ValueError
    except (KeyError, ValueError):
        raise InputError(
            f"unknown light {text!r}; give {', '.join(LIGHTS)}, or AZIMUTH,ELEVATION[,IRRADIANCE],"
            " or point:X,Y,Z[,IRRADIANCE]"
        ) from None
    received = vector("light irradiance", irradiance if irradiance[1:] else irradiance[0])
    if kind == "point":
        return Light(irradiance=received, position=vector("light position", where))
    return Light(where[0], where[1], received)
