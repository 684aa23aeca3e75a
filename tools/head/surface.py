"""The implicit head as a triangle mesh with normals, without texture coordinates."""

# mypy: disable-error-code="no-untyped-call"
# scikit-image has no type annotations.

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from .fields import Floats
from .shape import gradient, head_distance, in_blocks, unit

Faces = NDArray[np.int32]

NECK_CUT = -16.4  # height of the neck's lower end, cm

# Spacing of the grid along each axis: (place, cell size there), in cm. It is fine at the features
# of the face and coarse at the back of the head. The side axis is mirrored.
SIDE_SPACING = (
    (0, 0.20),
    (2, 0.21),
    (3, 0.23),
    (5, 0.32),
    (6.3, 0.20),
    (9, 0.20),
    (12, 1.0),
    (17, 1.3),
)
HEIGHT_SPACING = (
    (NECK_CUT, 0.85),
    (-13, 0.70),
    (-11.5, 0.36),
    (-8.5, 0.23),
    (-6.6, 0.20),
    (-4.8, 0.17),
    (-3.5, 0.20),
    (-2, 0.22),
    (0.9, 0.20),
    (3, 0.46),
    (7, 0.70),
    (12.6, 0.90),
)
DEPTH_SPACING = (
    (-11.5, 0.90),
    (-5, 0.70),
    (-3.4, 0.20),
    (0.8, 0.20),
    (5, 0.33),
    (7.5, 0.22),
    (9, 0.19),
    (12.2, 0.21),
)
COARSE_STRIDE = 4  # the first pass evaluates the distance at every fourth grid point per axis
NEAR_SURFACE = 1.3  # the second pass evaluates all grid points below this coarse distance, cm
RELAXING_STEPS = 12
SHARPEST_TURN = 26.0  # largest angle between the normals of an edge that is not split, degrees
SHORTEST_EDGE = 0.10  # shorter edges are not split, cm
REFINEMENTS = 2
REFINED_RELAXING_STEPS = 2
SETTLING_STEPS = 3  # final steps that only move vertices onto the surface
GRADIENT_STEP = 0.05  # cm; about a quarter of a cell, so that edges of the ear get one normal


@dataclass(frozen=True)
class Mesh:
    """Triangles with outward normals, in cm; faces are counter-clockwise seen from outside."""

    positions: Floats
    normals: Floats
    faces: Faces


def _grid_axis(spacing: tuple[tuple[float, float], ...]) -> Floats:
    places, steps = np.transpose(spacing)
    axis = [places[0]]
    while axis[-1] < places[-1]:
        axis.append(axis[-1] + np.interp(axis[-1], places, steps))
    return np.array(axis, np.float32)


def _grid_points(axes: list[Floats]) -> Floats:
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _extract() -> tuple[Floats, Faces]:
    """Extract the surface by marching cubes on the non-uniform grid.

    Returns only the largest connected component.
    """
    half = _grid_axis(SIDE_SPACING)
    axes = [
        np.concatenate([-half[:0:-1], half]),
        _grid_axis(HEIGHT_SPACING),
        _grid_axis(DEPTH_SPACING),
    ]
    picked = [np.unique(np.r_[0 : len(axis) : COARSE_STRIDE, len(axis) - 1]) for axis in axes]
    coarse_axes = [axis[rows] for axis, rows in zip(axes, picked, strict=True)]
    coarse = in_blocks(head_distance, _grid_points(coarse_axes))
    coarse = coarse.reshape([len(axis) for axis in coarse_axes])
    points = _grid_points(axes)
    values = RegularGridInterpolator(coarse_axes, coarse)(points).astype(np.float32)
    near = np.abs(values) < NEAR_SURFACE
    values[near] = in_blocks(head_distance, points[near])
    volume = values.reshape([len(axis) for axis in axes])

    found, faces, _, _ = marching_cubes(volume, 0.0, allow_degenerate=False)
    positions = np.stack(
        [np.interp(found[:, i], np.arange(len(axes[i])), axes[i]) for i in range(3)], 1
    )
    _, piece = connected_components(_adjacency(faces, len(positions)), directed=False)
    largest = np.bincount(piece).argmax()
    kept = piece == largest
    renumbered = np.cumsum(kept) - 1
    return positions[kept].astype(np.float32), renumbered[faces[kept[faces[:, 0]]]].astype(np.int32)


def _adjacency(faces: Faces, count: int) -> csr_matrix:
    """Return the symmetric matrix with a 1 for each pair of vertices that share an edge."""
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both_ways = np.vstack([edges, edges[:, ::-1]])
    matrix = csr_matrix((np.ones(len(both_ways)), both_ways.T), shape=(count, count))
    matrix.data[:] = 1  # an edge of two faces occurs twice
    return matrix


def _relax(positions: Floats, faces: Faces, steps: int) -> Floats:
    """Move vertices along the surface to equalise triangles, and project them back onto it."""
    neighbours = _adjacency(faces, len(positions))
    counts = np.asarray(neighbours.sum(1)).reshape(-1, 1)
    on_cut = positions[:, 1] <= np.float32(NECK_CUT)
    for step in range(steps + SETTLING_STEPS):
        slope = gradient(head_distance, positions, GRADIENT_STEP)
        distance = in_blocks(head_distance, positions)
        # One step of Newton's method. Without it, smoothing would erode thin rims.
        back = np.clip(distance / np.maximum((slope * slope).sum(1), 0.05), -0.15, 0.15)
        shift = -back[:, None] * slope
        if step < steps:
            slide = (neighbours @ positions) / counts - positions
            normals = unit(slope)
            slide -= (slide * normals).sum(1, keepdims=True) * normals
            slide[on_cut, 1] = 0
            shift += 0.5 * slide
        positions = (positions + shift).astype(np.float32)
    positions[on_cut, 1] = NECK_CUT
    return np.asarray(positions, np.float32)


def _refine(positions: Floats, faces: Faces) -> tuple[Floats, Faces]:
    """Split edges whose normals differ by more than ``SHARPEST_TURN``.

    Edges up to ``SHORTEST_EDGE`` are not split, because some folds are too fine for the mesh.
    """
    normals = unit(gradient(head_distance, positions, GRADIENT_STEP))
    sides = np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2)
    edges, edge_of_side = np.unique(np.sort(sides, 1), axis=0, return_inverse=True)
    turned = normals[edges].prod(1).sum(1) < np.cos(np.radians(SHARPEST_TURN))
    turned &= np.linalg.norm(np.subtract(*positions[edges.T]), axis=1) > SHORTEST_EDGE
    middles = np.where(turned, len(positions) - 1 + np.cumsum(turned), -1)
    positions = np.concatenate([positions, positions[edges[turned]].mean(1)])
    return positions, split_faces(faces, middles[edge_of_side].reshape(-1, 3))


def split_faces(faces: Faces, middle: NDArray[np.int64]) -> Faces:
    """Split faces (N, 3) at vertices on their edges.

    ``middle`` (N, 3) holds the vertex on the edge from each corner to the next one, or -1. A face
    becomes two, three or four faces if one, two or three of its edges are split.
    """
    halved = middle >= 0
    count = halved.sum(1)
    # Rotate the corners of each face so that its split edges come first.
    first = np.where(count == 1, halved.argmax(1), (halved.argmin(1) + 1) % 3)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, 1).T
    ab, bc, ca = np.take_along_axis(middle, order, 1).T
    parts = (
        (count == 0, ((a, b, c),)),
        (count == 1, ((a, ab, c), (ab, b, c))),
        (count == 2, ((ab, b, bc), (a, ab, bc), (a, bc, c))),
        (count == 3, ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))),
    )
    found = [np.stack(part, 1)[where] for where, group in parts for part in group]
    return np.concatenate(found).astype(np.int32)


def face_normals(positions: Floats, faces: Faces) -> Floats:
    """Return the face normals; their lengths are twice the areas."""
    corners = positions[faces]
    return np.asarray(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), np.float32
    )


def vertex_normals(positions: Floats, faces: Faces) -> Floats:
    """Return the means of the normals of the faces around each vertex, weighted by their areas."""
    total = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(total, faces[:, corner], face_normals(positions, faces))
    return unit(total)


def build_mesh() -> Mesh:
    """Return the head as a mesh that is open at the lower end of the neck."""
    positions, faces = _extract()
    positions = _relax(positions, faces, RELAXING_STEPS)
    for _ in range(REFINEMENTS):
        positions, faces = _refine(positions, faces)
        positions = _relax(positions, faces, REFINED_RELAXING_STEPS)
    normals = unit(gradient(head_distance, positions, GRADIENT_STEP))
    if (face_normals(positions, faces) * normals[faces[:, 0]]).sum() < 0:
        faces = faces[:, ::-1]
    return Mesh(positions, normals, np.ascontiguousarray(faces))
