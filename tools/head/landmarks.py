"""Lines of the face that shape and texture share.

All lines are in the front view: functions take ``side``, the distance from the middle line, and
return the height above the eye line, both in cm.
"""

import numpy as np

from .fields import Floats, ramp

MOUTH_HALF_WIDTH = 2.45  # from the middle line to the corner of the mouth, cm
MOUTH_HEIGHT = -6.86  # height of the line between the lips, cm
UPPER_LIP_HEIGHT = 0.74  # largest height of the upper lip's red, without the dip, cm
LOWER_LIP_HEIGHT = 0.98

EYE_CENTRE = (3.22, 0.05, 6.82)  # centre of the eyeball, cm
LID_HALF_WIDTH = 1.58  # from the centre of the closed eye to its corners, cm
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
    """Return the line between the closed lips."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1.3)
    middle_dip = 0.10 * np.exp(-((side / 0.55) ** 2))
    wave = 0.03 * np.cos(np.pi * share)
    return np.asarray(MOUTH_HEIGHT - middle_dip + wave - 0.10 * share**2, np.float32)


def upper_lip_border(side: Floats) -> Floats:
    """Return the upper edge of the upper lip, with the dip and the peaks of the Cupid's bow."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1)
    border = mouth_line(side) + UPPER_LIP_HEIGHT * (1 - share**1.75) ** 0.9
    dip = 0.09 * np.exp(-((side / 0.45) ** 2))
    peak = 0.03 * np.exp(-(((side - 0.62) / 0.40) ** 2))
    return np.asarray(border - dip + peak, np.float32)


def lower_lip_border(side: Floats) -> Floats:
    """Return the lower edge of the lower lip."""
    share = np.clip(side / MOUTH_HALF_WIDTH, 0, 1)
    height = LOWER_LIP_HEIGHT * (1 - share**2.2) ** 0.625
    return np.asarray(MOUTH_HEIGHT - 0.13 * share**2 - height, np.float32)


def mouth_presence(side: Floats) -> Floats:
    """Return 1 between the corners of the mouth, 0 beyond them."""
    return ramp(MOUTH_HALF_WIDTH + 0.12, MOUTH_HALF_WIDTH - 0.35, side)


def lid_line(side: Floats) -> Floats:
    """Return the line between the closed eyelids."""
    share = (side - EYE_CENTRE[0]) / LID_HALF_WIDTH
    return np.asarray(EYE_CENTRE[1] - 0.55 + 0.36 * share**2 + 0.09 * share, np.float32)


def lid_crease(side: Floats) -> Floats:
    """Return the fold of the upper lid, about 1 cm above :func:`lid_line`."""
    share = (side - EYE_CENTRE[0]) / 1.75
    return np.asarray(EYE_CENTRE[1] + 0.52 - 0.34 * share**2 - 0.05 * share, np.float32)


def lid_presence(side: Floats) -> Floats:
    """Return 1 between the corners of an eye, 0 beyond them."""
    inner = ramp(INNER_CORNER - 0.15, INNER_CORNER + 0.35, side)
    return inner * ramp(OUTER_CORNER + 0.25, OUTER_CORNER - 0.25, side)


def crease_presence(side: Floats) -> Floats:
    """Return 1 along the fold of the upper lid, decreasing to 0 at both corners."""
    return ramp(1.65, 2.9, side) * ramp(5.1, 3.8, side)


def hairline(points: Floats) -> Floats:
    """Return the height of points (N, 3) above the hairline, cm; negative on bare skin."""
    angle = np.abs(np.degrees(np.arctan2(points[:, 0], points[:, 2])))
    angles, heights = np.transpose(HAIRLINE)
    return np.asarray(points[:, 1] - np.interp(angle, angles, heights), np.float32)
