"""Geometry on the lids: lashes, and the tear line along the lower lids.

Lengths are in cm; x, y, z are relative to the centre of the eyeball, with x away from the nose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from .eyes import Textured, eye_size, joined, ring_faces
from .fields import Floats, ramp
from .lids import Opening
from .shape import unit
from .surface import Faces, Mesh, vertex_normals


@dataclass(frozen=True)
class Row:
    """The lashes of a lid. Directions and lengths are (inner end, middle, outer end)."""

    upper: bool
    count: int
    range: tuple[float, float]  # first and last place along the lid, from inner to outer corner
    length: tuple[float, float, float]
    outward: tuple[float, float, float]  # sideways component of the tips' direction
    start: tuple[float, float]  # (up, forward) components of the direction at the root
    end: tuple[float, float]  # and from the root to the tip
    radius: float


UPPER = Row(
    upper=True,
    count=60,
    range=(0.13, 0.985),
    length=(0.38, 0.76, 0.84),
    outward=(-0.25, 0.10, 0.80),
    start=(-0.20, 0.95),
    end=(0.60, 0.74),
    radius=0.0066,
)
LOWER = Row(
    upper=False,
    count=32,
    range=(0.22, 0.97),
    length=(0.24, 0.38, 0.44),
    outward=(-0.30, 0.12, 0.75),
    start=(-0.30, 0.85),
    end=(-0.62, 0.72),
    radius=0.0050,
)
SECTIONS = (0.0, 0.25, 0.5, 0.75)  # places of the triangular sections along a lash, before its tip
STRAND_VERTICES = 3 * len(SECTIONS) + 1
CLUMP = 4  # neighbouring lashes whose tips lean together
ROOT_DEPTH = 0.012  # of the roots below the skin

TEAR_RANGE = (0.10, 0.97)  # along the lower lid
TEAR_HEIGHT = 0.030  # on the lid and on the eyeball
TEAR_LIFT = 0.003  # above lid and eyeball
THINNEST_TEAR = 0.002  # at its ends


def _strand(root: Floats, through: Floats, tip: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return vertices and normals of a tapered lash along a quadratic curve: sections, then tip."""
    t = np.array(SECTIONS, np.float32)[:, None]
    centre = (1 - t) ** 2 * root + 2 * t * (1 - t) * through + t * t * tip
    along = unit((1 - t) * (through - root) + t * (tip - through))
    side = unit(np.cross(along, np.array([0, 1, 0], np.float32)))
    up = np.cross(side, along)
    angle = np.pi / 2 + 2 * np.pi / 3 * np.arange(3)[:, None, None]
    normals = np.moveaxis(np.cos(angle) * side + np.sin(angle) * up, 0, 1)
    positions = centre[:, None] + radius * (1 - t[:, None]) ** 0.7 * normals
    return (
        np.concatenate([positions.reshape(-1, 3), [tip]]).astype(np.float32),
        np.concatenate([normals.reshape(-1, 3), unit(tip - through)[None]]).astype(np.float32),
    )


def _strand_faces() -> Faces:
    tip = 3 * len(SECTIONS)
    column = np.arange(3)
    fan = np.stack([tip - 3 + column, tip - 3 + (column + 1) % 3, np.full(3, tip)], 1)
    sides = ring_faces(len(SECTIONS), 3)[:, ::-1]
    return np.concatenate([sides, fan]).astype(np.int32)


def _lashes(opening: Opening, row: Row, random: np.random.Generator) -> list[Textured]:
    ring = opening.rings[opening.edge + 2]  # the middle of the rounded edge
    line = ring[opening.upper if row.upper else opening.lower]
    at = CubicSpline(np.linspace(0, 1, len(line)), line)
    places = np.linspace(*row.range, row.count)
    places = places + random.uniform(-0.4, 0.4, row.count) * (places[1] - places[0])
    leans = random.normal(0, 0.10, row.count // CLUMP + 1)
    faces = _strand_faces()
    faces = faces if opening.eye.mirror > 0 else faces[:, ::-1]
    strands = []
    for i, place in enumerate(places):
        across = np.interp(place, (0, 0.5, 1), row.outward)
        length = np.interp(place, (0, 0.45, 1), row.length) * random.uniform(0.72, 1.06)
        lean = leans[i // CLUMP] + 0.04 * (CLUMP / 2 - 0.5 - i % CLUMP) + random.normal(0, 0.03)
        lift = random.normal(0, 0.05)
        start = unit(np.array([0.55 * across, row.start[0] + lift, row.start[1]]))
        end = unit(np.array([across + lean, row.end[0] + lift, row.end[1]]))
        root = at(place) - (0, 0, ROOT_DEPTH)
        radius = row.radius * random.uniform(0.8, 1.1)
        positions, normals = _strand(
            root, root + 0.48 * length * start, root + length * end, radius
        )
        turned = np.asarray(normals * (opening.eye.mirror, 1, 1), np.float32)
        strands.append(Textured(Mesh(opening.eye.world(positions), turned, faces)))
    return strands


def lashes(openings: Sequence[Opening], seed: int) -> Textured:
    """Return the lashes of both eyes."""
    random = np.random.default_rng(seed)
    found = []
    for opening in openings:
        found += _lashes(opening, UPPER, random) + _lashes(opening, LOWER, random)
    return joined(found)


def _tear_line(opening: Opening) -> Textured:
    """Return a strip between margin and eyeball: on the lid, in the corner, on the eyeball."""
    rings, lower = opening.rings, opening.lower
    along = np.linspace(0, 1, len(lower), dtype=np.float32)
    inside = (along > TEAR_RANGE[0]) & (along < TEAR_RANGE[1])
    lower, along = lower[inside], along[inside]
    touch, lid = rings[opening.margin][lower], rings[opening.margin - 1][lower]
    size = TEAR_HEIGHT * ramp(TEAR_RANGE[0], 0.2, along) * ramp(TEAR_RANGE[1], 0.88, along)
    size = np.maximum(size, THINNEST_TEAR)[:, None]
    on_lid = touch + size * unit(lid - touch)
    radius = np.linalg.norm(touch[:, :2], axis=1, keepdims=True)
    polar = np.arctan2(radius, touch[:, 2:]) - size / np.linalg.norm(touch, axis=1, keepdims=True)
    eye = eye_size(polar) + TEAR_LIFT
    on_eye = np.concatenate([touch[:, :2] / radius * eye * np.sin(polar), eye * np.cos(polar)], 1)
    toward = TEAR_LIFT * unit(on_lid + on_eye - 2 * touch)
    corner = 0.35 * touch + 0.325 * (on_lid + on_eye) + toward
    strip = np.concatenate([on_lid + toward, corner, on_eye]).astype(np.float32)
    positions = opening.eye.world(strip)

    count = len(lower)
    faces = ring_faces(3, count)
    faces = faces[np.ptp(faces % count, axis=1) < 2]  # a strip, not a ring
    faces = faces if opening.eye.mirror < 0 else faces[:, ::-1]
    return Textured(Mesh(positions, vertex_normals(positions, faces), faces))


def tear_lines(openings: Sequence[Opening]) -> Textured:
    """Return the tear lines of both eyes."""
    return joined([_tear_line(opening) for opening in openings])
