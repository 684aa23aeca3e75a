"""The eyes: eyeballs with a recessed iris, and corneas.

Lengths are in cm, relative to the centre of the eyeball. The axis of each eye points along +z. An
angle from this axis is called polar.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import landmarks
from .fields import Floats, smooth_maximum
from .shape import placed, unit
from .surface import Faces, Mesh

SCLERA_RADIUS = 1.175
CORNEA_RADIUS = 0.78  # radius of curvature
LIMBUS_RADIUS = 0.585  # half the diameter of the cornea
LIMBUS_ROUNDING = 0.025  # height difference within which cornea and sclera blend
IRIS_DEPTH = 0.36  # from the apex of the cornea to the plane of the iris
IRIS_RADIUS = 0.60
PUPIL_RADIUS = 0.175
PUPIL_DEPTH = 0.08  # the pupil is a cup behind the plane of the iris

LIMBUS_HEIGHT = float(np.sqrt(SCLERA_RADIUS**2 - LIMBUS_RADIUS**2))
CORNEA_CENTRE = LIMBUS_HEIGHT - float(np.sqrt(CORNEA_RADIUS**2 - LIMBUS_RADIUS**2))
APEX = CORNEA_CENTRE + CORNEA_RADIUS
IRIS_HEIGHT = APEX - IRIS_DEPTH
LIMBUS_POLAR = float(np.arctan2(LIMBUS_RADIUS, LIMBUS_HEIGHT))
FORWARD = 0.147  # z of the centre of the open eye, relative to the closed eye's, cm

SEGMENTS = 48  # of each circle; cornea and sclera need the same number to stay apart
# Distances of the cornea's rings from the axis. The last ring lies below the sclera.
CORNEA_RINGS = (0.0, 0.09, 0.19, 0.29, 0.39, 0.48, 0.54, 0.58, 0.62, 0.66, 0.685)
CORNEA_LIFT, CORNEA_END = 0.002, -0.006  # offset of the cornea from the eye's surface; at its end
SCLERA_RINGS = (33, 38, 44, 50, 56, 62, 68, 75, 84, 100)  # polar angles, degrees

# The chart of an eye is a disc: fraction of its radius at which each region ends.
CHART_PUPIL, CHART_IRIS, CHART_LIMBUS = 0.16, 0.52, 0.56
CHART_POLAR = float(np.radians(100))  # largest polar angle with texels of its own
CHART_RADIUS = 0.49  # as a fraction of the width of its square half of the texture

# A profile: distance from the axis, height, and radius in the chart (rows).
Profile = Sequence[tuple[float, float, float]]


@dataclass(frozen=True)
class Eye:
    """The place of an eye: its centre in cm, and 1 for the left eye, -1 for the right eye."""

    centre: Floats
    mirror: int

    def local(self, points: Floats) -> Floats:
        """Return points (N, 3) relative to the eye, with x away from the nose."""
        return np.asarray((points - self.centre) * (self.mirror, 1, 1), np.float32)

    def world(self, points: Floats) -> Floats:
        """Return the inverse of :meth:`local`."""
        return np.asarray(points * (self.mirror, 1, 1) + self.centre, np.float32)


@dataclass(frozen=True)
class Textured:
    """A mesh with texture coordinates, or without them; v points up."""

    mesh: Mesh
    coordinates: Floats | None = None


def both_eyes() -> tuple[Eye, Eye]:
    """Return the left eye and the right eye."""
    side, up, ahead = landmarks.EYE_CENTRE
    centres = placed(np.array([[s * side, up, ahead + FORWARD] for s in (1, -1)], np.float32))
    return Eye(centres[0], 1), Eye(centres[1], -1)


def ring_faces(rings: int, count: int) -> Faces:
    """Return triangles between rings of ``count`` vertices, each ring following the one before.

    They face forward if rings run counter-clockwise and grow.
    """
    column = np.arange(count)
    following = (column + 1) % count
    inner = np.arange(rings - 1)[:, None] * count
    outer = inner + count
    first = np.stack([inner + column, outer + column, outer + following], -1)
    second = np.stack([inner + column, outer + following, inner + following], -1)
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)]).astype(np.int32)


def joined(pieces: Sequence[Textured]) -> Textured:
    """Return the union of meshes, all with texture coordinates or all without."""
    starts = np.cumsum([0] + [len(piece.mesh.positions) for piece in pieces])
    mesh = Mesh(
        np.concatenate([piece.mesh.positions for piece in pieces]),
        np.concatenate([piece.mesh.normals for piece in pieces]),
        np.concatenate(
            [piece.mesh.faces + start for piece, start in zip(pieces, starts, strict=False)]
        ).astype(np.int32),
    )
    coordinates = [piece.coordinates for piece in pieces if piece.coordinates is not None]
    return Textured(mesh, np.concatenate(coordinates) if coordinates else None)


def front_height(radius: Floats, offset: float = 0.0, rounding: float = LIMBUS_ROUNDING) -> Floats:
    """Return the height of the surface ``offset`` outside the eye, at a distance from the axis."""
    sclera_size, cornea_size = SCLERA_RADIUS + offset, CORNEA_RADIUS + offset
    sclera = np.sqrt(np.maximum(sclera_size**2 - radius * radius, 0))
    cap = np.sqrt(np.maximum(cornea_size**2 - radius * radius, 0))
    cornea = np.where(radius < cornea_size, CORNEA_CENTRE + cap, 0)
    return smooth_maximum(sclera, cornea, rounding)


_table_radius = np.linspace(0, 0.9, 400, dtype=np.float32)
_table_height = front_height(_table_radius)
_table_polar = np.arctan2(_table_radius, _table_height)
_table_size = np.hypot(_table_radius, _table_height)


def eye_size(polar: Floats) -> Floats:
    """Return the distance from the centre of the eyeball to its surface, with the cornea."""
    return np.interp(polar, _table_polar, _table_size).astype(np.float32)


def eye_distance(local: Floats) -> Floats:
    """Return the approximate distance of points (N, 3) to the surface of the eye."""
    polar = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
    return np.asarray(np.linalg.norm(local, axis=1) - eye_size(polar), np.float32)


def chart_radius(polar: Floats) -> Floats:
    """Return the radius in the chart of a point of the sclera; 1 at the border of the chart."""
    share = (polar - LIMBUS_POLAR) / (CHART_POLAR - LIMBUS_POLAR)
    return np.asarray(CHART_LIMBUS + (1 - CHART_LIMBUS) * np.clip(share, 0, 1), np.float32)


def _revolved(profile: Profile, close: bool) -> Textured:
    """Return a surface around the axis, with chart coordinates from -1 to 1.

    The profile runs away from the axis on the front. ``close`` fills the disc within its first row.
    """
    outward, height, chart = np.array(profile, np.float32).T
    angle = np.arange(SEGMENTS) * (2 * np.pi / SEGMENTS)

    def around(radius: Floats, along: Floats) -> Floats:
        rows = (np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)))
        level = np.outer(along, np.ones(SEGMENTS))
        return np.stack([*rows, level], -1).reshape(-1, 3).astype(np.float32)

    positions = around(outward, height)
    normals = unit(around(-np.gradient(height), np.gradient(outward)))
    coordinates = around(chart, chart)[:, :2]
    faces = ring_faces(len(outward), SEGMENTS)
    if close:
        column = np.arange(SEGMENTS)
        following = (column + 1) % SEGMENTS
        fan = np.stack([np.full(SEGMENTS, len(positions)), column, following], 1)
        positions = np.concatenate([positions, np.array([[0, 0, height[0]]], np.float32)])
        normals = np.concatenate([normals, np.array([[0, 0, 1]], np.float32)])
        coordinates = np.concatenate([coordinates, np.zeros((1, 2), np.float32)])
        faces = np.concatenate([faces, fan.astype(np.int32)])
    return Textured(Mesh(positions, normals, faces), coordinates)


def _eyeball() -> Textured:
    """Return an eyeball in chart coordinates from -1 to 1: sclera and wall, iris, pupil."""
    wall = [
        (IRIS_RADIUS, IRIS_HEIGHT, CHART_IRIS),
        (LIMBUS_RADIUS + 0.004, LIMBUS_HEIGHT - 0.04, 0.5 * (CHART_IRIS + CHART_LIMBUS)),
        (LIMBUS_RADIUS, LIMBUS_HEIGHT, CHART_LIMBUS),
    ]
    sclera = [
        (
            float(SCLERA_RADIUS * np.sin(polar)),
            float(SCLERA_RADIUS * np.cos(polar)),
            float(chart_radius(polar)),
        )
        for polar in np.radians(SCLERA_RINGS)
    ]
    iris = [
        (PUPIL_RADIUS, IRIS_HEIGHT, CHART_PUPIL),
        (IRIS_RADIUS, IRIS_HEIGHT, CHART_IRIS),
    ]
    floor = IRIS_HEIGHT - PUPIL_DEPTH
    pupil = [(PUPIL_RADIUS, floor, 0.8 * CHART_PUPIL), (PUPIL_RADIUS, IRIS_HEIGHT, CHART_PUPIL)]
    return joined(
        [
            _revolved([*wall, *sclera], close=False),
            _revolved(iris, close=False),
            _revolved(pupil, close=True),
        ]
    )


def eyeballs(eyes: Sequence[Eye]) -> Textured:
    """Return both eyeballs. The left eye's chart is the left half of a texture of aspect 2:1."""
    ball = _eyeball()
    found = []
    for eye in eyes:
        mesh = Mesh(ball.mesh.positions + eye.centre, ball.mesh.normals, ball.mesh.faces)
        middle = (0.25 if eye.mirror > 0 else 0.75, 0.5)
        chart = middle + np.asarray(ball.coordinates) * (0.5 * CHART_RADIUS, CHART_RADIUS)
        found.append(Textured(mesh, np.asarray(chart, np.float32)))
    return joined(found)


def corneas(eyes: Sequence[Eye]) -> Textured:
    """Return both corneas, which end below the surface of the sclera."""
    radii = np.array(CORNEA_RINGS, np.float32)
    lift = np.full(len(radii), CORNEA_LIFT)
    lift[-1] = CORNEA_END
    heights = front_height(radii) + lift
    profile = [(r, z, r) for r, z in zip(radii.tolist(), heights.tolist(), strict=True)]
    shape = _revolved(profile[1:], close=True).mesh
    shape.positions[-1, 2] = heights[0]
    return joined(
        [Textured(Mesh(shape.positions + eye.centre, shape.normals, shape.faces)) for eye in eyes]
    )
