"""Lights, and the kinds of them: each kind is one entry, and one file in ``shaders/host/light``.
Angles are in degrees, lengths in the mesh's units."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range
from facerender.scenes.vectors import Vector, direction_to, non_negative, vector

if TYPE_CHECKING:
    from facerender.scenes.mesh import Mesh

Float = NDArray[np.float64]


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
    def direction(self) -> Float:
        """Unit vector towards a distant light."""
        return direction_to(self.azimuth, self.elevation)

    @property
    def kind(self) -> LightKind:
        """Its entry in LIGHT_KINDS."""
        return next(kind for kind in LIGHT_KINDS.values() if kind.matches(self))


@dataclass(frozen=True, eq=False)
class LightKind:
    """A kind of light. Its file ``host/light/NAME.glsl`` declares uniform arrays of NAME_LIGHTS
    elements and ``Light NAME_light(int i, vec3 position)``.

    Attributes
    ----------
    name : of its file, such as "point"
    example : one to price it with
    matches : whether a light is of this kind; the first kind that does counts
    uniforms : of lights and their mesh, the arrays by name, each (N, 3), in the renderer's space
    lighting : of a light, its mesh and positions (..., 3) in the renderer's space: unit vectors
        towards it and its irradiance there, in float64
    highest : the largest irradiance that it may give anywhere; None where nobody knows: a guarantee
        then refuses it
    """

    name: str
    example: Light
    matches: Callable[[Light], bool]
    uniforms: Callable[[Sequence[Light], Mesh], dict[str, Float]]
    lighting: Callable[[Light, Mesh, Float], tuple[Float, Float]]
    highest: Callable[[Light], float] | None = None

    @property
    def price(self) -> str:
        """What tables of prices call it."""
        return f"{self.name} light"


def _distant(lights: Sequence[Light], mesh: Mesh) -> dict[str, Float]:
    return {
        "light_direction": np.array([light.direction for light in lights]),
        "light_irradiance": np.array([light.irradiance for light in lights]),
    }


def _point(light: Light, mesh: Mesh) -> tuple[Float, Float]:
    """Return position and intensity in the renderer's space, (3,) each. The intensity is the
    irradiance at the mesh's centre, times the square of the distance from there.

    Raises
    ------
    InputError : the light stands at the centre itself
    """
    assert light.position is not None
    position = mesh.normalised(light.position)
    distance2 = float(position @ position)
    if distance2 < 1e-12:
        raise InputError(f"point light {light.position} is at the mesh's centre; move it")
    return position, np.asarray(light.irradiance) * distance2


def _points(lights: Sequence[Light], mesh: Mesh) -> dict[str, Float]:
    positions, intensities = zip(*(_point(light, mesh) for light in lights), strict=True)
    return {"light_position": np.array(positions), "light_intensity": np.array(intensities)}


def _point_lighting(light: Light, mesh: Mesh, position: Float) -> tuple[Float, Float]:
    source, intensity = _point(light, mesh)
    to_light = source - position
    distance2 = (to_light**2).sum(axis=-1, keepdims=True)
    return to_light / np.sqrt(distance2), intensity / distance2


LIGHT_KINDS: dict[str, LightKind] = {
    kind.name: kind
    for kind in (
        LightKind(
            "point",
            example=Light(irradiance=2.0, position=(1.0, 2.0, 3.0)),
            matches=lambda light: light.position is not None,
            uniforms=_points,
            lighting=_point_lighting,
            highest=lambda light: math.inf,  # it may be as near as one likes
        ),
        LightKind(
            "directional",
            example=Light(30.0, 35.0, 2.0),
            matches=lambda light: True,
            uniforms=_distant,
            lighting=lambda light, mesh, position: (light.direction, np.asarray(light.irradiance)),
            highest=lambda light: float(np.max(light.irradiance)),
        ),
    )
}


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
