"""Blend shapes of the head, with the names of ARKit: displacements of the vertices of each part.

Left and right are the head's own. Shapes of brows, cheeks and lips are smooth fields in space. The
jaw rotates, with weights that minimise the bending of the skin. The lids slide over the eyeball.
Lengths are in cm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from .eyes import Textured
from .fields import Floats, Spot, ramp
from .lashes import STRAND_VERTICES, UPPER
from .lids import Opening, closed_lids, skin_places
from .mouth import GUMS_RING, LIPS_RING, Mouth, above_line
from .shape import JAW_BODY, bent
from .surface import Faces, Mesh, face_normals

Moves = dict[str, Floats]  # the displacement of each vertex, (N, 3), by the name of the shape


@dataclass(frozen=True)
class Push:
    """A displacement (outward, up, forward) in cm, with the weight of a spot."""

    spot: Spot
    move: tuple[float, float, float]


SMILE = (
    Push(Spot(2.55, -6.90, 1.05, 0.95), (0.48, 0.54, -0.38)),  # corner of the mouth
    Push(Spot(1.35, -6.75, 0.85, 0.85), (0.24, 0.13, -0.12)),  # lips
    Push(Spot(3.55, -3.80, 1.30, 1.10, -25), (0.10, 0.38, 0.42)),  # cheek
    Push(Spot(2.40, -5.00, 0.60, 0.90, -30), (0.12, 0.14, -0.10)),  # fold from nose to mouth
)
BROW_INNER_UP = (
    Push(Spot(1.15, 1.65, 0.95, 0.80), (-0.05, 0.58, 0.0)),
    Push(Spot(1.30, 3.20, 1.20, 0.95), (0.0, 0.18, 0.0)),
)
BROW_DOWN = (
    Push(Spot(1.50, 1.70, 0.95, 0.75), (-0.16, -0.40, 0.08)),
    Push(Spot(3.40, 1.85, 1.20, 0.65), (-0.05, -0.22, 0.02)),
)
# Shapes of the skin: name, pushes, and sides (1 left, -1 right).
FIELDS = (
    ("browDownLeft", BROW_DOWN, (1,)),
    ("browDownRight", BROW_DOWN, (-1,)),
    ("browInnerUp", BROW_INNER_UP, (1, -1)),
    ("mouthSmileLeft", SMILE, (1,)),
    ("mouthSmileRight", SMILE, (-1,)),
)
FIELD_END = (
    2.6  # distance from a spot's centre, in its standard deviations, at which its field ends
)
FIELD_BACK, FIELD_FRONT = 0.5, 4.0  # range of z in which the fields fade in

JAW_AXIS = (-1.3, 1.0)  # height and z of the axis through the condyles
JAW_ANGLE = 14.6  # degrees; opens the lips by 25 mm
JAW_FORWARD = 0.20  # slide of the condyles
JAW_CORNERS = Push(Spot(2.3, -6.95, 0.9, 0.9), (-0.30, 0.0, 0.0))  # the mouth becomes narrower
# Skin that follows the jaw: within a distance of the bone, on the chin, and on the lower lip.
JAW_REACH, JAW_BACK = 1.25, 5.6  # largest distance, smallest z
CHIN_TOP, CHIN_END = -8.3, -10.9
JAW_CHIN, JAW_LIP = 2.0, 0.5  # half widths
# Skin that stays: around these heights and depths, and in the middle of upper lip and nose.
STILL_ABOVE, STILL_BELOW, STILL_BEHIND, STILL_BESIDE = -2.9, -13.4, 0.0, 6.4
STILL_LIP, STILL_NOSE, STILL_NOSE_END = 0.6, 1.8, -6.0  # half widths, lowest height
MOUTH_BACK = 6.0  # z in front of which lips and chin lie

SHORTEST = 0.01  # displacements below this length become 0, and longer ones a little shorter, cm

LASH_TURN = 50.0  # downward rotation of the upper lashes of closed lids, degrees


def _push(points: Floats, push: Push, sides: Sequence[int]) -> Floats:
    """Return the displacements of points (N, 3) by a push on the given sides."""
    x, y, z = bent(points)
    total = np.zeros_like(points)
    for side in sides:
        squared = -2 * np.log(np.maximum(push.spot.weight(side * x, y), 1e-9))
        weight = np.maximum(1 - squared / FIELD_END**2, 0) ** 3 * ramp(FIELD_BACK, FIELD_FRONT, z)
        total += weight[:, None] * np.array(push.move, np.float32) * (side, 1, 1)
    return total


def _stiffness(positions: Floats, faces: Faces) -> tuple[csr_matrix, Floats]:
    """Return the Laplacian of a mesh with cotangent weights, and the area of each vertex."""
    corners = positions[faces].astype(np.float64)
    double_area = np.maximum(np.linalg.norm(face_normals(positions, faces), axis=1), 1e-6)
    rows, columns, values = [], [], []
    for i in range(3):
        a, b = faces[:, (i + 1) % 3], faces[:, (i + 2) % 3]
        to_a = corners[:, (i + 1) % 3] - corners[:, i]
        to_b = corners[:, (i + 2) % 3] - corners[:, i]
        half = np.clip((to_a * to_b).sum(1) / double_area, 0.02, 20) / 2
        rows += [a, b, a, b]
        columns += [b, a, a, b]
        values += [-half, -half, half, half]
    count = len(positions)
    matrix = csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, count)
    )
    area = np.bincount(faces.ravel(), np.repeat(double_area / 6, 3), count)
    return matrix, np.maximum(area, 1e-6)


def _jaw_weights(mesh: Mesh, mouth: Mouth) -> Floats:
    """Return the weight of the jaw at each vertex: 1 on chin and lower lip, 0 on the upper face."""
    points = mesh.positions
    x, y, z = bent(points)
    side = np.abs(x)
    height, _ = above_line(points)
    below = height < 0
    below[mouth.loop] = np.arange(len(mouth.loop)) > len(mouth.loop) // 2
    bone = (JAW_BODY.distance(side, y, z) < JAW_REACH) & (z > JAW_BACK)
    chin = (bone | ((side < JAW_CHIN) & (z > MOUTH_BACK))) & (y < CHIN_TOP) & (y > CHIN_END)
    moving = chin | (below & (side < JAW_LIP) & (y > CHIN_TOP) & (z > MOUTH_BACK))
    still = (y > STILL_ABOVE) | (y < STILL_BELOW) | (z < STILL_BEHIND) | (side > STILL_BESIDE)
    in_middle = (side < STILL_LIP) | ((side < STILL_NOSE) & (y > STILL_NOSE_END))
    still |= ~below & in_middle & (z > MOUTH_BACK)

    faces = mesh.faces[(mesh.faces < mouth.cavity[0]).all(1)]
    free = np.intersect1d(np.flatnonzero(~moving & ~still), faces)
    laplacian, area = _stiffness(points, faces)
    bending = (laplacian @ diags(1 / area) @ laplacian).tocsr()
    weights = moving.astype(np.float64)
    weights[free] = spsolve(bending[free][:, free].tocsc(), -(bending[free] @ weights))
    # The inside of the lips follows them; upper teeth stay, and lower teeth follow the jaw.
    half = len(mouth.loop) // 2
    column = np.arange(len(mouth.cavity)) % len(mouth.loop)
    outer = np.abs(column / half % 1 - 0.5).astype(np.float32)  # 0.5 at the corners
    rigid = 0.5 + np.where(column > half, 0.5, -0.5) * ramp(0.5, 0.375, outer)
    rigid[-1] = 0.5
    share = ramp(LIPS_RING, GUMS_RING - 1, mouth.ring)
    weights[mouth.cavity] = weights[mouth.anchors] * (1 - share) + rigid * share
    return np.clip(weights, 0, 1).astype(np.float32)


def _jaw_open(mesh: Mesh, mouth: Mouth) -> Floats:
    weights = _jaw_weights(mesh, mouth)
    angle = np.radians(JAW_ANGLE) * weights
    x, y, z = (mesh.positions - (0, *JAW_AXIS)).T
    moves = np.stack(
        [
            np.zeros_like(x),
            np.cos(angle) * y - np.sin(angle) * z - y,
            np.cos(angle) * z + np.sin(angle) * y - z + JAW_FORWARD * weights,
        ],
        1,
    )
    return np.asarray(moves, np.float32)


def _with_cavity(moves: Floats, mouth: Mouth) -> Floats:
    """Return displacements in which the inside of the lips follows them, and the teeth stay."""
    found = moves.copy()
    share = ramp(GUMS_RING, LIPS_RING, mouth.ring)
    found[mouth.cavity] = moves[mouth.anchors] * share[:, None]
    return found


def skin_moves(
    mesh: Mesh, mouth: Mouth, openings: Sequence[Opening], rings: Sequence[NDArray[np.int64]]
) -> Moves:
    """Return the shapes of the skin.

    Parameters
    ----------
    openings : open lids, left and right; the lids' shapes need them
    rings : vertices of each opening, (rings, points)
    """
    # Fields end at the lids' edges, because lashes and tear lines do not follow them.
    share = np.ones((len(mesh.positions), 1), np.float32)
    for rows in rings:
        share[rows, 0] = 0
        places = skin_places()
        share[rows[: len(places)], 0] = ramp(0.1, 1.0, places)
    corners = _with_cavity(_push(mesh.positions, JAW_CORNERS, (1, -1)), mouth)
    found = {"jawOpen": _jaw_open(mesh, mouth) + corners}
    for name, pushes, sides in FIELDS:
        moves = np.sum([_push(mesh.positions, push, sides) for push in pushes], axis=0)
        found[name] = _with_cavity(moves * share, mouth)
    for opening, rows in zip(openings, rings, strict=True):
        moves = np.zeros_like(mesh.positions)
        moves[rows] = (closed_lids(opening) - opening.rings) * (opening.eye.mirror, 1, 1)
        found[_blink(opening)] = moves
    return {name: _ended(moves) for name, moves in sorted(found.items())}


def _ended(moves: Floats) -> Floats:
    """Return displacements without those below SHORTEST; the others decrease to 0 smoothly."""
    squared = (moves * moves).sum(1, keepdims=True)
    share = np.maximum(1 - SHORTEST**2 / np.maximum(squared, 1e-12), 0)
    return np.asarray(moves * share, np.float32)


def _blink(opening: Opening) -> str:
    return "eyeBlinkLeft" if opening.eye.mirror > 0 else "eyeBlinkRight"


def _lash_moves(strands: Floats, opening: Opening) -> Floats:
    """Return the displacements of upper lashes, local (N, STRAND_VERTICES, 3), of closed lids.

    The roots follow the lid, and the lashes turn down around them.
    """
    ring = opening.edge + 2  # that of the roots
    line, closed = (rings[ring][opening.upper] for rings in (opening.rings, closed_lids(opening)))
    shift = closed - line
    roots = strands[:, :3].mean(1, keepdims=True)
    at = [np.interp(roots[:, 0, 0], line[:, 0], shift[:, axis]) for axis in range(3)]
    shifts = np.stack(at, -1)[:, None]
    angle = np.radians(LASH_TURN) * np.sqrt(shifts[..., 1] / shift[:, 1].min())
    x, y, z = np.moveaxis(strands - roots, -1, 0)
    turned = [x, np.cos(angle) * y - np.sin(angle) * z, np.cos(angle) * z + np.sin(angle) * y]
    return np.asarray(roots + shifts + np.stack(turned, -1) - strands, np.float32)


def lash_moves(lashes: Textured, openings: Sequence[Opening]) -> Moves:
    """Return the shapes of the lashes of both eyes."""
    points = lashes.mesh.positions
    found = {}
    for opening, rows in zip(
        openings, np.split(np.arange(len(points)), len(openings)), strict=True
    ):
        upper = rows[: UPPER.count * STRAND_VERTICES]
        strands = opening.eye.local(points[upper]).reshape(-1, STRAND_VERTICES, 3)
        moves = np.zeros_like(points)
        moves[upper] = _lash_moves(strands, opening).reshape(-1, 3) * (opening.eye.mirror, 1, 1)
        found[_blink(opening)] = moves
    return found
