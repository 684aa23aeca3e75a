"""The head as one implicit surface.

``head_distance`` is negative inside and positive outside; close to the surface it approximates the
distance in cm. Parts are defined for the left half and mirrored: ``side`` is the distance from the
middle plane. All sizes are in cm.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from . import landmarks
from .fields import (
    SMALLEST,
    Capsule,
    Ellipsoid,
    Floats,
    Spot,
    bell,
    curve,
    ramp,
    smooth_maximum,
    smooth_minimum,
)

# --- cranium and mask ---------------------------------------------------------------------------

# The mask, the face from hairline to chin, is a stack of horizontal superelliptic outlines.
# Columns: height; front; half width; middle (z of the widest place); back; exponent of the front
# half of the outline (2 is an ellipse, larger values are boxier).
MASK_OUTLINES = (
    (14.0, 3.50, 4.00, -1.0, -6.0, 2.10),  # crown, hidden in the cranium
    (11.0, 6.00, 5.80, -1.0, -8.0, 2.10),
    (8.0, 7.90, 6.80, -1.0, -9.3, 2.20),  # hairline
    (6.0, 8.85, 7.10, -0.9, -9.8, 2.30),
    (4.0, 9.30, 7.25, -0.8, -9.9, 2.35),  # forehead
    (2.0, 9.35, 7.20, -0.5, -9.7, 2.40),  # brows
    (0.0, 8.95, 7.00, 0.0, -9.1, 2.40),  # eyes
    (-2.0, 8.85, 6.90, 0.6, -8.2, 2.30),
    (-4.0, 9.15, 6.55, 0.9, -6.5, 2.15),  # below the cheekbones
    (-6.0, 9.40, 6.05, 0.8, -3.5, 2.00),  # upper lip
    (-8.0, 8.95, 5.40, 1.3, -1.5, 1.95),  # under the lower lip
    (-9.5, 8.45, 4.75, 2.4, -0.2, 1.95),
    (-10.4, 8.20, 4.40, 3.5, 0.8, 2.00),  # chin
    (-11.2, 7.60, 3.50, 4.4, 1.8, 2.00),
    (-12.0, 6.50, 2.70, 4.8, 2.4, 2.00),
    (-13.0, 5.60, 2.00, 4.8, 2.8, 2.00),
)
MASK_BACK_SQUARENESS = 2.1
_mask_front, _mask_width, _mask_middle, _mask_back, _mask_squareness = (
    curve([(row[0], row[column]) for row in MASK_OUTLINES]) for column in range(1, 6)
)

CRANIUM_CENTRE = (0.0, 2.6, -0.4)
CRANIUM_RADII_FRONT = (7.35, 9.0, 9.55)
CRANIUM_RADII_BACK = (7.35, 9.0, 9.35)
CRANIUM_SQUARENESS = 2.3

JAW_RAMUS = Capsule((5.4, -3.2, 0.7), (4.1, -6.0, 1.9), 0.6, 0.6)  # from the ear to the jaw's angle
JAW_BODY = Capsule((3.7, -6.9, 2.6), (0.0, -10.0, 6.9), 0.6, 0.80)  # angle of the jaw to chin
JAW_PLANE_CHIN = -11.42  # height of the underside of the jaw at z = 8
JAW_PLANE_SLOPE = 0.44  # slope of the underside, which rises towards the ears
JAW_EDGE = 3.0  # radius of the blend between the sides of the jaw and its underside

# Soft bumps and dents of the mask: height above the surface, and place.
FACE_RELIEF = {
    "brow ridge": (0.34, Spot(2.7, 1.85, 1.7, 0.50, 5)),
    "glabella": (0.12, Spot(0.0, 1.75, 1.1, 0.7)),
    "orbit": (-0.86, Spot(2.95, 0.0, 1.50, 0.86)),
    "inner corner of the eye": (-0.28, Spot(1.55, 0.05, 0.50, 0.65)),
    "outer orbit": (-0.22, Spot(4.8, -0.10, 0.80, 0.80)),
    "brow fat": (0.24, Spot(3.5, 1.10, 1.1, 0.36, -8)),
    "cheekbone": (0.36, Spot(5.0, -2.3, 1.35, 0.95, -25)),
    "cheek fat": (0.30, Spot(3.4, -3.0, 1.4, 1.1, -25)),
    "hollow of the cheek": (-0.12, Spot(4.7, -6.0, 1.3, 1.9, 15)),
    "temple": (-0.25, Spot(6.9, 2.2, 1.0, 1.7)),
    "muzzle": (0.30, Spot(0.0, -6.0, 1.7, 1.0)),
    "nose to mouth fold": (-0.07, Spot(2.5, -5.2, 0.22, 0.85, -28)),
    "cheek above that fold": (0.07, Spot(3.1, -5.0, 0.5, 1.0, -30)),
    "corner of the mouth": (-0.12, Spot(2.75, -7.10, 0.40, 0.50, 20)),
    "cheek beside the mouth": (0.07, Spot(3.05, -6.85, 0.4, 0.5)),
    "groove above the chin": (-0.28, Spot(0.0, -8.55, 1.5, 0.42)),
    "ball of the chin": (0.40, Spot(0.0, -9.95, 1.45, 0.85)),
    "philtrum": (-0.10, Spot(0.0, -5.55, 0.22, 0.50)),
    "ridges of the philtrum": (0.07, Spot(0.42, -5.60, 0.16, 0.55, 8)),
    "frontal bone": (0.14, Spot(2.6, 5.2, 1.8, 1.3)),
    "cornea": (0.05, Spot(3.25, -0.10, 0.55, 0.45)),
    "tear trough": (-0.12, Spot(2.4, -1.30, 1.2, 0.26, -20)),
}

# --- eyes ---------------------------------------------------------------------------------------

EYEBALL = Ellipsoid(landmarks.EYE_CENTRE, (1.42, 1.14, 1.36))  # with the lids on it
EYEBALL_BLEND = 0.55  # radius of the blend between lids and orbit

# --- nose ---------------------------------------------------------------------------------------

# Bridge of the nose: (height on the face, projection from the mask, half width).
BRIDGE = (
    (3.0, 0.00, 0.55),
    (1.6, 0.00, 0.55),
    (0.9, 0.10, 0.55),
    (0.2, 0.34, 0.58),
    (-0.8, 0.80, 0.66),
    (-1.8, 1.25, 0.78),
    (-2.8, 1.68, 0.92),
    (-3.5, 1.86, 1.02),
    (-4.1, 1.50, 1.06),
    (-4.6, 0.55, 1.00),
    (-5.0, 0.00, 0.90),
    (-6.0, 0.00, 0.90),
)
_bridge_height = curve([(row[0], row[1]) for row in BRIDGE])
_bridge_width = curve([(row[0], row[2]) for row in BRIDGE])

NOSE_TIP = Ellipsoid((0.0, -3.55, 10.20), (0.90, 0.80, 0.95))
NOSE_TIP_DOME = Ellipsoid((0.38, -3.80, 10.42), (0.50, 0.46, 0.58))
COLUMELLA = Capsule((0.0, -4.05, 10.55), (0.0, -4.74, 9.5), 0.34, 0.42)
NOSE_WING = Ellipsoid((1.10, -4.08, 9.42), (0.66, 0.64, 0.96))
NOSTRIL = Capsule((0.50, -4.76, 10.08), (0.82, -4.84, 9.55), 0.15, 0.22)
NOSTRIL_DEPTH = Capsule((0.65, -4.78, 9.82), (0.58, -4.15, 9.70), 0.22, 0.22)
WING_GROOVE_CENTRE = (1.12, -3.98)  # centre of the circular groove around a wing
WING_GROOVE_RADIUS = 0.76

# --- neck ---------------------------------------------------------------------------------------

NECK = Capsule((0.0, -6.5, -2.8), (0.0, -19.0, -3.9), 4.9, 5.7)
THROAT = Capsule((0.0, -9.2, 2.0), (0.0, -18.0, -0.4), 1.9, 2.1)
MOUTH_FLOOR = Capsule((0.0, -9.6, 5.0), (0.0, -11.2, 2.4), 1.0, 1.2)  # soft, under the chin
LARYNX = Ellipsoid((0.0, -12.6, 2.6), (0.75, 1.1, 0.85))
NAPE = Capsule((0.0, -3.0, -5.0), (0.0, -14.0, -5.3), 2.7, 3.0)  # muscles up to the skull
NECK_MUSCLE = Capsule((5.4, -4.2, -2.6), (1.2, -17.5, 1.5), 0.8, 0.85)  # from ear to collarbone
TRAPEZIUS = Capsule((2.0, -12.5, -4.7), (7.6, -22.0, -4.5), 3.0, 3.2)  # from nape to shoulder

# --- ear ----------------------------------------------------------------------------------------

EAR_CENTRE = (7.60, -1.35, -1.05)
EAR_LEAN = 12.0  # backward tilt of the ear's top, degrees
EAR_FLARE = 26.0  # angle between the ear and the side of the head, degrees
EAR_HALF_HEIGHT = 3.10
EAR_BOX = (2.3, 4.5, 3.0)  # half sizes of a box around an ear, at least EAR_MARGIN away
EAR_MARGIN = 0.6
EAR_THICKNESS = 0.17  # half thickness of the ear's plate
EAR_RIM, EAR_ROLLED_RIM = 0.19, 0.29  # radius of the rim at the lobe, and at the top
# Solids in the coordinates of the ear: (out of the ear's plate, up, forward).
EAR_BOWL = Ellipsoid((0.62, -0.45, 0.36), (0.90, 1.02, 0.82))
EAR_UPPER_BOWL = Ellipsoid((0.70, 0.70, 0.42), (0.62, 0.46, 0.80))
EAR_HELIX_ROOT = Capsule((-0.10, 0.14, 0.35), (0.30, 0.62, 1.40), 0.16, 0.22)
EAR_TRAGUS = Capsule((0.22, -0.25, 1.22), (0.30, -0.80, 1.08), 0.30, 0.26)
EAR_ANTITRAGUS = Capsule((0.26, -1.62, 0.66), (0.30, -1.36, 0.08), 0.20, 0.22)
EAR_LOBE = Ellipsoid((0.22, -2.38, 0.58), (0.32, 0.76, 0.66))
EAR_BACKING = Ellipsoid((-0.42, -0.30, 0.45), (0.55, 1.35, 1.15))  # rear side of the bowl
EAR_ATTACHMENT = Ellipsoid((-0.50, -0.30, 1.12), (0.66, 2.1, 0.72))  # joins the ear to the skull
# The antihelix: (height, forward, radius) from the antitragus along the back of the bowl into the
# upper of its two legs; its height above the plate; and its lower leg.
EAR_ANTIHELIX = (
    (-2.60, 0.80, -1.50),
    (-2.00, 0.50, -0.20),
    (-1.75, 0.35, 0.10),
    (-1.45, 0.10, 0.20),
    (-1.00, -0.32, 0.24),
    (-0.40, -0.58, 0.26),
    (0.10, -0.62, 0.26),
    (0.65, -0.47, 0.26),
    (1.20, -0.20, 0.23),
    (2.00, 0.22, 0.12),
    (2.40, 0.42, -0.20),
    (3.00, 0.75, -1.50),
)
EAR_ANTIHELIX_LIFT = 0.18
EAR_LOWER_LEG = Capsule((0.22, 0.75, -0.42), (0.18, 1.30, 0.90), 0.22, 0.12)
_antihelix_forward = curve([(row[0], row[1]) for row in EAR_ANTIHELIX])
_antihelix_radius = curve([(row[0], row[2]) for row in EAR_ANTIHELIX])

FACE_BACK, FACE_FRONT = 1.0, 5.0  # range of z in which the relief of the face fades in
MIDDLE_ROUNDING = 0.14  # distance from the middle plane within which the mirroring is smoothed
BLOCK = 400_000  # points per evaluation; limits temporary arrays to a few tens of megabytes


def _mask_size(side: Floats, y: Floats, z: Floats) -> Floats:
    """Return 1 on the outline of the mask, less inside, more outside."""
    middle = _mask_middle(y)
    ahead = z - middle
    depth = np.where(ahead > 0, _mask_front(y) - middle, middle - _mask_back(y))
    squareness = np.where(ahead > 0, _mask_squareness(y), MASK_BACK_SQUARENESS).astype(np.float32)
    across = np.maximum(side / _mask_width(y), 1e-4) ** squareness
    along = np.maximum(np.abs(ahead) / depth, 1e-4) ** squareness
    return np.asarray((across + along) ** (1 / squareness), np.float32)


def _mask(side: Floats, y: Floats, z: Floats) -> Floats:
    step = np.float32(0.02)
    size = _mask_size(side, y, z)
    slopes = (
        (_mask_size(side + step, y, z) - size) / step,
        (_mask_size(side, y + step, z) - size) / step,
        (_mask_size(side, y, z + step) - size) / step,
    )
    slope = np.sqrt(sum(s * s for s in slopes)) + 1e-4
    distance = np.clip((size - 1) / slope, -4, 6)
    return smooth_maximum(np.asarray(distance, np.float32), (y - 5.5) * 0.6, 3.0)


def _cranium(side: Floats, y: Floats, z: Floats) -> Floats:
    """Return the distance to a superellipsoid whose front half is longer than its back half."""
    power = CRANIUM_SQUARENESS
    radii = (
        CRANIUM_RADII_FRONT[0],
        CRANIUM_RADII_FRONT[1],
        np.where(z > CRANIUM_CENTRE[2], CRANIUM_RADII_FRONT[2], CRANIUM_RADII_BACK[2]),
    )
    scaled = [
        np.maximum(np.abs(at - middle) / radius, 1e-4)
        for at, middle, radius in zip((side, y, z), CRANIUM_CENTRE, radii, strict=True)
    ]
    total = np.asarray(sum(s**power for s in scaled))
    size = total ** (1 / power)
    slopes = [
        size / total * s ** (power - 1) / radius for s, radius in zip(scaled, radii, strict=True)
    ]
    slope = np.sqrt(sum(s * s for s in slopes)) + 1e-4
    return np.asarray(np.clip((size - 1) / slope, -5, 8), np.float32)


def _lip_relief(side: Floats, y: Floats) -> Floats:
    """Return the height of the lips above the mask."""
    line = landmarks.mouth_line(side)
    border = landmarks.upper_lip_border(side)
    upper = np.maximum(border - line, 0.20)
    lower = np.maximum(line - landmarks.lower_lip_border(side), 0.20)
    taper = np.sqrt(np.clip(1 - (side / (landmarks.MOUTH_HALF_WIDTH + 0.1)) ** 2, 0, 1))
    upper_roll = bell((y - line - 0.32 * upper) / (0.38 * upper + 0.03))
    lower_roll = bell((y - line + 0.47 * lower) / (0.33 * lower + 0.03))
    upper_edge = bell((y - border) / 0.06)
    inside = ramp(landmarks.MOUTH_HALF_WIDTH + 0.05, landmarks.MOUTH_HALF_WIDTH - 0.35, side)
    relief = 0.25 * upper_roll * taper + 0.33 * lower_roll * taper**1.3 + 0.010 * upper_edge * taper
    return np.asarray(relief * inside, np.float32)


def _lid_relief(side: Floats, y: Floats, *, fine: bool) -> Floats:
    """Return the relief of the closed eyelids; ``fine`` gives folds their real, small width."""
    above_line = y - landmarks.lid_line(side)
    above_crease = y - landmarks.lid_crease(side)
    edge, fold = (0.05, 0.13) if fine else (0.20, 0.24)
    on_lid = landmarks.lid_presence(side)
    # The edge of the upper lid overlaps the lower lid, and skin hangs over the crease. Both are
    # steps, steep below and gradual above.
    upper_edge = ramp(-edge, edge, above_line) * np.exp(-np.maximum(above_line, 0) / 0.28)
    hanging = ramp(-fold, fold, above_crease) * np.exp(-np.maximum(above_crease, 0) / 0.45)
    seam = bell((above_line + 0.4 * edge) / edge)
    crease = bell((above_crease + 0.5 * fold) / fold)
    # The lower lid is a roll below the line, with a furrow between it and the cheek.
    roll = bell((above_line + 0.26) / 0.17)
    furrow = bell((above_line + 0.66) / 0.17)
    relief = on_lid * (0.08 * upper_edge - 0.08 * seam + 0.06 * roll - 0.05 * furrow)
    relief += landmarks.crease_presence(side) * (0.07 * hanging - 0.040 * crease)
    return np.asarray(relief, np.float32)


def _nose(x: Floats, side: Floats, y: Floats, z: Floats) -> Floats:
    """Return the distance to tip, columella and wings of the nose; the bridge is in the mask."""
    nose = NOSE_TIP.distance(x, y, z)
    nose = smooth_minimum(nose, NOSE_TIP_DOME.distance(side, y, z), 0.4)
    nose = smooth_minimum(nose, COLUMELLA.distance(x, y, z), 0.4)
    return smooth_minimum(nose, NOSE_WING.distance(side, y, z), 0.45)


def _nostrils(side: Floats, y: Floats, z: Floats) -> Floats:
    return smooth_minimum(NOSTRIL.distance(side, y, z), NOSTRIL_DEPTH.distance(side, y, z), 0.15)


def _wing_groove(side: Floats, y: Floats, z: Floats) -> Floats:
    """Return the depth, from 0 to 1, of the groove between a wing of the nose and the cheek."""
    across, up = side - WING_GROOVE_CENTRE[0], y - WING_GROOVE_CENTRE[1]
    ring = bell((np.hypot(across, up) - WING_GROOVE_RADIUS) / 0.15)
    outer_and_upper = ramp(0.15, 0.6, across + 0.35 * up)
    return np.asarray(ring * outer_and_upper * ramp(8.3, 9.1, z), np.float32)


def _neck(x: Floats, side: Floats, y: Floats, z: Floats) -> Floats:
    neck = NECK.distance(0.97 * x, y, z)
    neck = smooth_minimum(neck, THROAT.distance(x, y, z), 2.2)
    neck = smooth_minimum(neck, LARYNX.distance(x, y, z), 1.5)
    neck = smooth_minimum(neck, MOUTH_FLOOR.distance(x, y, z), 2.0)
    neck = smooth_minimum(neck, NAPE.distance(0.7 * x, y, z), 1.6)
    return smooth_minimum(neck, NECK_MUSCLE.distance(side, y, z), 0.9)


def _near_ear_distance(out: Floats, up: Floats, ahead: Floats) -> Floats:
    """Return the distance to an ear; coordinates are relative to its centre, on the head's axes."""
    cosine, sine = np.cos(np.radians(EAR_LEAN)), np.sin(np.radians(EAR_LEAN))
    up, ahead = cosine * up - sine * ahead, sine * up + cosine * ahead
    cosine, sine = np.cos(np.radians(EAR_FLARE)), np.sin(np.radians(EAR_FLARE))
    out, ahead = cosine * out + sine * ahead, cosine * ahead - sine * out
    frame = (np.asarray(out), np.asarray(up), np.asarray(ahead))

    # The plate is egg-shaped, wider at the top, and slightly concave. ``edge`` is the distance to
    # its outline.
    half_width = 1.66 + 0.34 * np.clip(up / 3, -1.1, 1)
    centred = ahead - 0.18 * np.clip(-up - 0.8, 0, 2)
    across, along = centred / half_width, up / EAR_HALF_HEIGHT
    size = np.hypot(across, along) + SMALLEST
    edge = (size - 1) * size / np.hypot(across / half_width, along / EAR_HALF_HEIGHT + SMALLEST)
    plate = 0.26 * size * size + 0.10 * np.clip(-centred, 0, 2)
    ear = smooth_maximum(np.abs(out - plate) - EAR_THICKNESS, edge + EAR_RIM, 0.2)
    ear = smooth_minimum(ear, EAR_LOBE.distance(*frame), 0.4)

    # The helix is the rim, rolled from the front over the top, at least as thick as a grid cell.
    angle = np.arctan2(along, across)
    angle = np.where(angle < -1.4, angle + 2 * np.pi, angle)
    rolled = ramp(2.9, 1.2, np.abs(angle - 2.0))
    rim = EAR_RIM + (EAR_ROLLED_RIM - EAR_RIM) * rolled
    helix = np.hypot(edge + rim, out - plate - 0.20 * rolled) - rim
    ear = smooth_minimum(ear, np.asarray(helix, np.float32), 0.15)

    for hollow in (EAR_BOWL, EAR_UPPER_BOWL):
        ear = smooth_maximum(ear, -hollow.distance(*frame), 0.2)
    step = np.float32(0.05)
    lean = (_antihelix_forward(up + step) - _antihelix_forward(up - step)) / (2 * step)
    offset = (ahead - _antihelix_forward(up)) / np.hypot(1, lean)
    ridge = np.hypot(offset, out - plate - EAR_ANTIHELIX_LIFT) - _antihelix_radius(up)
    ear = smooth_minimum(ear, np.asarray(ridge, np.float32), 0.25)
    for part, blend in (
        (EAR_LOWER_LEG, 0.30),
        (EAR_HELIX_ROOT, 0.20),
        (EAR_TRAGUS, 0.30),
        (EAR_ANTITRAGUS, 0.20),
        (EAR_BACKING, 0.15),
        (EAR_ATTACHMENT, 0.40),
    ):
        ear = smooth_minimum(ear, part.distance(*frame), blend)
    return ear


def ear_distance(points: Floats) -> Floats:
    """Return the signed distance of points (N, 3) to the outer ears, in cm.

    Outside a box around each ear, the result is approximate, but larger than any blend radius.
    """
    places = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    offsets = [place - middle for place, middle in zip(places, EAR_CENTRE, strict=True)]
    past = [np.maximum(np.abs(o) - half, 0) for o, half in zip(offsets, EAR_BOX, strict=True)]
    beyond = np.sqrt(sum(p * p for p in past))
    distance = np.asarray(beyond + EAR_MARGIN, np.float32)
    near = beyond == 0
    distance[near] = _near_ear_distance(*(o[near] for o in offsets))
    return distance


def bent(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Map points to the symmetric head; the inverse makes the head slightly asymmetric."""
    x, y, z = (points[:, axis].astype(np.float32) for axis in range(3))
    side = x + 0.07 * np.sin(0.45 * y + 0.6) * ramp(2, 8, z) + 0.02 * np.sin(1.3 * y)
    raised = y + 0.05 * np.sin(0.5 * side) * ramp(3, 8, z)
    return np.asarray(side, np.float32), np.asarray(raised, np.float32), z


def placed(points: Floats) -> Floats:
    """Return the places on the asymmetric head of points (N, 3) of the symmetric head."""
    found = points
    for _ in range(8):
        found = found + points - np.stack(bent(found), 1)
    return np.asarray(found, np.float32)


def _without_ears(
    x: Floats, y: Floats, z: Floats, *, fine: bool, closed_lids: bool = True
) -> Floats:
    side = np.sqrt(x * x + MIDDLE_ROUNDING**2)
    in_front = ramp(FACE_BACK, FACE_FRONT, z)

    head = smooth_minimum(_mask(side, y, z), _cranium(side, y, z), 1.2)
    underside = (JAW_PLANE_CHIN + (8.0 - z) * JAW_PLANE_SLOPE - y) / np.hypot(1, JAW_PLANE_SLOPE)
    head = smooth_maximum(head, underside, JAW_EDGE)
    head = smooth_minimum(head, JAW_RAMUS.distance(side, y, z), 2.6)
    head = smooth_minimum(head, JAW_BODY.distance(side, y, z), 2.2)

    bridge = _bridge_height(y) * np.exp(-0.5 * np.abs(side / _bridge_width(y)) ** 2.2)
    relief = _lip_relief(side, y) + bridge
    for height, spot in FACE_RELIEF.values():
        relief = relief + height * spot.weight(side, y)
    head = head - relief * in_front

    head = smooth_minimum(head, EYEBALL.distance(side, y, z), EYEBALL_BLEND)
    if closed_lids:
        head = head - _lid_relief(side, y, fine=fine) * in_front

    head = smooth_minimum(head, _nose(x, side, y, z), 0.62)
    head = smooth_maximum(head, -_nostrils(side, y, z), 0.12)
    head = head + 0.12 * _wing_groove(side, y, z)

    depth, width = (0.15, 0.085) if fine else (0.10, 0.16)
    seam = bell((y - landmarks.mouth_line(side)) / width)
    head = head + depth * seam * landmarks.mouth_presence(side) * ramp(6, 8, z)

    head = smooth_minimum(head, _neck(x, side, y, z), 2.2)
    return smooth_minimum(head, TRAPEZIUS.distance(side, y, z), 2.6)


def head_distance(points: Floats, *, fine: bool = False) -> Floats:
    """Return the signed distance of points to the skin, in cm.

    Parameters
    ----------
    points : (N, 3) in cm
    fine : whether the folds of lids and mouth have their real width, which is too narrow for the
        mesh; the normal map uses it
    """
    places = bent(points)
    ears = ear_distance(np.stack(places, 1))
    return smooth_minimum(_without_ears(*places, fine=fine), ears, 0.35)


def lidless_distance(points: Floats) -> Floats:
    """Return the distance to a face whose eyelids have no edges and folds, without ears."""
    return _without_ears(*bent(points), fine=False, closed_lids=False)


def nostril_distance(points: Floats) -> Floats:
    """Return the signed distance of points (N, 3) to the hollows of the nostrils, in cm."""
    x, y, z = bent(points)
    return _nostrils(np.abs(x), y, z)


def belongs_to_ear(points: Floats) -> NDArray[np.bool_]:
    """Return whether points near the skin are nearer to an ear than to the rest of the head."""
    places = bent(points)
    ear = ear_distance(np.stack(places, 1))
    return np.asarray(ear < _without_ears(*places, fine=False))


def fine_head_distance(points: Floats) -> Floats:
    """Return ``head_distance`` with ``fine=True``."""
    return head_distance(points, fine=True)


def in_blocks(distance: Callable[[Floats], Floats], points: Floats) -> Floats:
    """Evaluate ``distance`` at many points, in blocks."""
    blocks = [distance(points[start : start + BLOCK]) for start in range(0, len(points), BLOCK)]
    return np.concatenate(blocks) if blocks else np.zeros(0, np.float32)


def gradient(distance: Callable[[Floats], Floats], points: Floats, step: float) -> Floats:
    """Return the gradient of ``distance`` at points (N, 3), by differences over a tetrahedron."""
    corners = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], np.float32)
    total = np.zeros_like(points)
    for corner in corners:
        total += corner * in_blocks(distance, points + corner * np.float32(step))[:, None]
    return np.asarray(total / (4 * step), np.float32)


def unit(vectors: Floats) -> Floats:
    """Return vectors (..., 3) scaled to length 1."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(lengths, 1e-9), np.float32)
