"""The mouth: a cut between the closed lips, and the cavity behind it.

The cut follows ``landmarks.mouth_line``. The cavity is a tube of rings behind the cut, with
teeth and a tongue. The lips hide it until a shape opens them. Lengths are in cm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import landmarks
from .eyes import ring_faces
from .fields import Floats, ramp
from .shape import bent, gradient, head_distance, in_blocks, unit
from .surface import GRADIENT_STEP, Mesh, split_faces, vertex_normals

CUT_HALF_WIDTH = 2.38  # from the middle line to the end of the cut
CUT_BACK = 6.0  # z behind which no skin is cut
SNAP = 0.045  # vertices nearer to the line in height move onto it
# Half the gap between the lips. Without a gap, programs that weld equal positions close the mouth.
HALF_GAP = 0.0002
# Rings of the cavity behind the upper and the lower lip: (distance behind the lips, height above
# or below the line), in the middle of the mouth. They form the inside of the lips, the teeth, the
# palate and the tongue.
UPPER_RINGS = (
    (0.08, 0.020),
    (0.26, 0.20),
    (0.32, 0.58),
    (0.40, 0.52),  # gums
    (0.45, -0.26),  # edges of the teeth
    (0.53, -0.24),
    (0.75, 0.45),
    (1.60, 0.80),  # palate
    (3.20, 0.75),
)
LOWER_RINGS = (
    (0.08, 0.020),
    (0.26, 0.22),
    (0.34, 0.60),
    (0.46, 0.52),
    (0.58, 0.10),
    (0.66, 0.12),
    (0.85, 0.45),
    (1.50, 0.16),  # tip of the tongue
    (3.00, 0.05),
)
END = (4.6, 0.1)  # distance and height below the line
LIPS_RING, GUMS_RING, TEETH_RING, TONGUE_RING = 1, 4, 5, 8  # counted from the lips, which are 0
# Radius of each ring in the chart. The lips and the teeth have as many texels as the skin around.
CHART_RADII = (1.0, 0.985, 0.955, 0.885, 0.845, 0.72, 0.68, 0.48, 0.28, 0.13, 0.0)
CHART_END = 1.02  # radius of the texels of the cavity
ARCH_WIDTH = 0.82  # of the teeth, relative to the mouth
LIP_ROUNDING = 0.7  # weight of the skin in the normals of the first ring
CORNER_DEPTH = (0.25, 1.7)  # depth at the corners, relative to the middle: of the lips, the teeth


@dataclass(frozen=True)
class Mouth:
    """The vertices of the cut and of the cavity, as rows of the mesh.

    The loop runs along the upper lip from the left corner to the right one, and back along the
    lower lip. Ring 0 of the cavity has the same positions.

    loop : vertices of the lips, (N,)
    cavity : vertices of the rings, and the one that closes the end, (rings * N + 1,)
    """

    loop: NDArray[np.int64]
    cavity: NDArray[np.int64]

    @property
    def ring(self) -> Floats:
        """The ring of each cavity vertex, counted from the lips."""
        return np.asarray(np.arange(len(self.cavity)) // len(self.loop), np.float32)

    @property
    def anchors(self) -> NDArray[np.int64]:
        """The vertex of the lips in front of each cavity vertex; of the end, any one."""
        return np.resize(self.loop, len(self.cavity))

    def chart(self) -> Floats:
        """Return a place in a disc of radius 1 for each cavity vertex; the lips are its border."""
        angle = 2 * np.pi * np.arange(len(self.cavity)) / len(self.loop)
        radius = np.array(CHART_RADII)[self.ring.astype(int)]
        return np.asarray(np.stack([np.cos(angle), np.sin(angle)], 1) * radius[:, None], np.float32)


def above_line(points: Floats) -> tuple[Floats, Floats]:
    """Return the heights of points (N, 3) above the mouth's line, and their side coordinates."""
    x, y, _ = bent(points)
    side = np.abs(x)
    return np.asarray(y - landmarks.mouth_line(side), np.float32), np.asarray(x, np.float32)


def _aligned(mesh: Mesh) -> tuple[Mesh, Floats]:
    """Move vertices close to the line onto it; return all heights above the line, 0 on it."""
    height, x = above_line(mesh.positions)
    near = (
        (np.abs(height) < SNAP) & (np.abs(x) < CUT_HALF_WIDTH) & (mesh.positions[:, 2] > CUT_BACK)
    )
    points = mesh.positions[near]
    for _ in range(4):
        points[:, 1] -= above_line(points)[0]
        slope = gradient(head_distance, points, GRADIENT_STEP)[:, 2]
        points[:, 2] -= in_blocks(head_distance, points) / np.maximum(slope, 0.3)
    positions, normals = mesh.positions.copy(), mesh.normals.copy()
    positions[near] = points
    normals[near] = unit(gradient(head_distance, points, GRADIENT_STEP))
    height[near] = 0
    return Mesh(positions, normals, mesh.faces), height


def _divided(mesh: Mesh, height: Floats) -> tuple[Mesh, Floats]:
    """Split the edges that cross the line between the ends of the cut."""
    sides = np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], 2).reshape(-1, 2)
    edges, edge_of_side = np.unique(np.sort(sides, 1), axis=0, return_inverse=True)
    ends = height[edges]
    crossing = (ends.prod(1) < 0) & (mesh.positions[edges][:, :, 2] > CUT_BACK).all(1)
    rows = np.flatnonzero(crossing)
    share = (ends[rows, 0] / (ends[rows, 0] - ends[rows, 1]))[:, None]
    a, b = edges[rows].T
    points = mesh.positions[a] * (1 - share) + mesh.positions[b] * share
    inside = np.abs(above_line(points)[1]) < CUT_HALF_WIDTH
    crossing[rows[~inside]] = False
    normals = unit(mesh.normals[a] * (1 - share) + mesh.normals[b] * share)[inside]
    middles = np.where(crossing, len(mesh.positions) - 1 + np.cumsum(crossing), -1)
    return (
        Mesh(
            np.concatenate([mesh.positions, points[inside]]).astype(np.float32),
            np.concatenate([mesh.normals, normals]),
            split_faces(mesh.faces, middles[edge_of_side].reshape(-1, 3)),
        ),
        np.concatenate([height, np.zeros(inside.sum(), np.float32)]),
    )


def _path(mesh: Mesh, height: Floats) -> NDArray[np.int64]:
    """Return the vertices on the line from the left corner to the right corner."""
    on_line = (height == 0) & (mesh.positions[:, 2] > CUT_BACK)
    path = np.flatnonzero(on_line)
    path = path[np.argsort(-mesh.positions[path, 0])]
    sides = np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], 2).reshape(-1, 2)
    known = {tuple(side) for side in sides[on_line[sides].all(1)].tolist()}
    steps = zip(path[:-1].tolist(), path[1:].tolist(), strict=True)
    if on_line[mesh.faces].all(1).any() or any((a, b) not in known for a, b in steps):
        raise ValueError("the line between the lips is no path of edges of the mesh")
    return path


def _rings(line: Floats, upper: NDArray[np.bool_]) -> Floats:
    """Return the rings of the cavity behind a loop (N, 3), and its end, (rings * N + 1, 3)."""
    across = line[:, 0] / np.abs(line[:, 0]).max()
    taper = np.sqrt(np.clip(1 - across**2, 0, 1))
    level = line[:, 1].mean()
    rings = [line]
    for number, (above, below) in enumerate(zip(UPPER_RINGS, LOWER_RINGS, strict=True), 1):
        inner = ramp(LIPS_RING, GUMS_RING, np.array(number))
        depth, height = np.where(upper, *np.array([above, below])[:, :, None])
        overbite = np.where(height < 0, ramp(0.95, 0.65, np.abs(across)), 1)  # none at the corners
        at_corner = CORNER_DEPTH[0] + (CORNER_DEPTH[1] - CORNER_DEPTH[0]) * inner
        y = (
            line[:, 1]
            + (level - line[:, 1]) * inner
            + np.where(upper, 1, -1) * height * overbite * taper
        )
        z = line[:, 2] - depth * (at_corner + (1 - at_corner) * taper)
        rings.append(np.stack([line[:, 0] * (1 + (ARCH_WIDTH - 1) * inner), y, z], 1))
    end = np.array([[0, level - END[1], line[:, 2].max() - END[0]]])
    return np.concatenate([*rings, end]).astype(np.float32)


def with_mouth(mesh: Mesh) -> tuple[Mesh, Mouth]:
    """Return the head with a cut between the lips and a cavity behind it.

    Raises
    ------
    ValueError : the line between the lips meets the mesh in more than one path
    """
    mesh, height = _divided(*_aligned(mesh))
    path = _path(mesh, height)
    inner = path[1:-1]
    first = len(mesh.positions)
    lower = first + np.arange(len(inner))
    positions = np.concatenate([mesh.positions, mesh.positions[inner]])
    positions[inner, 1] += HALF_GAP
    positions[lower, 1] -= HALF_GAP
    normals = np.concatenate([mesh.normals, mesh.normals[inner]])
    copies = np.arange(len(positions))
    copies[inner] = lower
    below = height[mesh.faces].sum(1) < 0
    faces = np.where(below[:, None], copies[mesh.faces], mesh.faces)

    loop = np.concatenate([path, lower[::-1]])
    line = positions[loop]
    rings = _rings(line, np.arange(len(loop)) < len(path))
    start, count, number = len(positions), len(loop), len(UPPER_RINGS)
    last = number * count + np.arange(count)
    fan = np.stack([last, np.roll(last, -1), np.full(count, len(rings) - 1)], 1)
    cavity = np.concatenate([ring_faces(number + 1, count)[:, ::-1], fan]).astype(np.int32)
    wall = vertex_normals(rings, cavity)
    wall[:count] = unit(wall[:count] + LIP_ROUNDING * normals[loop])
    for corner, inward in ((0, -1), (len(path) - 1, 1)):  # where upper and lower lip cancel out
        wall[corner : (GUMS_RING + 1) * count : count] = (inward, 0, 0)
    return (
        Mesh(
            np.concatenate([positions, rings]),
            np.concatenate([normals, wall]),
            np.concatenate([faces, start + cavity]).astype(np.int32),
        ),
        Mouth(loop, start + np.arange(len(rings))),
    )


@dataclass(frozen=True)
class Lining:
    """Places of points in the cavity.

    inside : whether the point is in the cavity; the other values are those of points inside
    upper : whether the point is behind the upper lip
    ring : number of rings from the lips, with fractions
    side : 0 on the middle line, 1 at the corners
    """

    inside: NDArray[np.bool_]
    upper: NDArray[np.bool_]
    ring: Floats
    side: Floats


def find_lining(flat: Floats) -> Lining:
    """Return the places in the cavity of points (N, 2) of :meth:`Mouth.chart`."""
    inside = np.linalg.norm(flat, axis=1) < CHART_END
    x, y = flat[inside].T
    ring = np.interp(-np.hypot(x, y), -np.array(CHART_RADII), np.arange(len(CHART_RADII)))
    side = np.abs(1 - 2 / np.pi * np.abs(np.arctan2(y, x)))
    return Lining(inside, y > 0, ring.astype(np.float32), side.astype(np.float32))
