"""Lines of the face that both shape and paint follow.  No solids, no colours.

All lines are seen from the front: ``side`` is the distance from the middle line, the result the
height above the eye line, both in cm.
"""

import numpy as np

from .fields import Floats, ramp

MOUTH_HALF_WIDTH = 2.45  # middle line to corner of the mouth, cm
MOUTH_HEIGHT = -6.86  # where the lips meet, cm
UPPER_LIP_HEIGHT = 0.74  # tallest red of the upper lip before its dip, cm
LOWER_LIP_HEIGHT = 0.98

EYE_CENTRE = (3.22, 0.05, 6.82)  # middle of the eyeball, cm
LID_HALF_WIDTH = 1.58  # middle of the closed eye to its corners, cm
INNER_CORNER = EYE_CENTRE[0] - LID_HALF_WIDTH
OUTER_CORNER = EYE_CENTRE[0] + LID_HALF_WIDTH

# Lower edge of the hair: (angle from straight ahead in degrees, height in cm).
HAIRLINE = (
    (0, 7.1),
    (15, 7.25),
    (27, 7.8),
    (36, 7.6),
    (45, 6.6),
    (53, 5.2),
    (60, 3.9),
    (67, 1.9),
    (73, -1.0),
    (77, -2.3),
    (84, -2.4),
    (89, 0.6),
    (97, 0.9),
    (105, -0.4),
    (111, -3.2),
    (118, -5.0),
    (135, -6.6),
    (180, -7.4),
)


def mouth_line(side: Floats) -> Floats:
    """Line where the closed lips meet."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1.3)
    middle_dip = 0.10 * np.exp(-((side / 0.55) ** 2))
    wave = 0.03 * np.cos(np.pi * share)
    return np.asarray(MOUTH_HEIGHT - middle_dip + wave - 0.10 * share**2, np.float32)


def upper_lip_border(side: Floats) -> Floats:
    """Upper edge of the red of the upper lip, with the dip and peaks of its bow."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1)
    border = mouth_line(side) + UPPER_LIP_HEIGHT * (1 - share**1.75) ** 0.9
    dip = 0.09 * np.exp(-((side / 0.45) ** 2))
    peak = 0.03 * np.exp(-(((side - 0.62) / 0.40) ** 2))
    return np.asarray(border - dip + peak, np.float32)


def lower_lip_border(side: Floats) -> Floats:
    """Lower edge of the red of the lower lip."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1)
    height = LOWER_LIP_HEIGHT * (1 - share**2.2) ** 0.625
    return np.asarray(MOUTH_HEIGHT - 0.13 * share**2 - height, np.float32)


def mouth_presence(side: Floats) -> Floats:
    """1 between the corners of the mouth, 0 beyond them."""
    return ramp(MOUTH_HALF_WIDTH + 0.12, MOUTH_HALF_WIDTH - 0.35, side)


def lid_line(side: Floats) -> Floats:
    """Line where the closed eyelids meet."""
    share = (side - EYE_CENTRE[0]) / LID_HALF_WIDTH
    return np.asarray(EYE_CENTRE[1] - 0.55 + 0.36 * share**2 + 0.09 * share, np.float32)


def lid_crease(side: Floats) -> Floats:
    """Fold of the upper lid, about 1 cm above the line of the lids."""
    share = (side - EYE_CENTRE[0]) / 1.75
    return np.asarray(EYE_CENTRE[1] + 0.52 - 0.34 * share**2 - 0.05 * share, np.float32)


def lid_presence(side: Floats) -> Floats:
    """1 between the corners of an eye, 0 beyond them."""
    inner = ramp(INNER_CORNER - 0.15, INNER_CORNER + 0.35, side)
    return inner * ramp(OUTER_CORNER + 0.25, OUTER_CORNER - 0.25, side)


def crease_presence(side: Floats) -> Floats:
    """1 along the fold of the upper lid, fading towards both corners."""
    return ramp(1.65, 2.9, side) * ramp(5.1, 3.8, side)


def hairline(points: Floats) -> Floats:
    """Height of each point (N, 3) above the edge of the hair, cm; negative on bare skin."""
    angle = np.abs(np.degrees(np.arctan2(points[:, 0], points[:, 2])))
    angles, heights = np.transpose(HAIRLINE)
    return np.asarray(points[:, 1] - np.interp(angle, angles, heights), np.float32)
