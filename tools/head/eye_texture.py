"""The maps of the eyeballs: albedo, and occlusion with roughness.

Both eyes lie side by side in a texture of aspect 2:1, the left eye at the left. Colours are linear
until the output.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from .eyes import (
    CHART_IRIS,
    CHART_LIMBUS,
    CHART_POLAR,
    CHART_PUPIL,
    CHART_RADIUS,
    LIMBUS_POLAR,
    Eye,
    eye_size,
)
from .fields import Floats, bell, ramp
from .lids import edge_heights
from .noise import Noise
from .texture import Colour, absorb, cover, encoded, linear

SCLERA: Colour = (220, 209, 201)
CORNER: Colour = (196, 142, 130)
CORNER_STRENGTH = 0.55
VESSEL: Colour = (176, 92, 80)
SCLERA_EDGE: Colour = (92, 91, 88)  # where the sclera overlaps the iris
RIM: Colour = (40, 38, 36)  # limbal ring
IRIS_OUTER: Colour = (98, 104, 96)
IRIS_MIDDLE: Colour = (126, 118, 88)
IRIS_INNER: Colour = (128, 92, 52)
RUFF: Colour = (52, 38, 28)  # dark edge of the pupil
PUPIL: Colour = (4, 4, 4)

COLLARETTE = 0.33  # place between pupil (0) and root of the iris (1)
FIBRES = 420
VESSELS = 46
FIBRE_ANGLES = 2048  # samples around the iris

# Roughness m, the RMS slope of the microfacets; the cornea's highlight covers the iris.
IRIS_SLOPE, SCLERA_SLOPE = 0.40, 0.14

LID_SHADE = 0.22  # distance from the lids' edges at which their occlusion fades out, cm
LID_OCCLUSION = (0.55, 0.25)  # by the upper lid, by the lower lid
LID_STAIN = 0.30  # fraction of the occlusion that also darkens the albedo


@dataclass(frozen=True)
class EyeMaps:
    """The textures of both eyes, row 0 at the top."""

    albedo: Image.Image
    occlusion_roughness: Image.Image  # red: occlusion, green: square root of m


def _fibres(around: Floats, place: Floats, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the brightness of fibres, mean 0, and the wavy place of the collarette."""
    layers = []
    for blur in (1.5, 3.0, 7.0):
        layer = gaussian_filter1d(random.standard_normal((40, FIBRE_ANGLES)), blur, 1, mode="wrap")
        layer = gaussian_filter1d(layer, 9.0, 0, mode="nearest")
        layers.append(layer / layer.std())
    pattern = 0.5 * layers[0] + 0.7 * layers[1] + 0.5 * layers[2]
    wave = gaussian_filter1d(random.standard_normal(FIBRE_ANGLES), 40, mode="wrap")
    wave = COLLARETTE + 0.035 * wave / wave.std()
    column = (around / (2 * np.pi) % 1 * FIBRE_ANGLES).astype(int) % FIBRE_ANGLES
    row = np.clip(place * 39, 0, 38.999)
    whole = row.astype(int)
    part = row - whole
    found = pattern[whole, column] * (1 - part) + pattern[whole + 1, column] * part
    return np.asarray(found, np.float32), np.asarray(wave[column], np.float32)


def _iris(around: Floats, place: Floats, random: np.random.Generator) -> Floats:
    """Return the colour of the iris; ``place`` is 0 at the pupil and 1 at the root."""
    fibre, collarette = _fibres(around, place, random)
    outer = ramp(0.45, 0.95, place)[:, None]
    colour = linear(IRIS_MIDDLE) * (1 - outer) + linear(IRIS_OUTER) * outer
    inner = ramp(0.06, -0.05, place - collarette) + 0.0
    colour = cover(np.asarray(colour, np.float32), 0.75 * inner, IRIS_INNER)
    contrast = 0.20 + 0.22 * bell((place - 0.5) / 0.28)
    colour = colour * np.exp(contrast * fibre)[:, None]
    ridge = bell((place - collarette) / 0.035)
    colour = colour * (1 + 0.40 * ridge)[:, None]
    # Furrows of the outer iris.
    for furrow, depth in ((0.60, 0.14), (0.76, 0.18)):
        bent: NDArray[Any] = place - furrow - 0.03 * np.sin(3 * around + 9 * furrow) - 0.01 * fibre
        colour = colour * (1 - depth * bell(bent / 0.02))[:, None]
    colour = cover(np.asarray(colour, np.float32), 0.85 * ramp(0.66, 0.94, place), RIM)
    return cover(colour, 0.9 * ramp(0.075, 0.0, place), RUFF)


def _vessels(size: int, random: np.random.Generator) -> Floats:
    """Return the coverage of an eye's chart by vessels, which run from the border inward."""
    scale = 2
    canvas = Image.new("L", (size * scale, size * scale), 0)
    pen = ImageDraw.Draw(canvas)
    for _ in range(VESSELS):
        # Most vessels come from the corners.
        around = random.choice((0.0, np.pi)) + random.normal(0, 0.55)
        reach = random.uniform(CHART_LIMBUS + 0.10, 0.88)
        steps = 28
        radius = np.linspace(1.02, reach, steps)
        wander = np.cumsum(random.normal(0, 0.022, steps)) + 0.05 * np.sin(
            np.arange(steps) * random.uniform(0.3, 0.7) + random.uniform(0, 6)
        )
        angle = around + wander / radius
        x = (0.5 + CHART_RADIUS * radius * np.cos(angle)) * size * scale
        y = (0.5 - CHART_RADIUS * radius * np.sin(angle)) * size * scale
        strength = int(random.uniform(60, 170))
        width = max(1, round(size * scale * random.uniform(0.0015, 0.0045)))
        pen.line(list(zip(x.tolist(), y.tolist(), strict=True)), fill=strength, width=width)
    drawn = np.asarray(canvas.resize((size, size), Image.Resampling.BOX), np.float32) / 255
    return np.asarray(gaussian_filter(drawn, size * 0.0016), np.float32)


def _lid_occlusion(eye: Eye, x: Floats, y: Floats) -> Floats:
    """Return the fraction of light that the lids block, at places of the front view."""
    lower, upper = edge_heights(eye, x)
    above = np.clip((upper - y) / LID_SHADE, 0, None)
    below = np.clip((y - lower) / LID_SHADE, 0, None)
    blocked = LID_OCCLUSION[0] * np.exp(-1.4 * above) + LID_OCCLUSION[1] * np.exp(-1.8 * below)
    return np.asarray(np.clip(blocked, 0, 0.85), np.float32)


def _paint_eye(eye: Eye, size: int, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return linear albedo, occlusion and roughness m of an eye's chart, row 0 at the top."""
    random = np.random.default_rng(seed)
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    right = (column.ravel() / size - 0.5) / CHART_RADIUS
    up = (0.5 - row.ravel() / size) / CHART_RADIUS
    chart, around = np.hypot(right, up), np.arctan2(up, right)
    share = (chart - CHART_LIMBUS) / (1 - CHART_LIMBUS)
    polar = LIMBUS_POLAR * np.minimum(chart / CHART_LIMBUS, 1)
    polar = polar + (CHART_POLAR - LIMBUS_POLAR) * np.clip(share, 0, 1)
    outward = eye_size(polar) * np.sin(polar)
    x, y = outward * np.cos(around) * eye.mirror, outward * np.sin(around)

    noise = Noise(seed)
    points = np.stack([x, y, np.cos(polar)], 1).astype(np.float32)
    colour = np.tile(linear(SCLERA), (len(chart), 1)).astype(np.float32)
    colour = absorb(colour, 0.04 * noise(points, 2.5, 3, layers=3), (0.3, 1.0, 1.0))
    corner = ramp(0.62, 1.10, np.abs(x)) + 0.6 * ramp(0.92, 1.12, np.abs(x))
    colour = cover(colour, np.clip(CORNER_STRENGTH * corner, 0, 1), CORNER)
    vessels = _vessels(size, random).ravel()
    colour = cover(colour, 0.8 * vessels * ramp(0.05, 0.30, share), VESSEL)
    colour = cover(colour, 0.85 * ramp(0.13, -0.02, share) ** 1.2, SCLERA_EDGE)

    place = np.asarray((chart - CHART_PUPIL) / (CHART_IRIS - CHART_PUPIL), np.float32)
    iris = _iris(around, np.clip(place, 0, 1), random)
    wall = ramp(CHART_LIMBUS, CHART_IRIS, chart)[:, None]
    colour = colour * (1 - wall) + iris * wall
    colour = cover(np.asarray(colour, np.float32), ramp(0.015, -0.015, place), PUPIL)

    blocked = _lid_occlusion(eye, x, y)
    colour = colour * (1 - LID_STAIN * blocked)[:, None]
    slope = IRIS_SLOPE + (SCLERA_SLOPE - IRIS_SLOPE) * ramp(CHART_IRIS, CHART_LIMBUS, chart)
    square = (size, size)
    return (
        colour.reshape(*square, 3),
        (1 - blocked).reshape(square),
        np.asarray(slope, np.float32).reshape(square),
    )


def paint_eyes(eyes: Sequence[Eye], size: int, seed: int) -> EyeMaps:
    """Compute the maps of both eyes; ``size`` is the width of one eye's chart in texels."""
    painted = [_paint_eye(eye, size, seed + index) for index, eye in enumerate(eyes)]
    colour, open_share, slope = (
        np.concatenate([each[i] for each in painted], axis=1) for i in range(3)
    )
    numbers = np.stack([open_share, np.sqrt(slope), np.zeros_like(slope)], -1)
    albedo, combined = (
        Image.fromarray(np.clip(255 * values + 0.5, 0, 255).astype(np.uint8))
        for values in (encoded(colour), numbers)
    )
    return EyeMaps(albedo, combined.resize((size, size // 2), Image.Resampling.BOX))
