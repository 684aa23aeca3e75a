"""Texture coordinates of the mesh, and the surface point of every texel.

Most of the head is in one chart, unrolled like a cylinder, with a higher resolution at the face.
Parts that would overlap in this chart are in small charts in a strip along the bottom of the
texture: the skull behind the ears, the backs of the ears, and the inside of the nostrils. Here v
points up in the image, as in OpenGL; ``glb`` flips it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from .fields import Floats, ramp
from .lids import Tucked
from .mouth import Mouth
from .shape import belongs_to_ear
from .surface import Faces, Mesh, face_normals

# Relative texel density around the head by the angle from straight ahead (degrees), and along its
# height by the unrolled height (cm).
DENSITY_FRONT, DENSITY_BACK = 2.30, 0.75
ANGLE_FRONT, ANGLE_BACK = 45.0, 122.0
DENSITY_FACE, DENSITY_ENDS = 2.10, 0.55
UNROLLED_LOWEST, UNROLLED_HIGHEST = -21.2, 14.8
UNROLLED_FACE = ((-18.5, -15.8), (5.5, 2.0))  # the density fades in from below, and from above

DOME_BASE = 2.6  # above this height, the skull is unrolled by angle, cm
DOME_RADIUS = 9.3
UNDERCUT_SHEAR = 0.38  # fraction of the depth added to the height, to show nose and chin from below
NECK_AXIS_SHIFT = -3.2  # z of the neck's axis; the axis of the head has z = 0
STRIP_HEIGHT = 0.075  # height of the strip of small charts, as a fraction of the texture

GRAZING = 8e-5  # faces with less texture area per surface area (1/cm2) count as edge-on
POCKET_FILL = 0.90  # fraction of its slot that a small chart fills; the rest is a gap
HIDDEN_DEPTH = 0.25  # faces deeper than this below the outermost surface get a small chart, cm
MOUTH_CENTRE = np.array([2 / 9, 0.5 * STRIP_HEIGHT], np.float32)  # of the cavity's chart
MOUTH_RADIUS = 0.033
PROBE_SIZE = 512  # width in texels of the image that finds hidden faces


@dataclass(frozen=True)
class Pocket:
    """A small chart: hidden faces in a box with similar normals, projected along one direction."""

    looks: tuple[int, int, int]  # approximate direction of the normals
    right: tuple[int, int, int]  # direction of increasing u
    up: tuple[int, int, int]  # direction of increasing v; right x up = looks
    lower: tuple[float, float, float]  # corners of the box, cm
    upper: tuple[float, float, float]
    on_ear: bool  # whether its faces belong to an ear


POCKETS = (
    # Skull behind the left ear and the right ear, then the backs of these ears.
    Pocket((1, 0, 0), (0, 0, -1), (0, 1, 0), (4.5, -6.0, -5.5), (12, 3.0, 2.5), False),
    Pocket((-1, 0, 0), (0, 0, 1), (0, 1, 0), (-12, -6.0, -5.5), (-4.5, 3.0, 2.5), False),
    Pocket((-1, 0, 0), (0, 0, 1), (0, 1, 0), (4.5, -6.0, -5.5), (12, 3.0, 2.5), True),
    Pocket((1, 0, 0), (0, 0, -1), (0, 1, 0), (-12, -6.0, -5.5), (-4.5, 3.0, 2.5), True),
    # Rear sides of the bowls of the ears, which face back and slightly outward.
    Pocket((0, 0, -1), (-1, 0, 0), (0, 1, 0), (5.0, -6.0, -5.5), (7.7, 3.0, -0.8), True),
    Pocket((0, 0, -1), (-1, 0, 0), (0, 1, 0), (-7.7, -6.0, -5.5), (-5.0, 3.0, -0.8), True),
    # Walls of the bowls that face forward and slightly inward.
    Pocket((0, 0, 1), (1, 0, 0), (0, 1, 0), (5.0, -6.0, -5.5), (12, 3.0, 2.5), True),
    Pocket((0, 0, 1), (1, 0, 0), (0, 1, 0), (-12, -6.0, -5.5), (-5.0, 3.0, 2.5), True),
    # Inside of the nostrils, seen from below.
    Pocket((0, -1, 0), (1, 0, 0), (0, 0, 1), (-2.0, -5.5, 8.0), (2.0, -3.0, 11.5), False),
)


@dataclass(frozen=True)
class Unwrapped:
    """A mesh with texture coordinates; vertices on seams are duplicated."""

    mesh: Mesh
    coordinates: Floats
    source: NDArray[np.int32]  # the vertex of the given mesh, for each vertex


@dataclass(frozen=True)
class Texels:
    """Surface points under the covered texels of a square texture; row 0 is v = 0."""

    size: int
    positions: Floats  # (N, 3), cm
    normals: Floats  # (N, 3)
    covered: NDArray[np.bool_]  # (size, size)
    source: NDArray[np.int32]  # (size, size): the row of the covered texel nearest to each texel

    def image(self, values: Floats) -> Floats:
        """Return an image of the covered texels' values; other texels copy the nearest one."""
        return np.asarray(values[self.source], np.float32)

    def differences(self, values: Floats) -> tuple[Floats, Floats]:
        """Return the change of values per texel along u and along v, at the covered texels."""
        image = self.image(values)
        along_u = (np.roll(image, -1, 1) - np.roll(image, 1, 1)) / 2
        along_v = np.gradient(image, axis=0)
        return np.asarray(along_u[self.covered]), np.asarray(along_v[self.covered])


def _running_share(density: Floats) -> Floats:
    total = np.cumsum(density)
    return np.asarray((total - total[0]) / (total[-1] - total[0]))


def _axis_distance(positions: Floats) -> tuple[Floats, Floats]:
    """Return the angle around the axis of head and neck, and the distance from it."""
    x, y, z = positions.T
    z = z - NECK_AXIS_SHIFT * ramp(-7, -12.5, y)
    return np.asarray(np.arctan2(x, z), np.float32), np.asarray(np.hypot(x, z), np.float32)


def _unroll(positions: Floats) -> Floats:
    """Return coordinates in the main chart."""
    angles = np.linspace(-np.pi, np.pi, 2001, dtype=np.float32)
    facing = ramp(ANGLE_BACK, ANGLE_FRONT, np.abs(np.degrees(angles)))
    around = _running_share(DENSITY_BACK + (DENSITY_FRONT - DENSITY_BACK) * facing)
    heights = np.linspace(UNROLLED_LOWEST, UNROLLED_HIGHEST, 2001, dtype=np.float32)
    on_face = ramp(*UNROLLED_FACE[0], heights) * ramp(*UNROLLED_FACE[1], heights)
    upwards = _running_share(DENSITY_ENDS + (DENSITY_FACE - DENSITY_ENDS) * on_face)

    angle, distance = _axis_distance(positions)
    above = positions[:, 1] - DOME_BASE
    shear = UNDERCUT_SHEAR * ramp(DOME_BASE, -4, positions[:, 1])
    height = np.where(
        above >= 0,
        DOME_RADIUS * np.arctan2(above, distance),
        above + shear * (distance - 9.0),
    )
    u = np.interp(angle, angles, around)
    v = STRIP_HEIGHT + (1 - STRIP_HEIGHT) * np.interp(height, heights, upwards)
    return np.stack([u, v], 1).astype(np.float32)


def _project(pocket: Pocket, slot: int, positions: Floats) -> Floats:
    """Return coordinates in a small chart that fills its slot in the strip."""
    flat = positions @ np.transpose([pocket.right, pocket.up])
    lower, upper = flat.min(0), flat.max(0)
    place = np.array([1 / len(POCKETS), STRIP_HEIGHT])
    scale = POCKET_FILL * (place / (upper - lower)).min()
    middle = np.array([slot + 0.5, 0.5]) * place
    return np.asarray(middle + scale * (flat - (lower + upper) / 2), np.float32)


def _split(
    faces: Faces, chosen: NDArray[np.bool_], source: NDArray[np.int32]
) -> tuple[Faces, NDArray[np.int32]]:
    """Duplicate the vertices of the chosen faces; ``source`` is the original of each vertex."""
    vertices = np.unique(faces[chosen])
    renumbered = np.arange(len(source), dtype=np.int32)
    renumbered[vertices] = len(source) + np.arange(len(vertices))
    faces = faces.copy()
    faces[chosen] = renumbered[faces[chosen]]
    return faces, np.concatenate([source, source[vertices]])


def _hidden(mesh: Mesh, coordinates: Floats) -> NDArray[np.bool_]:
    """Return the faces that are covered by others in the main chart, reversed or nearly edge-on."""
    corners = coordinates[mesh.faces]
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    in_chart = edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0]
    on_head = np.linalg.norm(face_normals(mesh.positions, mesh.faces), axis=1)
    turned = np.asarray(in_chart < GRAZING * on_head)
    distance = _axis_distance(mesh.positions)[1]
    texels, rows, shares = _rasterise(coordinates, mesh.faces, distance, PROBE_SIZE)
    outermost = np.zeros(PROBE_SIZE * PROBE_SIZE, np.float32)
    outermost[texels] = (distance[mesh.faces[rows]] * shares).sum(1)
    # Test each face at its centre and near its corners.
    hidden = turned
    middle = np.full(3, 1 / 3)
    for shares_at in (middle, *(0.25 * middle + 0.75 * np.eye(3))):
        column, row = (
            np.floor(np.tensordot(corners, shares_at, (1, 0)) * PROBE_SIZE).astype(int) % PROBE_SIZE
        ).T
        depth = outermost[row * PROBE_SIZE + column] - distance[mesh.faces] @ shares_at
        hidden = hidden | (depth > HIDDEN_DEPTH)
    return hidden


def unwrap(mesh: Mesh, mouth: Mouth, tucked: Tucked | None = None) -> Unwrapped:
    """Assign texture coordinates to the mesh; ``tucked`` vertices lie between others in the chart.

    These are the margins and backs of the lids, which fill the openings of the eyes. The cavity of
    the ``mouth`` is a disc between two small charts.
    """
    coordinates = _unroll(mesh.positions)
    coordinates[mouth.cavity] = MOUTH_CENTRE + MOUTH_RADIUS * mouth.chart()
    if tucked is not None:
        anchors = coordinates[tucked.anchors]
        coordinates[tucked.vertices] = (anchors * tucked.weights[:, :, None]).sum(1)
    # Faces across the back of the head get u above 1 on one side, because the texture repeats.
    faces = mesh.faces
    span = np.ptp(coordinates[faces][:, :, 0], axis=1)
    source = np.arange(len(mesh.positions), dtype=np.int32)
    across = span > 0.5
    faces, source = _split(faces, across, source)
    doubled = np.arange(len(source)) >= len(mesh.positions)
    coordinates = coordinates[source]
    coordinates[doubled & (coordinates[:, 0] < 0.5), 0] += 1

    rolled = Mesh(mesh.positions[source], mesh.normals[source], faces)
    hidden = _hidden(rolled, coordinates)
    looks = face_normals(rolled.positions, faces)
    centre = rolled.positions[faces].mean(1)
    on_ear = belongs_to_ear(centre)
    for slot, pocket in enumerate(POCKETS):
        inside = ((centre > pocket.lower) & (centre < pocket.upper)).all(1)
        chosen = hidden & inside & (on_ear == pocket.on_ear) & (looks @ np.array(pocket.looks) > 0)
        first = len(source)
        faces, source = _split(faces, chosen, source)
        pocketed = _project(pocket, slot, mesh.positions[source[first:]])
        coordinates = np.concatenate([coordinates, pocketed])
        hidden = hidden & ~chosen

    used, faces_flat = np.unique(faces, return_inverse=True)
    source = source[used]
    laid_out = Mesh(
        mesh.positions[source],
        mesh.normals[source],
        faces_flat.reshape(faces.shape).astype(np.int32),
    )
    return Unwrapped(laid_out, coordinates[used], source)


def _rasterise(
    coordinates: Floats, faces: Faces, height: Floats, size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return texel, face and barycentric weights of every texel centre inside every face.

    The result is sorted by the faces' ``height``, so that the top face of a texel is written last.
    Texels beyond u = 1 wrap around.
    """
    order = np.argsort(height[faces].mean(1), kind="stable")
    corners = coordinates[faces[order]].astype(np.float64) * size - 0.5
    low = np.ceil(corners.min(1) - 1e-6).astype(np.int64)
    counts = np.maximum(np.floor(corners.max(1) + 1e-6).astype(np.int64) - low + 1, 0)
    per_face = counts[:, 0] * counts[:, 1]
    face = np.repeat(np.arange(len(faces)), per_face)
    within = np.arange(len(face)) - np.repeat(np.cumsum(per_face) - per_face, per_face)
    column = low[face, 0] + within % counts[face, 0]
    line = low[face, 1] + within // counts[face, 0]

    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    scale = 1 / np.where(area == 0, np.inf, area)[face]
    to_c = (column - c[face, 0], line - c[face, 1])
    share_a = ((b - c)[face, 1] * to_c[0] + (c - b)[face, 0] * to_c[1]) * scale
    share_b = ((c - a)[face, 1] * to_c[0] + (a - c)[face, 0] * to_c[1]) * scale
    shares = np.stack([share_a, share_b, 1 - share_a - share_b], 1)
    inside = (shares >= -1e-6).all(1) & (line >= 0) & (line < size) & (area != 0)[face]
    texel = line[inside] * size + column[inside] % size
    return texel, order[face[inside]], shares[inside].astype(np.float32)


def find_texels(unwrapped: Unwrapped, size: int) -> Texels:
    """Return the surface points of the covered texels of a square texture ``size`` texels wide."""
    mesh = unwrapped.mesh
    height = _axis_distance(mesh.positions)[1]
    texel, face, shares = _rasterise(unwrapped.coordinates, mesh.faces, height, size)
    writer = np.full(size * size, -1, np.int64)
    writer[texel] = np.arange(len(texel))
    covered = (writer >= 0).reshape(size, size)
    winner = writer[writer >= 0]
    corners, shares = mesh.faces[face[winner]], shares[winner, :, None]
    positions = (mesh.positions[corners] * shares).sum(1)
    normals = (mesh.normals[corners] * shares).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    rows = np.zeros((size, size), np.int32)
    rows[covered] = np.arange(len(winner))
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return Texels(size, positions, normals, covered, rows[nearest[0], nearest[1]])
