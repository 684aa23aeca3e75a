"""The face of a mesh: position, direction and size of the eyes, in any orientation and any unit.

The method needs no texture, no names and no learned weights. It compares the surface with a relief:
a height map of the face, in distances between the eyes, with the tip of the nose at the origin
(assets/relief.npy, which ``python -m tools.head.relief`` makes from the built-in head).

1. Tips. Points of uniform density on the surface are counted in the cells of a grid. Where the mean
   shift of the density is large, the surface protrudes in its direction. The tip of a nose is such
   a place if the cells are a quarter of the distance between the eyes, so the search tries many
   sizes.
2. Climb. A polar height map around each tip is correlated with the relief for all rolls, then two
   Gauss-Newton steps improve direction, position and size.
3. Screen. Height maps of the best candidates are compared with the relief in two frequency bands,
   in which eyes, nose and lips differ from heels, knees and fists; plain heights do not.
4. Fit. Gauss-Newton steps improve the best candidates, and the bands decide among them.

Results do not depend on the processor or on threads, because bytes of images depend on the camera:
there is no BLAS, no LAPACK and no vectorised exponential, and sorting is stable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.mesh.repair import face_normals
from facerender.system.files import data_dir
from facerender.values.vectors import UPS, axis_of, rotation_of

Float = NDArray[np.float64]

RELIEF = 1.4, 56  # the relief covers +-1.4 around the tip of the nose with 56 x 56 cells
# The eyes in the relief, x to the viewer's right, on average of many heads.
_EYES = np.array([[-0.475, 0.584, -0.44], [0.475, 0.584, -0.44]])
CLEAR, CLEAR_OPPOSITE = 0.85, 0.88  # least score of a face; of one that stands on its head

_HALF, _CELLS = RELIEF
_FLOOR = -1.0  # lower parts, and places without surface, count as this height
_POINTS, _LOCAL, _FEW = 80000, 24000, 4000  # on the mesh, around a candidate, to screen it
_SIZES = [0.36 * 0.5 ** (i / 3.0) for i in range(13)]  # distance of the eyes / diagonal of the mesh
_THIN = 2
_SMALL = 0.1  # smaller sizes use all points, larger ones every second
_CELL = 0.25  # size of a grid's cell
_OCCUPIED = 0.2  # least number of points in a cell / mean number; noise leaves fewer
_SHIFT = 0.45  # least mean shift at a tip, in cells
_TIPS, _CLIMBED, _SCREENED, _FITTED, _REFINED = 110, 60, 60, 8, 2  # numbers of candidates
_RINGS, _ANGLES = np.arange(1, 8) * 0.2, 24  # of the polar map
_RAY = np.arange(0.4, -1.2, -0.2)  # heights at which a ray looks for the surface, from the front
_BANDS = (0.06, 0.2), (0.1, 0.3)  # widths of two Gaussians whose difference is compared
_SIZE = 6  # index of the growth among the unknowns of a Gauss-Newton step
_DAMPING = np.diag([2.0, 2.0, 2.0, 2.0, 2.0, 0.01, 8.0, 20.0, 20.0, 20.0])


@dataclass(frozen=True, eq=False)
class Face:
    """A face, as :func:`facerender.find_face` returns it.

    eyes : (2, 3) centres of the eyes on the surface, first the one on the viewer's left
    up, front : (3,) unit vectors, to the top of the head and in the direction in which it looks
    eye_distance : distance of the eyes, about 63 mm for adults
    score : agreement with a face; at least 0.82, about 0.95 for a scan, 1.05 for the built-in head
    """

    eyes: Float
    up: Float
    front: Float
    eye_distance: float
    score: float

    @property
    def axes(self) -> Float:
        """Rotation (3, 3), for column vectors, to a face that looks along +z with y up."""
        return np.stack([np.cross(self.up, self.front), self.up, self.front])

    def turn(self, up: str) -> tuple[float, float, float]:
        """Return the right angles about x, y and z, in degrees, that turn the front to +z after
        ``up`` of :func:`facerender.load_mesh`."""
        x, _, z = rotation_of(UPS[up]) @ self.front
        return 0.0, 90.0 * round(-math.degrees(math.atan2(x, z)) / 90.0) % 360.0, 0.0

    def upright(self) -> Float:
        """Return the rotation (3, 3), for column vectors, that turns the face upright: along the
        axes of the file if they are within 15 degrees of the face."""
        up = axis_of(self.up)
        along_axes = rotation_of(self.turn(up)) @ rotation_of(UPS[up])
        cosine = ((along_axes * self.axes).sum() - 1.0) / 2.0
        return along_axes if cosine > math.cos(math.radians(15.0)) else self.axes


class _Poses(NamedTuple):
    """Poses of the relief: tip of the nose (N, 3); axes (N, 3, 3), rows right, up, front; size
    (N,), the distance of the eyes."""

    tip: Float
    axes: Float
    size: Float

    def at(self, index: Any) -> _Poses:
        return _Poses(*(column[index] for column in self))

    def turned(self, vectors: Float) -> Float:
        """Return the axes, rotated about themselves by vectors (N, 3) of small angles in radians.
        The rational map of Cayley needs no sine."""
        x, y, z = 0.5 * vectors.T
        rows = [
            *(1 + x * x - y * y - z * z, 2 * (x * y + z), 2 * (x * z - y)),
            *(2 * (x * y - z), 1 - x * x + y * y - z * z, 2 * (y * z + x)),
            *(2 * (x * z + y), 2 * (y * z - x), 1 - x * x - y * y + z * z),
        ]
        turns = np.stack(rows, -1).reshape(-1, 3, 3) / (1 + x * x + y * y + z * z)[:, None, None]
        return np.asarray(np.einsum("nij,njk->nik", turns, self.axes))

    def coordinates(self, points: Float) -> Float:
        """Return points (3, P) in the coordinates of the first pose."""
        x, y, z = points - self.tip[0][:, None]
        return np.stack([(x * a[0] + y * a[1] + z * a[2]) / self.size[0] for a in self.axes[0]])


def find_faces(surface: Surface) -> list[Face]:
    """Return the faces of a surface, the best first. A baby may resemble a face on its head, with
    scores of up to 0.87: such a face needs a higher score."""
    opposite = 0.5
    return [
        face
        for face in candidates(surface)
        if face.score >= (CLEAR if face.up[1] > -opposite else CLEAR_OPPOSITE)
    ]


def candidates(surface: Surface) -> list[Face]:
    """Return the places of a surface that are most similar to a face, whatever their score is."""
    points, triangles = surface.sampled(_POINTS)
    lengths = np.maximum(surface.areas[triangles], 1e-300)
    normals = np.ascontiguousarray(surface.normals[triangles].T) / lengths
    extents = points.max(axis=1) - points.min(axis=1)
    if (extents > 0.0).sum() < 2:
        return []
    diagonal = math.sqrt((extents * extents).sum())
    climbed = []
    for size in _SIZES:
        step = 1 if size < _SMALL else 2
        grid = _Grid(points[:, ::step], normals[:, ::step], size * diagonal)
        if len(grid.tips.size):
            climbed.append(_climbed(grid))
    if not climbed:
        return []
    scores = np.concatenate([score for score, _ in climbed])
    poses = _Poses(*map(np.concatenate, zip(*(each for _, each in climbed), strict=True)))
    fits = []
    for index in _screened(points[:, ::_THIN], scores, poses):
        pose = poses.at([index])
        near = _near(surface.middles, pose, 2.5)
        if surface.areas[near].any():
            local = surface.sampled(_LOCAL, near)[0]
            pose = _fitted(local, pose, 5)
            fits.append((_similarity(local[:, ::3], pose, coarse=True), pose, local))
    fits.sort(key=lambda fit: -fit[0])
    results: list[tuple[float, _Poses]] = []
    for _, pose, local in fits:
        others = (np.abs(pose.tip - other.tip).max() > 2.0 * pose.size[0] for _, other in results)
        if len(results) < _REFINED or (len(results) == _REFINED and all(others)):
            pose = _fitted(local, pose, 6)
            results.append((_similarity(local, pose), pose))
    faces: list[Face] = []
    for score, (tip, axes, sizes) in sorted(results, key=lambda result: -result[0]):
        eyes = tip[0] + sizes[0] * _product(_EYES, axes[0])
        apart = [((each.eyes - eyes) ** 2).sum() for each in faces]
        if all(squares > 2.0 * (2.0 * sizes[0]) ** 2 for squares in apart):
            distance = float(sizes[0] * (_EYES[1, 0] - _EYES[0, 0]))
            faces.append(Face(eyes, axes[0, 1], axes[0, 2], distance, float(score)))
    return faces


@cache
def _reliefs() -> Float:
    """Return the reliefs (2, 56, 56): of the built-in head, and the mean with a shorter nose and
    lower eyes. Places without surface have NaN."""
    return np.asarray(np.load(data_dir("assets") / "relief.npy"), dtype=np.float64)


def _halved(maps: Float) -> Float:
    """Return maps (..., 56, 56) of half the resolution."""
    return np.asarray(maps.reshape(*maps.shape[:-2], _CELLS // 2, 2, _CELLS // 2, 2).mean((-3, -1)))


@cache
def _bands() -> tuple[list[_Bands], list[_Bands]]:
    """Return the bands of the reliefs, and of the reliefs at half the resolution."""
    return [*map(_Bands, _reliefs())], [*map(_Bands, _halved(_reliefs()))]


@cache
def _squares() -> tuple[NDArray[np.bool_], list[_Map]]:
    """Return the mask of a disc in square maps of half the resolution, and the reliefs there."""
    side = (np.arange(_CELLS // 2) + 0.5) * (4.0 * _HALF / _CELLS) - _HALF
    x, y = np.meshgrid(side, side)
    disc = x * x + y * y <= _HALF**2
    weights = np.where(y > -0.35, 1.0, 0.5)[disc]
    maps = []
    for relief in _halved(np.maximum(np.nan_to_num(_reliefs(), nan=_FLOOR), _FLOOR)):
        along, across = np.gradient(relief, side[1] - side[0])
        slopes = np.stack([across[disc], along[disc]])
        maps.append(_Map(np.stack([x[disc], y[disc]]), relief[disc], slopes, weights))
    return disc, maps


@cache
def _polar() -> tuple[_Map, Float]:
    """Return the first relief at the places of polar maps, ring by ring, and what correlation uses
    of it (K, angles) for each roll."""
    disc, maps = _squares()
    places = np.stack([np.outer(_RINGS, column).ravel() for column in _angles()])
    at = ((places + _HALF) * (_CELLS / 4.0 / _HALF) - 0.5).clip(0, _CELLS // 2 - 1.001)
    (j, i), (u, v) = at.astype(np.int64), at % 1.0
    values = []
    relief = _halved(np.maximum(np.nan_to_num(_reliefs()[0], nan=_FLOOR), _FLOOR))
    for grid in (relief, *np.gradient(relief, 4.0 * _HALF / _CELLS)[::-1]):
        low, high = (grid[k, j] * (1.0 - u) + grid[k, j + 1] * u for k in (i, i + 1))
        values.append(low * (1.0 - v) + high * v)
    weights = np.repeat(2.0 * np.sqrt(_RINGS / _RINGS[-1]), _ANGLES)
    polar = _Map(places, values[0], np.stack(values[1:]), weights)
    rings = polar.flat.reshape(-1, _ANGLES)
    return polar, np.stack([np.roll(rings, k, 1).ravel() for k in range(_ANGLES)], axis=1)


def _climbed(grid: _Grid) -> tuple[Float, _Poses]:
    """Return correlations and poses of the best tips of a grid, after their roll is found."""
    polar, rolls = _polar()
    tips = grid.tips
    heights = grid.heights(tips)
    roll = _product(polar.residual(heights), rolls).argmax(axis=1)
    (cosine, sine), (right, up, front) = _angles(), np.moveaxis(tips.axes, 1, 0)
    c, s = cosine[roll, None], sine[roll, None]
    poses = tips._replace(axes=np.stack([c * right + s * up, c * up - s * right, front], axis=1))
    order = ((np.arange(_ANGLES) + roll[:, None]) % _ANGLES)[:, None]
    rings = heights.reshape(len(heights), -1, _ANGLES)
    heights = np.take_along_axis(rings, order, 2).reshape(len(heights), -1)
    scores = polar.correlation(heights)
    best = np.argsort(-scores, kind="stable")[:_CLIMBED]
    scores, poses, heights = scores[best], poses.at(best), heights[best]
    current = poses
    for _ in range(2):
        current = polar.step(heights, current)
        heights = grid.heights(current)
        new = polar.correlation(heights)
        better = new > scores
        scores = np.where(better, new, scores)
        pairs = zip(current, poses, strict=True)
        poses = _Poses(*(np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))
    return scores, poses


def _screened(points: Float, scores: Float, poses: _Poses) -> list[int]:
    """Return the indices of the candidates to fit, the best first."""
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        tip, axes, size = poses.at(i)
        others = poses.at(chosen)
        near = ((others.tip - tip) ** 2).sum(axis=1) < (0.25 * others.size) ** 2
        near &= (others.size > 0.74 * size) & (others.size < 1.35 * size)
        if not (near & ((others.axes[:, 1] * axes[1]).sum(axis=1) > 0.9)).any():
            chosen.append(int(i))
        if len(chosen) == _SCREENED:
            break
    ranks, bands = [], _bands()[1][0]
    for i in chosen:
        near = _near(points, poses.at([i]), 2.0)
        few = points[:, near[:: len(near) // _FEW + 1]]
        maps = bands.of(_raster(few, poses.at([i]), bands.count))
        ranks.append(bands.correlation(maps, masks=1)[0] + 0.5 * scores[i])
    return [chosen[k] for k in np.argsort(-np.array(ranks), kind="stable")[:_FITTED]]


def _fitted(points: Float, pose: _Poses, times: int) -> _Poses:
    """Return the best of several poses along Gauss-Newton steps on points (3, P) of a face."""
    disc, (relief, _) = _squares()
    best, few = (-1.0, pose), points[:, ::3]
    for _ in range(times):
        heights = np.nan_to_num(_raster(few, pose, _CELLS // 2), nan=_FLOOR)[disc][None]
        score = float(relief.correlation(heights)[0])
        best = (score, pose) if score > best[0] else best
        pose = relief.step(heights, pose)
    return best[1]


def _similarity(points: Float, pose: _Poses, coarse: bool = False) -> float:
    """Return the score of a pose for points (3, P) on the surface: mean correlation of the bands,
    plus a part of their amplitude, minus the root mean square difference of heights."""
    disc, maps = _squares()
    heights = np.nan_to_num(_raster(points[:, ::3], pose, _CELLS // 2), nan=_FLOOR)[disc]
    reliefs = _bands()[coarse]
    bands = reliefs[0].of(_raster(points, pose, reliefs[0].count))
    scores = []
    for relief, square in zip(reliefs, maps, strict=True):
        correlation, amplitude = relief.correlation(bands)
        scores.append(correlation + 0.1 * min(amplitude, 0.8) - square.difference(heights))
    return max(scores)


def _raster(points: Float, pose: _Poses, count: int) -> Float:
    """Return the mean height of the front layer of points (3, P) in each cell, (count, count), with
    row 0 at the bottom; NaN without points."""
    x, y, z = pose.coordinates(points)
    inside = (np.abs(x) < _HALF) & (np.abs(y) < _HALF) & (z < 0.7) & (z > _FLOOR - 0.3)
    x, y, z = x[inside], y[inside], z[inside]
    column, row = (((c + _HALF) * (count / 2.0 / _HALF)).astype(np.int64) for c in (x, y))
    cells = np.minimum(row, count - 1) * count + np.minimum(column, count - 1)
    top = np.full(count * count, -np.inf)
    np.maximum.at(top, cells, z)
    front = z > top[cells] - 0.12
    number = np.bincount(cells[front], minlength=count * count)
    total = np.bincount(cells[front], z[front], count * count)
    heights = np.where(number > 0, total / np.maximum(number, 1), np.nan)
    return np.maximum(heights, _FLOOR).reshape(count, count)


class Surface:
    """Triangles with corners (F, 3, 3): normals with the length of twice the area, these areas, and
    the middles (3, F)."""

    def __init__(self, corners: Float) -> None:
        self.corners, self.normals = corners, face_normals(corners)
        self.areas = np.sqrt(_dot(self.normals, self.normals))
        self.middles = np.ascontiguousarray(corners.sum(axis=1).T) / 3.0

    @property
    def bounds(self) -> tuple[Float, Float]:
        """Lowest and highest coordinates (3,)."""
        columns = np.ascontiguousarray(self.corners.reshape(-1, 3).T)
        return columns.min(axis=1), columns.max(axis=1)

    def sampled(self, count: int, index: Any = slice(None)) -> tuple[Float, NDArray[np.intp]]:
        """Return points (3, count) of uniform density on the triangles of an index, and for each
        point its triangle."""
        chosen = np.arange(len(self.areas))[index]
        steps, number = np.cumsum(self.areas[chosen]), np.arange(count) + 0.5
        places = np.searchsorted(steps, number * (steps[-1] / count)).clip(max=len(steps) - 1)
        triangles = chosen[places]
        # Roberts' sequence fills a square evenly. The half with u + v > 1 is folded onto the other.
        u, v = (np.modf(number * step)[0] for step in (0.7548776662466927, 0.5698402909980532))
        folded = u + v > 1.0
        u[folded], v[folded] = 1.0 - u[folded], 1.0 - v[folded]
        a, b, c = np.ascontiguousarray(np.moveaxis(self.corners[triangles], 0, 2))
        return a + u * (b - a) + v * (c - a), triangles


def _near(points: Float, pose: _Poses, reach: float) -> NDArray[np.intp]:
    """Return the indices of points (3, P) within a distance of the nose, in eye distances."""
    x, y, z = points - pose.tip[0][:, None]
    return np.flatnonzero(x * x + y * y + z * z < (reach * pose.size[0]) ** 2)


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _product(a: Float, b: Float) -> Float:
    """Return a matrix product without BLAS."""
    return np.asarray(np.einsum("nk,km->nm", a, b))


def _solved(systems: Float, right: Float) -> Float:
    """Return the solutions (N, K) of positive definite systems (N, K, K) without LAPACK."""
    rows = np.concatenate([systems, right[..., None]], axis=-1)
    for i in range(right.shape[1]):
        rows[:, i, i:] /= rows[:, i, i, None]
        factors = rows[:, :, i].copy()
        factors[:, i] = 0.0
        rows[:, :, i:] -= factors[:, :, None] * rows[:, None, i, i:]
    return rows[..., -1]


def _angles() -> tuple[Float, Float]:
    """Return cosine and sine of the angles of the polar map. Rounding hides the last bits, in which
    processors differ."""
    angles = np.arange(_ANGLES) * (2.0 * np.pi / _ANGLES)
    return np.round(np.cos(angles), 9), np.round(np.sin(angles), 9)


class _Grid:
    """Points in the cells of a grid for one size of a face: mean point and mean normal of each
    occupied cell, and the tips.

    points, normals : (3, P)
    size : distance of the eyes
    """

    def __init__(self, points: Float, normals: Float, size: float) -> None:
        self.size, cell = size, size * _CELL
        margin = 7  # empty cells around the points, for the blur
        self.low, self.cell = points.min(axis=1) - margin * cell, cell
        counts = ((points.max(axis=1) - self.low) / cell).astype(np.int64) + margin + 1
        self.last = counts - 1
        self.steps = np.array([counts[1] * counts[2], counts[2], 1])
        keys = self._keys(*((points - self.low[:, None]) / cell))
        number = np.bincount(keys, minlength=int(counts.prod())).astype(np.int32)
        cells = np.flatnonzero(number > _OCCUPIED * len(keys) / np.count_nonzero(number))
        self.index = np.full(number.size, -1, np.int32)
        self.index[cells] = np.arange(len(cells))
        index, in_cell = self.index[keys], number[cells]
        keep = index >= 0
        index = index[keep]
        self.mean, self.normal = (
            np.stack([np.bincount(index, row[keep], len(cells)) / in_cell for row in rows], axis=1)
            for rows in (points, normals)
        )
        for step in self.steps:
            for _ in range(4):  # four boxes of three cells resemble a Gaussian of 1.6 cells
                blurred = number.copy()
                blurred[step:] += number[:-step]
                blurred[:-step] += number[step:]
                number = blurred
        slope = np.stack([number[cells - step] - number[cells + step] for step in self.steps], 1)
        shift = slope / number[cells][:, None]
        length = np.sqrt(_dot(shift, shift))
        peaks = np.flatnonzero(length > _SHIFT)
        field = np.zeros(number.size)
        field[cells] = length
        for offset in np.array(np.unravel_index(np.arange(27), (3, 3, 3))).T - 1:
            neighbours = cells[peaks] + (offset * self.steps).sum()
            peaks = peaks[length[peaks] >= field[neighbours]]
        peaks = peaks[np.argsort(-length[peaks], kind="stable")[:_TIPS]]
        front = shift[peaks] / length[peaks, None]
        across = np.where(np.abs(front[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        right = np.cross(across, front)
        right /= np.sqrt(_dot(right, right))[:, None]
        axes = np.stack([right, np.cross(front, right), front], axis=1)
        self.tips = _Poses(self.mean[peaks], axes, np.full(len(peaks), size))

    def _keys(self, x: Float, y: Float, z: Float) -> NDArray[np.int64]:
        """Return the numbers of cells from coordinates in cells; outside, those of a side."""
        columns = zip((x, y, z), self.last, self.steps, strict=True)
        keys = (np.clip(c, 0, end).astype(np.int32) * np.int32(step) for c, end, step in columns)
        return np.asarray(sum(keys))

    def heights(self, poses: _Poses) -> Float:
        """Return polar height maps (N, rings * angles), in distances between the eyes."""
        right, up, front = np.moveaxis(poses.axes, 1, 0)
        size = poses.size[:, None]
        x, y = _polar()[0].places
        start = [
            poses.tip[:, i, None] + size * (x * right[:, i, None] + y * up[:, i, None])
            for i in range(3)
        ]
        cells = (
            ((start[i] - self.low[i]) / self.cell).astype(np.float32)
            + (_RAY[:, None, None] * (size * front[:, i, None] / self.cell)).astype(np.float32)
            for i in range(3)
        )
        hits = self.index[self._keys(*cells)]  # the sides of the grid are empty
        hit = np.take_along_axis(hits, (hits >= 0).argmax(axis=0)[None], 0)[0]
        away, normal = self.mean[hit] - np.stack(start, -1), self.normal[hit]
        facing, high = _dot(normal, front[:, None]), _dot(away, front[:, None])
        # The ray meets the plane through the cell's mean point.
        aside = (_dot(away, normal) - high * facing) * facing / np.maximum(facing * facing, 0.09)
        high = high / size + (aside / size).clip(-_CELL, _CELL)
        return np.where(hit >= 0, np.maximum(high, _FLOOR), _FLOOR)


class _Map:
    """The relief at fixed places, for correlation and for Gauss-Newton steps.

    places : x and y
    heights : of the relief there
    slopes : derivatives of the heights along x and y
    weights : of the places
    """

    def __init__(self, places: Float, heights: Float, slopes: Float, weights: Float) -> None:
        self.places, self.relief, self.weights = places, heights, weights
        (x, y), (across, along) = places, slopes
        one = np.ones_like(x)
        # The best quadratic surface is removed from heights: it is the same for heads and heels.
        basis: list[Float] = []
        for column in (one, x, y, x * x, x * y, y * y):
            column = column * weights
            for _ in range(2):
                for other in basis:
                    column = column - other * (other * column).sum()
            basis.append(column / math.sqrt((column * column).sum()))
        self.basis = np.stack(basis)
        flat = heights * weights
        flat = flat - self._quadratic(flat[None])[0]
        length = math.sqrt((flat * flat).sum())
        self.flat, self.soft = flat / length, 0.15 * length
        # Unknowns: rotation about x, y and z; shift along x, y and z; growth; bending.
        rotation = y + along * heights, -x - across * heights, across * y - along * x
        growth = heights - across * x - along * y
        columns = *rotation, -across, -along, one, growth, x * x, x * y, y * y
        self.changes = np.stack(columns, axis=1)
        self.squares = (self.changes[:, :, None] * self.changes[:, None]).reshape(len(x), -1)

    def _quadratic(self, maps: Float) -> Float:
        return _product(np.einsum("nk,qk->nq", maps, self.basis), self.basis)

    def residual(self, heights: Float) -> Float:
        """Return weighted heights (N, K) without their best quadratic surface. Outliers count
        less."""
        result = weighted = heights * self.weights
        for _ in range(2):
            surface = self._quadratic(result)
            result = np.clip(weighted, surface - 0.35, surface + 0.35)
        return np.asarray(result - self._quadratic(result))

    def correlation(self, heights: Float) -> Float:
        """Return the correlation (N,) with the relief; plain surfaces have 0."""
        rest = self.residual(heights)
        return np.asarray((rest * self.flat).sum(-1) / (np.sqrt(_dot(rest, rest)) + self.soft))

    def difference(self, heights: Float) -> float:
        """Return the root mean square difference of a map (K,) from the relief."""
        off = heights - self.relief
        off = (off - np.median(off)).clip(-0.3, 0.3) * self.weights
        return math.sqrt((off * off).mean())

    def step(self, heights: Float, poses: _Poses) -> _Poses:
        """Return better poses for height maps (N, K), by a robust Gauss-Newton step."""
        off = heights - self.relief
        weights = (heights > _FLOOR) * self.weights**2 / (1.0 + (off / 0.2) ** 2)
        systems = _product(weights, self.squares).reshape(-1, 10, 10) + _DAMPING
        change = _solved(systems, _product(weights * off, self.changes)).clip(-0.3, 0.3)
        axes = poses.turned(change[:, :3])
        shift = poses.size[:, None] * np.einsum("ni,nij->nj", change[:, 3:6], axes)
        growth = (1.0 + change[:, _SIZE] / 2.0) / (1.0 - change[:, _SIZE] / 2.0)
        return _Poses(poses.tip + shift, axes, poses.size * growth)


class _Bands:
    """Frequency bands of square height maps, and their correlation with those of a relief."""

    def __init__(self, relief: Float) -> None:
        self.count = count = len(relief)
        at = (np.arange(count) + 0.5) * (2.0 * _HALF / count)
        self.blurs: dict[float, Float] = {
            width: np.round(np.exp(-(((at[:, None] - at) / width) ** 2) / 2.0), 9)
            for width in {width for band in _BANDS for width in band}
        }
        x, y = np.meshgrid(at - _HALF, at - _HALF)
        face = (x * x + y * y < 1.25**2) & (y > -1.1)
        self.masks = face, face & (y > -0.3)  # the face, and the face without mouth and chin
        self.bands = self.of(relief)

    def of(self, heights: Float) -> list[tuple[Float, Float]]:
        """Return for each band the filtered map, and its weights, which are small at holes."""
        seen = (heights > _FLOOR).astype(np.float64)  # 0 for NaN
        filled, bands = np.where(seen > 0.0, heights, 0.0), []
        for widths in _BANDS:
            blurs = [self.blurs[width] for width in widths]
            fine, broad = ((_product(_product(b, seen), b), b) for b in blurs)
            first, second = (
                _product(_product(blur, filled), blur) / np.maximum(total, 1e-9)
                for total, blur in (fine, broad)
            )
            total = blurs[0].sum(axis=0)
            weights = fine[0] / (total[:, None] * total)
            bands.append(((first - second).clip(-0.25, 0.25), weights * (weights > 0.3)))
        return bands

    def correlation(self, bands: list[tuple[Float, Float]], masks: int = 2) -> tuple[float, float]:
        """Return the mean correlation of bands with those of the relief, and how pronounced the
        finest band is, 1 as in the relief."""
        results = []
        for mask in self.masks[:masks]:
            for (band, weights), (relief, known) in zip(bands, self.bands, strict=True):
                known = known * mask
                weights = weights * known
                share = min(1.0, weights.sum() / (0.6 * known.sum()))  # of what is compared
                weights = weights / max(weights.sum(), 1e-9)
                a, b = (m - (weights * m).sum() for m in (band, relief))
                ab, aa, bb = ((weights * c).sum() for c in (a * b, a * a, b * b))
                results.append((share * ab / math.sqrt(aa * bb + 1e-12), ab / (bb + 1e-9)))
        return sum(each for each, _ in results) / len(results), results[0][1]
