"""Building blocks of implicit surfaces, without anatomy: smooth unions, solids, bumps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

Floats = NDArray[np.float32]
Vector = tuple[float, float, float]

SMALLEST = 1e-6  # added to lengths before a division by them; far below the size of a grid cell


def smooth_minimum(a: Floats, b: Floats, radius: float) -> Floats:
    """Return the union of two distances, rounded where they differ by less than ``radius``."""
    share = np.clip(0.5 + 0.5 * (b - a) / radius, 0, 1)
    return np.asarray(b + (a - b) * share - radius * share * (1 - share), np.float32)


def smooth_maximum(a: Floats, b: Floats, radius: float) -> Floats:
    """Return the intersection of two distances, rounded like :func:`smooth_minimum`."""
    return -smooth_minimum(-a, -b, radius)


def ramp(start: float, end: float, value: Floats) -> Floats:
    """Return a cubic step from 0 at ``start`` to 1 at ``end``; ``start`` may be larger."""
    share = np.clip((value - start) / (end - start), 0, 1)
    return np.asarray(share * share * (3 - 2 * share), np.float32)


def bell(*offsets: NDArray[Any]) -> Floats:
    """Return the Gaussian of offsets in standard deviations; 1 where all offsets are 0."""
    total = np.zeros((), np.float32)
    for offset in offsets:
        total = total + offset * offset
    return np.asarray(np.exp(-0.5 * total), np.float32)


def curve(points: Sequence[tuple[float, float]]) -> Callable[[Floats], Floats]:
    """Return a smooth function through (place, value) pairs, constant beyond both ends."""
    places, values = np.array(sorted(points)).T
    fine = np.linspace(places[0], places[-1], 1024)
    smoothed = gaussian_filter1d(PchipInterpolator(places, values)(fine), 18, mode="nearest")
    return lambda at: np.interp(at, fine, smoothed).astype(np.float32)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with axes along x, y, z; its distance is exact on the surface only."""

    centre: Vector
    radii: Vector

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        offsets = [at - middle for at, middle in zip((x, y, z), self.centre, strict=True)]
        scaled = [o / r for o, r in zip(offsets, self.radii, strict=True)]
        slopes = [s / r for s, r in zip(scaled, self.radii, strict=True)]
        size = np.sqrt(sum(s * s for s in scaled)) + SMALLEST
        slope = np.sqrt(sum(s * s for s in slopes)) + SMALLEST
        return np.asarray(size * (size - 1) / slope, np.float32)


@dataclass(frozen=True)
class Capsule:
    """A capsule whose radius changes linearly from one end to the other."""

    start: Vector
    end: Vector
    start_radius: float
    end_radius: float

    def distance(self, x: Floats, y: Floats, z: Floats) -> Floats:
        axis = np.subtract(self.end, self.start).astype(np.float32)
        offsets = [at - begin for at, begin in zip((x, y, z), self.start, strict=True)]
        along = sum(o * a for o, a in zip(offsets, axis, strict=True)) / np.dot(axis, axis)
        along = np.clip(along, 0, 1)
        square = sum((o - a * along) ** 2 for o, a in zip(offsets, axis, strict=True))
        radius = self.start_radius + (self.end_radius - self.start_radius) * along
        return np.asarray(np.sqrt(square) - radius, np.float32)


@dataclass(frozen=True)
class Spot:
    """A soft round or oval spot in the front view, mirrored to both sides of the face."""

    side: float  # distance of its centre from the middle line, cm
    up: float  # height of its centre above the eye line, cm
    width: float  # standard deviation along its first axis, cm
    height: float  # standard deviation along its second axis, cm
    turn: float = 0.0  # upward rotation of its first axis from horizontal, degrees

    def weight(self, side: Floats, y: Floats) -> Floats:
        """Return the weight of the spot: 1 at its centre, decreasing to 0."""
        cosine, sine = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        across, up = side - self.side, y - self.up
        return bell(
            (cosine * across + sine * up) / self.width,
            (cosine * up - sine * across) / self.height,
        )
