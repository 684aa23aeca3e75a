"""Single hairs of brows and lashes, drawn in the front view. ``texture`` adds scalp and beard."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates

from . import landmarks
from .fields import Floats

CANVAS = (-7.5, 7.5, -9.0, 5.0)  # left, right, bottom, top of the drawing, cm
PIXELS_PER_CM = 160

BROW_HAIRS = 900  # per side
LASH_HAIRS = 150  # per side
STEPS = np.linspace(0, 1, 6)  # points along each hair

Hair = tuple[Floats, float, float]  # points (N, 2) in cm, width in cm, opacity


def _draw(hairs: Iterator[Hair], blur: float) -> Floats:
    left, right, bottom, top = CANVAS
    size = (int((right - left) * PIXELS_PER_CM), int((top - bottom) * PIXELS_PER_CM))
    canvas = Image.new("L", size, 0)
    pen = ImageDraw.Draw(canvas)
    for points, width, opacity in hairs:
        pixels = (points - (left, top)) * (PIXELS_PER_CM, -PIXELS_PER_CM)
        pen.line(
            [tuple(pixel) for pixel in pixels],
            fill=int(255 * opacity),
            width=max(1, round(width * PIXELS_PER_CM)),
        )
    drawn = np.asarray(canvas, np.float32) / 255
    return np.asarray(gaussian_filter(drawn, blur * PIXELS_PER_CM), np.float32)


def _look_up(drawing: Floats, points: Floats) -> Floats:
    rows = (CANVAS[3] - points[:, 1]) * PIXELS_PER_CM
    columns = (points[:, 0] - CANVAS[0]) * PIXELS_PER_CM
    return np.asarray(map_coordinates(drawing, [rows, columns], order=1, mode="constant"))


def _brow_hairs(random: np.random.Generator) -> Iterator[Hair]:
    """Yield brow hairs: upright at the inner end, flat along the arch, turned down at the tail."""
    for mirror in (-1, 1):
        along = random.random(BROW_HAIRS) ** 0.85
        middle_side = 1.10 + 4.15 * along
        arch = 0.58 * np.sin(np.clip(1.15 * along, 0, 1) * np.pi * 0.62)
        tail = 0.95 * np.clip(along - 0.60, 0, 1) ** 1.2
        half_height = 0.40 * (1 - along**2.2) + 0.08
        offset = random.normal(0, 0.45, BROW_HAIRS) * half_height
        start_up = 1.24 + arch - tail + offset
        direction = (78 - 96 * np.clip(1.05 * along, 0, 1) ** 0.55 - 76 * offset) + random.normal(
            0, 10, BROW_HAIRS
        )
        direction = np.radians(direction)
        length = 0.26 + 0.34 * np.sin(np.pi * np.clip(along + 0.12, 0, 1))
        length *= random.uniform(0.7, 1.2, BROW_HAIRS)
        width = random.uniform(0.009, 0.020, BROW_HAIRS)
        # Reduce the opacity at the inner end, where a brow begins softly.
        opacity = random.uniform(0.40, 1.0, BROW_HAIRS) * np.clip(0.45 + 4.0 * along, 0, 1)
        for i in range(BROW_HAIRS):
            turned = direction[i] - 0.35 * STEPS
            side = middle_side[i] + np.cos(turned) * length[i] * STEPS
            up = start_up[i] + np.sin(turned) * length[i] * STEPS
            yield np.stack([mirror * side, up], 1), float(width[i]), float(opacity[i])


def _lash_hairs(random: np.random.Generator) -> Iterator[Hair]:
    """Yield the dark line of the lash roots, thin at the inner corner, and the curved lashes."""
    inner, outer = landmarks.INNER_CORNER + 0.12, landmarks.OUTER_CORNER - 0.02
    for mirror in (-1, 1):
        ends = np.linspace(inner, outer, 40)
        for start, end in pairwise(ends):
            share = (start - inner) / (outer - inner)
            side = np.array([start, end])
            line = np.stack([mirror * side, landmarks.lid_line(side) - 0.015], 1)
            yield line, 0.016 + 0.026 * np.sin(np.pi * share**0.7), 0.35 + 0.45 * share**0.5
        roots = np.sort(random.uniform(inner + 0.15, outer + 0.02, LASH_HAIRS))
        for root in roots:
            share = (root - inner) / (outer - inner)
            length = random.uniform(0.26, 0.42) * (0.55 + 0.65 * share)
            direction = np.radians(-112 + 76 * share + random.normal(0, 8))
            lift = random.uniform(0.06, 0.14)
            side = root + np.cos(direction) * length * STEPS
            up = landmarks.lid_line(root) - 0.02 + np.sin(direction) * length * STEPS
            points = np.stack([mirror * side, up + lift * STEPS**2], 1)
            # Draw the root half again, thicker and more opaque.
            yield points, 0.007, 0.60
            yield points[:3], 0.013, 0.80


def brow_cover(points: Floats, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the coverage of points (N, 3) by brow hairs: sharp hairs, and their soft shadow."""
    drawing = _draw(_brow_hairs(random), 0.0045)
    shade = gaussian_filter(drawing, 0.10 * PIXELS_PER_CM)
    return _look_up(drawing, points), _look_up(shade, points)


def lash_cover(points: Floats, random: np.random.Generator) -> Floats:
    """Return the coverage of points (N, 3) by lashes."""
    return _look_up(_draw(_lash_hairs(random), 0.004), points)
