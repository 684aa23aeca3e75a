"""Cameras, which orbit the mesh or stand where they are told. Angles are in degrees, lengths in the
mesh's units."""

from __future__ import annotations

from dataclasses import dataclass, replace

from facerender.errors import check_count, check_range, check_type
from facerender.scenes.vectors import Vector, vector


@dataclass(frozen=True)
class Camera:
    """A perspective camera, which orbits the mesh and frames it, or stands where it is told.

    Parameters
    ----------
    azimuth, elevation : degrees; 0, 0 looks at the face, azimuth 90 sees the side at +x
    fov : vertical angle of view, degrees in [1, 150]
    zoom : magnification relative to the framing that holds the whole mesh at every azimuth
    target : what the centre of the image shows; None for the centre of the mesh's bounds
    position : the eye; None for the orbit
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    fov: float = 25.0
    zoom: float = 1.0
    target: Vector | None = None
    position: Vector | None = None

    def __post_init__(self) -> None:
        ends = {"azimuth": (-3600, 3600), "elevation": (-90, 90), "fov": (1, 150)}
        for name, (low, high) in (ends | {"zoom": (0.01, 1000)}).items():
            check_range(f"camera {name}", getattr(self, name), low, high)
            object.__setattr__(self, name, float(getattr(self, name)))
        for name in ("target", "position"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, vector(f"camera {name}", value))


def turntable(camera: Camera = Camera(), count: int = 8) -> tuple[Camera, ...]:
    """Return cameras all around, beginning with this one, at its elevation.

    Raises
    ------
    InputError : no camera, a count that is no whole number in [1, 100000]
    """
    check_type("camera", camera, Camera, "a facerender.Camera")
    check_count("count", count, 100000)
    turns = (camera.azimuth + 360.0 * turn / count for turn in range(count))
    return tuple(replace(camera, azimuth=azimuth, position=None) for azimuth in turns)
