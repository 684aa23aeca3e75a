"""Lights and light kinds. Each kind has an entry in LIGHT_KINDS and a file in
``shaders/host/light``. Angles are in degrees, lengths in mesh units."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, quoted
from facerender.mesh.part import Space
from facerender.terms.model import MAX_RADIUS
from facerender.values import vectors
from facerender.values.fields import SWITCH, Range, field, plain, record
from facerender.values.vectors import AZIMUTHS, COLORS, ELEVATIONS, POSITIONS, Vector, within_reach

Float = NDArray[np.float64]

NEAREST = 1.05  # smallest distance of a shadow-casting point light from the centre, in mesh radii


@record("light ")
class Light:
    """A distant light, or a point light if it has a position."""

    azimuth: float = field(AZIMUTHS, 0.0, "direction to a distant light, defined as in Camera")
    elevation: float = field(ELEVATIONS, 0.0, "direction to a distant light, defined as in Camera")
    irradiance: float | Vector = field(
        COLORS,
        math.pi,
        "irradiance of a surface that faces the light, one number or linear RGB. For a point "
        "light, the surface is at the mesh's centre. An irradiance of pi shows a white diffuse "
        "surface as 1",
    )
    position: Vector | None = field(
        POSITIONS,
        None,
        "position of a point light in mesh units; excludes azimuth and elevation",
    )
    radius: float = field(
        Range(0.0, MAX_RADIUS, "degrees"),
        0.0,
        "angular radius, for a point light as seen from the mesh's centre. A light of radius 0 has "
        "no area; area lights have soft shadows",
    )
    shadow: bool = field(SWITCH, True, "whether the mesh casts shadows in this light")
    follow: bool = field(
        SWITCH,
        False,
        "whether the light follows the camera: its azimuth and elevation are then relative to the "
        "direction to the camera; excludes position",
    )

    TEXTS = "a text such as key or key,no-shadow"

    @classmethod
    def parse(cls, text: str) -> dict[str, Any]:
        """Return the fields of a light from ``NAME``, ``AZIMUTH,ELEVATION[,IRRADIANCE]`` or
        ``point:X,Y,Z[,IRRADIANCE]``. IRRADIANCE is one number or R,G,B. Each form may end with
        ``,radius=DEGREES``, ``,no-shadow`` and ``,follow``. Raises InputError for another text."""
        form, *options = re.split(r",(?=radius=|no-shadow\b|follow\b)", text)
        switches: dict[str, Any] = {"no-shadow": {"shadow": False}, "follow": {"follow": True}}
        fields = {k: v for word in options for k, v in switches.get(word, {}).items()}
        words = [word.removeprefix("radius=") for word in options if word not in switches]
        if radii := vectors.numbers_in(words):
            fields["radius"] = radii[0]
        prefix, _, arguments = form.rpartition(":")
        numbers, count = vectors.numbers_in(arguments.split(",")), {"": 2, "point": 3}.get(prefix)
        is_light = count and len(numbers) - count in (0, 1, 3)
        if len(options) != len(fields) or not (is_light or form in LIGHTS):
            raise InputError(f"unknown light {quoted(text)}; give {LIGHT_TEXTS}")
        if form in LIGHTS:
            return plain(LIGHTS[form]) | fields
        start, irradiance = numbers[:count], numbers[count:] or [math.pi]
        fields["irradiance"] = irradiance if irradiance[1:] else irradiance[0]
        if prefix == "point":
            return {"position": start, **fields}
        return {"azimuth": start[0], "elevation": start[1], **fields}

    def __post_init__(self) -> None:
        for name in ("azimuth", "elevation", "follow"):
            if self.position is not None and (value := getattr(self, name)):
                pair = f"light {name} = {value if value is True else f'{value:g}'} and position"
                raise InputError(f"{pair} exclude each other: leave one out")

    @property
    def direction(self) -> Float:
        """Unit vector towards a distant light."""
        return vectors.direction_to(self.azimuth, self.elevation)

    @property
    def kind(self) -> LightKind:
        """The light's entry in LIGHT_KINDS."""
        return next(entry for entry in LIGHT_KINDS.values() if entry.matches(self))


@dataclass(frozen=True, eq=False)
class LightKind:
    """A kind of light. The file ``host/light/NAME.glsl`` of the kind NAME declares uniform arrays
    of NAME_LIGHTS elements and the function ``Light NAME_light(int i, vec3 position)``.

    example : light that cost measurements use
    matches : whether a light can be of this kind; the first match in LIGHT_KINDS is its kind
    arrays : names of the uniform arrays
    elements : a light's element of each uniform array, (1,) to (3,), in the renderer's space
    lighting : for positions (..., 3) in the renderer's space, unit vectors to a light and the
        light's irradiance, in float64
    sine : sine of a light's angular radius, seen from positions (..., 3), as (..., 1) or one value
        for all positions; None for kinds without area
    """

    name: str
    example: Light
    matches: Callable[[Light], bool]
    arrays: tuple[str, ...]
    elements: Callable[[Light, Space], tuple[Float, ...]]
    lighting: Callable[[Light, Space, Float], tuple[Float, Float]]
    sine: Callable[[Light, Space, Float], Float] | None = None

    def uniforms(self, lights: Sequence[Light], space: Space) -> dict[str, Float]:
        """Return the uniform arrays, (N, 1) to (N, 3), of N lights of this kind by their names."""
        columns = zip(*(self.elements(light, space) for light in lights), strict=True)
        return {name: np.array(column) for name, column in zip(self.arrays, columns, strict=True)}

    @property
    def price(self) -> str:
        """Key of this light kind's cost in price tables."""
        return f"{self.name} light"

    @property
    def shadow_price(self) -> str:
        """Key of the cost of this light kind's shadow in price tables."""
        return "hard shadow" if self.sine is None else "soft shadow"


def _point(light: Light, space: Space) -> tuple[Float, Float]:
    """Return a point light's position and intensity in the renderer's space, (3,) each. The
    intensity is the irradiance at the mesh's centre times the squared distance to that centre."""
    assert light.position is not None
    position = within_reach(f"point light {light.position}", space.normalised(light.position))
    distance2 = float(position @ position)
    if distance2 < 1e-12:
        raise InputError(f"point light {light.position} is at the mesh's centre; move it")
    return position, np.asarray(light.irradiance) * distance2


def _point_lighting(light: Light, space: Space, position: Float) -> tuple[Float, Float]:
    source, intensity = _point(light, space)
    to_light = source - position
    distance2 = (to_light**2).sum(axis=-1, keepdims=True)
    return to_light / np.sqrt(distance2), intensity / distance2


def half_sum(sine: Float) -> Float:
    """Return (1 + cos R)/2 from the sine of a light's angular radius R."""
    return np.asarray(0.5 + 0.5 * np.sqrt(1.0 - sine**2))


def _sine(light: Light, *_: Any) -> Float:
    return np.array([math.sin(math.radians(light.radius))])


def _sphere(light: Light, space: Space) -> tuple[Float, Float, Float]:
    """Return position, intensity and radius of a sphere light in the renderer's space."""
    position, intensity = _point(light, space)
    distance = float(np.linalg.norm(position))
    size = distance * _sine(light)
    if size > (distance - space.reach) * math.sin(math.radians(MAX_RADIUS)) * (1.0 + 1e-9):
        cause = f"parts of the mesh may see a radius above {MAX_RADIUS:g} degrees"
        start = f"point light {light.position} with radius {light.radius:g} is too near"
        raise InputError(f"{start}: {cause}; reduce it, or move the light away")
    return position, intensity, size


def _sphere_sine(light: Light, space: Space, position: Float) -> Float:
    source, _, size = _sphere(light, space)
    return np.asarray(size / np.linalg.norm(source - position, axis=-1, keepdims=True))


def _distant(light: Light, *_: Any) -> tuple[Float, Float]:
    return light.direction, np.asarray(light.irradiance)


LIGHT_KINDS: dict[str, LightKind] = {
    entry.name: entry
    for entry in (
        LightKind(
            "point",
            example=Light(irradiance=2.0, position=(1.0, 2.0, 3.0)),
            matches=lambda light: light.position is not None and not light.radius,
            arrays=("light_position", "light_intensity"),
            elements=_point,
            lighting=_point_lighting,
        ),
        LightKind(
            "sphere",
            example=Light(irradiance=2.0, position=(1.0, 2.0, 3.0), radius=5.0),
            matches=lambda light: light.position is not None,
            arrays=("sphere_position", "sphere_intensity", "sphere_size"),
            elements=_sphere,
            lighting=_point_lighting,
            sine=_sphere_sine,
        ),
        LightKind(
            "disc",
            example=Light(30.0, 35.0, 2.0, radius=5.0),
            matches=lambda light: light.radius > 0.0,
            arrays=("disc_direction", "disc_irradiance", "disc_size"),
            elements=lambda light, space: (
                *_distant(light),
                np.append(_sine(light), half_sum(_sine(light))),
            ),
            lighting=_distant,
            sine=_sine,
        ),
        LightKind(
            "directional",
            example=Light(30.0, 35.0, 2.0),
            matches=lambda light: True,
            arrays=("light_direction", "light_irradiance"),
            elements=_distant,
            lighting=_distant,
        ),
    )
}

# Key and rim light are high and oblique, so that skin shows its specular highlights.
LIGHTS: Mapping[str, Light] = {
    "key": Light(azimuth=-50.0, elevation=42.0, irradiance=(3.6, 3.4, 3.1), radius=4.0),
    "rim": Light(azimuth=115.0, elevation=33.0, irradiance=(0.72, 0.75, 0.81), radius=4.0),
    "fill": Light(azimuth=50.0, elevation=5.0, irradiance=(0.34, 0.36, 0.4), radius=4.0),
    "front": Light(azimuth=0.0, elevation=10.0, irradiance=2.5, radius=4.0),
    "top": Light(azimuth=0.0, elevation=75.0, irradiance=2.5, radius=4.0),
}
# Texts that Light.parse accepts, for messages.
LIGHT_TEXTS = (
    f"{', '.join(LIGHTS)}, or AZIMUTH,ELEVATION[,IRRADIANCE], or point:X,Y,Z[,IRRADIANCE], then "
    "optionally ,radius=DEGREES for an area light, ,no-shadow, and ,follow to follow the camera"
)
# Two large soft lights at 45 degrees and a fill light, as in clinical photography: all views of a
# face are lit alike, and mirrored views are mirrored images.
_BOX: dict[str, Any] = {"irradiance": 1.3, "radius": 20.0, "follow": True}
RIGS: Mapping[str, tuple[Light, ...]] = {
    "portrait": tuple(LIGHTS[name] for name in ("key", "rim", "fill")),
    "softbox": (
        *(Light(azimuth, 20.0, **_BOX) for azimuth in (-45.0, 45.0)),
        Light(0.0, 0.0, 0.5, radius=20.0, shadow=False, follow=True),
    ),
}


def disc_of(light: Light, space: Space) -> tuple[float, float] | None:
    """Return sin R and (1 + cos R)/2, the parameters s and k of ``fr_slope_variance_disc``, where R
    is a light's largest angular radius, as seen from any point in the sphere around the mesh.
    Return None for a light without area. Raises the errors that drawing the light raises."""
    if light.kind.sine is None:
        return None
    nearest = np.zeros(3)
    if light.position is not None:
        nearest = space.normalised(light.position)
        nearest /= max(float(np.linalg.norm(nearest)), 1e-30) / space.reach
    sine = light.kind.sine(light, space, nearest)
    return float(sine[0]), float(half_sum(sine)[0])


@dataclass(frozen=True, eq=False)
class LightSpace:
    """Projection from the renderer's space to a shadow map, which covers the sphere around the mesh
    (:attr:`Space.reach`).

    matrix : (4, 4) float64, for row vectors; the result must be divided by w
    tan_radius : tangent of the light's angular radius, seen from the mesh's centre
    top : largest projected z of the sphere
    scale : sqrt(1 - 1/d^2) / reach of a point light d reaches away; 0 for a distant light
    """

    matrix: Float
    tan_radius: float
    top: float
    scale: float = 0.0


def light_space(light: Light, space: Space) -> LightSpace:
    """Return the shadow projection of a light."""
    tan_radius = math.tan(math.radians(light.radius))
    matrix, reach = np.eye(4), space.reach
    if light.position is None:
        matrix[:3, :3] = light_axes(light, space) / reach
        return LightSpace(matrix, tan_radius, 1.0)
    position = within_reach(f"point light {light.position}", space.normalised(light.position))
    distance = float(np.linalg.norm(position)) / reach
    if distance < NEAREST:
        start = f"point light {light.position} is too near to cast a shadow"
        remedy = f"give {NEAREST * reach:.4g} or more, or shadow=False (,no-shadow)"
        far = f"{distance * reach:.3g} mesh radii from the mesh's centre"
        raise InputError(f"{start}: it is {far}; {remedy}")
    axes = light_axes(light, space)
    scale = math.sqrt(1.0 - 1.0 / distance**2)
    matrix[:3, :3] = scale * distance * axes / reach
    matrix[:3, 3] = -axes[:, 2] / reach
    matrix[3, 3] = distance
    return LightSpace(matrix, tan_radius, scale * distance / (distance - 1.0), scale / reach)


def light_axes(light: Light, space: Space) -> Float:
    """Return an orthonormal basis for a light as columns (3, 3). The third column points from the
    mesh's centre to the light."""
    towards = light.direction if light.position is None else space.normalised(light.position)
    return _axes(*towards.tolist())


@lru_cache(maxsize=64)  # every frame needs the axes of the same lights
def _axes(*vector: float) -> Float:
    towards = np.array(vector) / np.linalg.norm(vector)
    across = np.cross(np.eye(3)[int(np.abs(towards).argmin())], towards)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(towards, across), towards], axis=1)
    axes.flags.writeable = False
    return axes
