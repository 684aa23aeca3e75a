"""Registration: the rigid motion of a scan into the space of another scan of the same person.

1. The faces that :func:`facerender.find_face` finds on both meshes give the first motion.
2. The reference's upper face (forehead, eyes, cheekbones) is divided into cells of about 1 mm. Each
   has the mean point and the mean normal of the front surface: a plane with little noise, whatever
   the triangles are. Nose, mouth and chin have no cells.
3. Points on the mesh are paired with the cells in front of or behind which they lie. Gauss-Newton
   steps reduce the distances of the points from the planes. In each step, the pairs with the
   smallest distances count, so that swellings have little effect.

References: Chen and Medioni (1992), "Object modelling by registration of multiple range images":
distances from planes. Rusinkiewicz and Levoy (2001), "Efficient variants of the ICP algorithm":
pairs by projection. Chetverikov et al. (2002), "The trimmed iterative closest point algorithm"."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError
from facerender.mesh.face import Surface
from facerender.mesh.framing import framing_of
from facerender.mesh.geometry import Geometry, MeshPose
from facerender.mesh.hints import millimetres_of
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Face, Float, Part
from facerender.mesh.rig import local_matrix
from facerender.values.vectors import transformed, unit

# In distances between the eyes, from their middle: half the width of the upper face, its lowest and
# highest point, and half the width and the highest point of the nose.
_WIDTH, _LOW, _HIGH, _NOSE_WIDTH, _NOSE_HIGH = 1.1, -0.75, 1.05, 0.33, -0.12
_CELLS = 64  # per distance between the eyes
_COLUMNS, _ROWS = int(2.0 * _WIDTH * _CELLS) + 1, int((_HIGH - _LOW) * _CELLS) + 1
_POINTS = 200_000, 50_000  # near the upper face, on the reference and on the mesh
_LAYER = 0.1  # depth of the front surface within a cell, in distances between the eyes
_STEEP = 0.3  # least cosine between the normal of a cell and the direction of the face
_FAR = 0.2  # largest distance of a pair; the faces are found with errors of about half of it
_COUNTED = 0.6  # share of the pairs that count
_OVERLAP = 0.3  # least share of the cells that have pairs
_STEPS, _SMALL = 60, 1e-5  # most steps; length of the last, in radians and eye distances
_LARGER = 1.8  # largest ratio of two distances between the eyes in one unit, as they are found


@dataclass(frozen=True, eq=False)
class Registration:
    """A registered mesh, as :func:`facerender.register` returns it.

    mesh : the mesh in the space of the reference
    residual : median distance of the mesh's upper face from the reference
    unit : ``"mm"``, or ``"units"`` for a residual in mesh units, whose length is not known
    matrix : (4, 4), the motion, for column vectors
    """

    mesh: Mesh
    residual: float
    unit: str
    matrix: Float

    def __repr__(self) -> str:
        return f"<Registration of {self.mesh.name!r}, residual {self.residual:.2g} {self.unit}>"


def register(mesh: Mesh, reference: Mesh) -> Registration:
    """Move a scan rigidly into the space of another scan of the same person.

    The upper face counts: forehead, eyes and cheekbones. It may change in up to 40 % of its area;
    nose, mouth and chin may change. Axes and positions of the two meshes may differ. Materials,
    shapes, clips and the pose are kept. See :mod:`facerender.mesh.registration` for the method.

    Parameters
    ----------
    mesh, reference : from :func:`facerender.load_mesh`, in one unit; the reference poses count.
        InputError if a mesh has no face, the sizes of the faces differ, or the faces do not overlap
    """
    face, goal = _face_of(mesh), _face_of(reference)
    if not 1.0 / _LARGER < face.eye_distance / goal.eye_distance < _LARGER:
        sizes = f"{face.eye_distance:.3g} and {goal.eye_distance:.3g} units apart"
        problem = f"the eyes of {mesh.name} and {reference.name} are {sizes}"
        raise InputError(f"{problem}: convert the meshes to one unit before registration")
    start, frame = _to_eyes(face, goal.eye_distance), _to_eyes(goal, goal.eye_distance)
    cells = _cells(*_sampled(reference, frame, _POINTS[0]))
    if (fit := _motion(*_sampled(mesh, start, _POINTS[1]), cells)) is None:
        problem = f"the upper faces of {mesh.name} and {reference.name} do not overlap"
        raise InputError(f"{problem}: both scans need forehead, eyes and cheekbones")
    matrix = np.linalg.inv(frame) @ fit[0] @ start
    probable, certain = millimetres_of(reference) or (None, False)
    length = reference.millimetres or mesh.millimetres or (probable if certain else None)
    residual, name = fit[1] * goal.eye_distance * (length or 1.0), "mm" if length else "units"
    return Registration(_moved(mesh, matrix), residual, name, matrix)


def _face_of(mesh: Mesh) -> Face:
    if (face := mesh.geometry.framing.face) is None:
        raise InputError(f"no face was found on {mesh.name}: registration needs one on both meshes")
    return face


def _to_eyes(face: Face, size: float) -> Float:
    """Return the matrix (4, 4) to a face's axes, with the middle of the eyes at 0, in ``size``."""
    linear = face.axes / size
    return np.vstack([np.c_[linear, -linear @ face.eyes.mean(axis=0)], np.eye(4)[3]])


def _sampled(mesh: Mesh, matrix: Float, count: int) -> tuple[Float, Float]:
    """Return points and unit normals, (3, count), of the skin near the upper face."""
    parts = [mesh.geometry.parts[i] for i in mesh.skin]
    corners = np.concatenate([transformed(p.positions, None, matrix)[0][p.faces] for p in parts])
    near = (np.abs(corners.mean(axis=1) - (0.0, 0.15, 0.0)) < 1.4).all(axis=1)
    surface = Surface(corners[near | (not near.any())])  # points far away get no pairs
    points, triangles = surface.sampled(count, np.arange(len(surface.areas)))
    return points, unit(surface.normals[triangles]).T


def _indices(points: Float) -> NDArray[np.int64]:
    """Return the index of the cell of each point (3, N); the last index is outside all cells."""
    x, y, _ = points
    inside = (np.abs(x) < _WIDTH) & (y > _LOW) & (y < _HIGH)
    inside &= (np.abs(x) > _NOSE_WIDTH) | (y > _NOSE_HIGH)
    column, row = (((a + b) * _CELLS).astype(np.int64) for a, b in ((x, _WIDTH), (y, -_LOW)))
    return np.where(inside, row * _COLUMNS + column, _ROWS * _COLUMNS)


def _cells(points: Float, normals: Float) -> Float:
    """Return mean point and mean unit normal of each cell, (6, cells + 1). The normal is 0 in the
    last column, and without a surface."""
    index, count = _indices(points), _ROWS * _COLUMNS + 1
    top = np.full(count, -np.inf)
    np.maximum.at(top, index, points[2])
    front = (normals[2] > 0.0) & (points[2] > top[index] - _LAYER) & (index < count - 1)
    rows = np.concatenate([points, normals])[:, front]
    numbers = np.bincount(index[front], minlength=count)
    sums: Float = np.stack([np.bincount(index[front], row, count) for row in rows])
    middles, planes = sums[:3] / np.maximum(numbers, 1), unit(sums[3:].T).T
    return np.concatenate([middles, np.where(planes[2] < _STEEP, 0.0, planes)])


def _motion(points: Float, normals: Float, cells: Float) -> tuple[Float, float] | None:
    """Return the motion (4, 4) of points (3, N) onto cells, and the median distance of all pairs;
    None if there are too few pairs."""
    motion, median = np.eye(4), 0.0
    for _ in range(_STEPS):
        moved, turned = motion[:3, :3] @ points + motion[:3, 3:], motion[:3, :3] @ normals
        index = _indices(moved)
        middles, planes = np.split(cells[:, index], 2)
        distances = ((moved - middles) * planes).sum(axis=0)
        near = ((turned * planes).sum(axis=0) > 0.0) & (np.abs(distances) < _FAR)
        if np.count_nonzero(np.bincount(index[near])) < _OVERLAP * cells.shape[1]:
            return None
        pairs = np.flatnonzero(near)
        pairs = pairs[np.argsort(np.abs(distances[pairs]), kind="stable")]
        median = float(abs(distances[pairs[len(pairs) // 2]]))
        pairs = pairs[: int(_COUNTED * len(pairs))]
        planes = planes[:, pairs]
        rows = np.concatenate([np.cross(moved[:, pairs], planes, axis=0), planes])
        step = np.linalg.solve(rows @ rows.T, -rows @ distances[pairs])
        turn = [*(step[:3] / 2.0), 1.0]  # quaternion of a small rotation
        motion = local_matrix({"rotation": turn, "translation": step[3:]}) @ motion
        if np.abs(step).max() < _SMALL:
            break
    return motion, median


def _moved(mesh: Mesh, matrix: Float) -> Mesh:
    """Return a mesh after a rigid motion (4, 4), with its face, its rig and its pose."""
    turn, shift = matrix[:3, :3], matrix[:3, 3]

    def moved(part: Part) -> Part:
        rig = part.rig
        if rig is not None:
            root = matrix if rig.skeleton.root is None else matrix @ rig.skeleton.root
            rig = replace(rig, skeleton=replace(rig.skeleton, root=root))
        positions, normals = part.positions @ turn.T + shift, part.normals @ turn.T
        # Framing does not need the bounds of the head's joints, because the face is known.
        return replace(part, positions=positions, normals=normals, rig=rig, head=None)

    old, face = mesh.geometry, _face_of(mesh)
    eyes = face.eyes @ turn.T + shift
    face = replace(face, eyes=eyes, up=turn @ face.up, front=turn @ face.front)
    geometry = Geometry.of(old.name, [*map(moved, old.parts)], old.millimetres)
    geometry = replace(
        geometry,
        gloss=old.gloss,
        known_framing=framing_of(geometry.parts, geometry.space, geometry.profile, face),
        rotation=turn if old.rotation is None else turn @ old.rotation,
        shift=tuple((turn @ old.shift + shift).tolist()),
    )
    pose = mesh.pose and MeshPose(geometry, tuple(map(moved, mesh.parts)), geometry.bounds)
    return replace(mesh, geometry=geometry, pose=pose)
