"""Regions of the skin, as a weight from 0 to 1 per region and texel."""

from dataclasses import dataclass

import numpy as np

from . import landmarks
from .fields import Floats, Spot, bell, ramp
from .noise import Noise
from .shape import ear_distance, in_blocks, nostril_distance

CHEEK = Spot(4.1, -3.0, 1.7, 1.5, -20)
CHIN = Spot(0.0, -10.1, 1.6, 1.1)
UNDER_EYE = Spot(2.9, -1.0, 1.1, 0.45, -15)
NOSE = Spot(0.0, -3.6, 1.25, 1.1)
NOSE_BRIDGE = Spot(0.0, -1.2, 0.8, 1.8)
NOSE_WINGS = Spot(1.45, -4.1, 0.45, 0.60)
PHILTRUM = Spot(0.0, -5.5, 0.28, 0.5)
BARE_CHEEK = Spot(2.2, -5.3, 0.8, 0.9)  # area next to the nose with little beard

NOSTRIL_FADE = (0.14, -0.02)  # distances from a nostril's hollow: weight 0, weight 1, cm
EAR_FADE = (0.36, 0.08)  # distances from the ear's surface: weight 0, weight 1, cm
SCALP_EDGE = (-0.70, 1.30)  # heights above the hairline: no hair, full hair, cm
HAIRLINE_WANDER = 0.28  # amplitude of random variations of the hairline, cm


@dataclass(frozen=True)
class Regions:
    """The weights of the skin regions at points (N, 3)."""

    upper_lip: Floats
    lower_lip: Floats
    mouth_seam: Floats
    eyelid: Floats
    under_eye: Floats
    cheek: Floats
    chin: Floats
    forehead: Floats
    nose: Floats
    nose_bridge: Floats
    nose_wings: Floats
    nostril: Floats
    ear: Floats
    neck: Floats
    temple: Floats
    beard: Floats
    scalp: Floats

    @property
    def lips(self) -> Floats:
        return self.upper_lip + self.lower_lip

    @property
    def plain_skin(self) -> Floats:
        """Weight of skin with pores: 0 on the lips, small on the lids."""
        return np.asarray((1 - self.lips) * (1 - 0.65 * self.eyelid), np.float32)


def _lips(side: Floats, y: Floats) -> tuple[Floats, Floats]:
    line = landmarks.mouth_line(side)
    upper = np.maximum(landmarks.upper_lip_border(side) - line, 0.05)
    lower = np.maximum(line - landmarks.lower_lip_border(side), 0.05)
    inside = ramp(landmarks.MOUTH_HALF_WIDTH + 0.05, landmarks.MOUTH_HALF_WIDTH - 0.35, side)
    in_upper, in_lower = (y - line) / upper, (line - y) / lower
    in_upper_lip = ramp(0.0, 0.02, in_upper) * ramp(1.16, 0.84, in_upper) * inside
    in_lower_lip = ramp(-0.02, 0.0, in_lower) * ramp(1.14, 0.84, in_lower) * inside
    return in_upper_lip, in_lower_lip * (1 - in_upper_lip)


def _beard(points: Floats, side: Floats, noise: Noise) -> Floats:
    y, z = points[:, 1], points[:, 2]
    edge = y + 0.25 * np.clip(side - 3, 0, 9) + 0.3 * noise(points, 0.9, 5, layers=2)
    beard = ramp(-4.2, -5.8, edge) * ramp(-13.5, -11.0, y) * ramp(-1.2, 2.0, z)
    beard = beard * (1 - 0.75 * BARE_CHEEK.weight(side, y))
    return np.asarray(beard * (1 - 0.6 * PHILTRUM.weight(side, y)), np.float32)


def find_regions(points: Floats, noise: Noise) -> Regions:
    """Return the weights of all regions at points (N, 3), in cm."""
    x, y, z = points.T
    side = np.abs(x)
    in_front = ramp(2, 5, z)
    upper_lip, lower_lip = (lip * ramp(7, 8, z) for lip in _lips(side, y))
    eye = landmarks.EYE_CENTRE
    eyelid = bell((np.hypot((side - eye[0]) / 1.75, y / 0.95)) ** 1.5)
    ear = ramp(*EAR_FADE, in_blocks(ear_distance, points))
    over_hairline = landmarks.hairline(points) + HAIRLINE_WANDER * noise(points, 0.8, 9, layers=4)
    beard = _beard(points, side, noise)
    return Regions(
        upper_lip=upper_lip,
        lower_lip=lower_lip,
        mouth_seam=bell((y - landmarks.mouth_line(side)) / 0.07)
        * landmarks.mouth_presence(side)
        * ramp(7, 8, z),
        eyelid=eyelid * in_front,
        under_eye=UNDER_EYE.weight(side, y) * in_front,
        cheek=CHEEK.weight(side, y) * in_front,
        chin=CHIN.weight(side, y) * in_front,
        forehead=ramp(2.2, 4.2, y) * in_front,
        nose=NOSE.weight(side, y) * in_front,
        nose_bridge=NOSE_BRIDGE.weight(side, y) * in_front,
        nose_wings=NOSE_WINGS.weight(side, y) * ramp(8, 8.8, z),
        nostril=ramp(*NOSTRIL_FADE, in_blocks(nostril_distance, points)),
        ear=ear,
        neck=ramp(-9, -13, y),
        temple=ramp(5.5, 6.8, side) * ramp(0, 3, y),
        beard=beard * np.clip(1 - upper_lip - lower_lip, 0, 1),
        scalp=ramp(*SCALP_EDGE, over_hairline) * (1 - ear),
    )
