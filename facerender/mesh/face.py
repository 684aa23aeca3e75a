"""The face of a mesh: position, direction and size of the eyes, in any orientation and any unit.

The method needs no texture, no names and no learned weights. It compares the surface with reliefs:
height maps of a face, in distances between the eyes, with the tip of the nose at the origin.

1. Tips. Points of uniform density on the surface are counted in the cells of a grid. Where the mean
   shift of the density is large, the surface protrudes in its direction. The tip of a nose is such
   a place if the cells are a quarter of the distance between the eyes: the search tries 13 sizes.
2. Climb. A polar height map around each tip is correlated with the relief for all rolls, then two
   Gauss-Newton steps improve direction, position and size.
3. Screen. Height maps of the best candidates are compared with the relief in two frequency bands,
   in which eyes, nose and lips differ from heels, knees and fists; plain heights do not.
4. Fit. Gauss-Newton steps improve the best candidates, and the bands decide among them.

Results do not depend on the processor or on threads, because bytes of images depend on the camera:
there is no BLAS, no LAPACK and no vectorised exponential, and sorting is stable."""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.mesh.part import Face
from facerender.mesh.repair import face_normals
from facerender.system.files import data_dir
from facerender.values.vectors import Float, Integers

_Bands = list[tuple[Float, Float]]

RELIEFS = data_dir("assets") / "relief.npy"  # made by ``python -m tools.head.relief``

# Scores of faces. A baby may resemble a face on its head: such a face needs a higher score.
_CLEAR, _CLEAR_ON_HEAD = 0.85, 0.88
_HALF, _CELLS = 1.4, 56  # the reliefs cover +-1.4 around the tip of the nose with 56 x 56 cells
# The eyes in the reliefs, x to the viewer's right, on average of many heads.
_EYES = np.array([[-0.475, 0.584, -0.44], [0.475, 0.584, -0.44]])
_FLOOR = -1.0  # lower parts, and cells without surface, count as this height
_POINTS, _LOCAL, _FEW = 80000, 24000, 4000  # on the mesh, around a candidate, to screen it
_SIZES = [0.36 * 0.5 ** (i / 3.0) for i in range(13)]  # distance of the eyes / diagonal of the mesh
_SMALL = 0.1  # smaller sizes use all points, larger ones every second
_CELL = 0.25  # size of a grid's cell
_OCCUPIED = 0.25  # least number of points in a cell / mean number; noise leaves fewer
_SHIFT = 0.45  # least mean shift at a tip, in cells
_TIPS, _CLIMBED, _SCREENED, _FITTED, _REFINED = 110, 60, 80, 8, 2  # numbers of candidates
_RINGS, _ANGLES = np.arange(1, 8) * 0.2, 24  # of the polar map
# Cosines and sines of the angles. Rounding hides the last bits, in which processors differ.
_COS, _SIN = (np.round(f(np.arange(_ANGLES) * 2.0 * np.pi / _ANGLES), 9) for f in (np.cos, np.sin))
_RAY = np.arange(0.4, -1.2, -0.2)  # heights at which a ray looks for the surface, from the front
_WIDTHS = (0.06, 0.2), (0.1, 0.3)  # of two Gaussians, whose difference is a band
_DAMPING = np.diag([2.0, 2.0, 2.0, 2.0, 2.0, 0.01, 8.0, 20.0, 20.0, 20.0])


class Surface:
    """Triangles with corners (F, 3, 3): normals of twice the area, areas, middles (3, F)."""

    def __init__(self, corners: Float) -> None:
        self.corners, self.normals = corners, face_normals(corners)
        self.areas = np.sqrt(_dot(self.normals, self.normals))
        self.middles = np.ascontiguousarray(corners.sum(axis=1).T) / 3.0

    def sampled(self, count: int, chosen: NDArray[np.intp]) -> tuple[Float, NDArray[np.intp]]:
        """Return points (3, count) of uniform density on chosen triangles, and their triangles."""
        steps, index = np.cumsum(self.areas[chosen]), np.arange(count) + 0.5
        hits = np.searchsorted(steps, index * (steps[-1] / count)).clip(max=len(steps) - 1)
        # Roberts' sequence fills a square evenly. The half with u + v > 1 is folded onto the other.
        u, v = (np.modf(index * step)[0] for step in (0.7548776662466927, 0.5698402909980532))
        folded = u + v > 1.0
        u[folded], v[folded] = 1.0 - u[folded], 1.0 - v[folded]
        a, b, c = np.ascontiguousarray(np.moveaxis(self.corners[chosen[hits]], 0, 2))
        return a + u * (b - a) + v * (c - a), chosen[hits]


class _Poses(NamedTuple):
    """Poses of a relief: nose tip (N, 3), axes right, up, front (N, 3, 3), eye distance (N,)."""

    tip: Float
    axes: Float
    size: Float

    def at(self, index: Any) -> _Poses:
        return _Poses(*(column[index] for column in self))

    def changed(self, change: Float) -> _Poses:
        """Return poses after small changes (N, 7): rotation about their axes in radians, shift
        along them, and growth. Rational functions replace sine and exponential."""
        x, y, z = 0.5 * change[:, :3].T
        rows = [
            *(1 + x * x - y * y - z * z, 2 * (x * y + z), 2 * (x * z - y)),
            *(2 * (x * y - z), 1 - x * x + y * y - z * z, 2 * (y * z + x)),
            *(2 * (x * z + y), 2 * (y * z - x), 1 - x * x - y * y + z * z),
        ]
        turns = np.stack(rows, -1).reshape(-1, 3, 3) / (1 + x * x + y * y + z * z)[:, None, None]
        axes = np.einsum("nij,njk->nik", turns, self.axes)
        shift = self.size[:, None] * np.einsum("ni,nij->nj", change[:, 3:6], axes)
        half = change[:, 6] / 2.0
        return _Poses(self.tip + shift, axes, self.size * (1.0 + half) / (1.0 - half))


def find_faces(surface: Surface, least: float = _CLEAR) -> list[Face]:
    """Return the faces of a surface with scores of at least ``least``, the best first."""
    points, triangles = surface.sampled(_POINTS, np.arange(len(surface.areas)))
    extents = points.max(axis=1) - points.min(axis=1)
    diagonal = math.sqrt(_dot(extents, extents))
    if not (extents > 1e-6 * diagonal).sum() > 1:
        return []
    normals = surface.normals[triangles].T / np.maximum(surface.areas[triangles], 1e-300)
    climbed = []
    for size in _SIZES:
        step = 1 if size < _SMALL else 2
        climbed.append(_climbed(_Grid(points[:, ::step], normals[:, ::step], size * diagonal)))
    scores, *columns = (np.concatenate(column) for column in zip(*climbed, strict=True))
    poses, fits = _Poses(*columns), []
    for index in _screened(points[:, ::2], scores, poses):
        pose = poses.at([index])
        near = _near(surface.middles, pose, 2.5)
        if surface.areas[near].any():
            local = surface.sampled(_LOCAL, near)[0]
            pose = _fitted(local, pose, 5)
            fits.append((_similarity(local, pose, coarse=True), pose, local))
    results: list[tuple[float, _Poses]] = []
    for _, pose, local in sorted(fits, key=lambda fit: -fit[0]):
        apart = [np.abs(pose.tip - other.tip).max() > 2.0 * pose.size[0] for _, other in results]
        if len(results) < _REFINED or (len(results) == _REFINED and all(apart)):
            pose = _fitted(local, pose, 6)
            results.append((_similarity(local, pose), pose))
    faces: list[Face] = []
    for score, pose in sorted(results, key=lambda result: -result[0]):
        (tip,), (axes,), (size,) = pose
        eyes = tip + size * _product(_EYES, axes)
        least_score = max(least, _CLEAR_ON_HEAD) if axes[1, 1] < -0.8 else least
        if score >= least_score and all(np.abs(f.eyes - eyes).max() > 2.0 * size for f in faces):
            distance = float(size * (_EYES[1, 0] - _EYES[0, 0]))
            faces.append(Face(eyes, axes[1], axes[2], distance, score))
    return faces


def _climbed(grid: _Grid) -> tuple[Float, Float, Float, Float]:
    """Find the roll of a grid's tips; return correlations, and columns of poses, of the best."""
    polar, rolls = _polar()
    heights = grid.heights(grid.tips)
    roll = _product(polar.residual(heights), rolls).argmax(axis=1)
    order = ((np.arange(_ANGLES) + roll[:, None]) % _ANGLES)[:, None]
    heights = np.take_along_axis(heights.reshape(-1, len(_RINGS), _ANGLES), order, 2)
    heights = heights.reshape(len(roll), -1)
    scores = polar.correlation(heights)
    (right, up, front), c, s = np.moveaxis(grid.tips.axes, 1, 0), _COS[roll, None], _SIN[roll, None]
    axes = np.stack([c * right + s * up, c * up - s * right, front], axis=1)
    best = np.argsort(-scores, kind="stable")[:_CLIMBED]
    scores, heights = scores[best], heights[best]
    poses = current = grid.tips._replace(axes=axes).at(best)
    for _ in range(2):
        current = polar.step(heights, current)
        heights = grid.heights(current)
        new = polar.correlation(heights)
        better = new > scores
        scores = np.where(better, new, scores)
        for old, column in zip(poses, current, strict=True):
            old[better] = column[better]
    return scores, *poses


def _screened(points: Float, scores: Float, poses: _Poses) -> list[int]:
    """Return the indices of the poses to fit, the best first."""
    chosen: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        tip, axes, size = poses.at(i)
        others = poses.at(chosen)
        same = ((others.tip - tip) ** 2).sum(axis=1) < (0.25 * others.size) ** 2
        same &= (others.size > 0.74 * size) & (others.size < 1.35 * size)
        if not (same & ((others.axes[:, 1] * axes[1]).sum(axis=1) > 0.9)).any():
            chosen.append(int(i))
        if len(chosen) == _SCREENED:
            break
    ranks, relief = [], _reliefs(coarse=True)[0]
    for i in chosen:
        near = _near(points, poses.at([i]), 2.0)
        heights = _raster(points[:, near[:: len(near) // _FEW + 1]], poses.at([i]), relief.count)
        ranks.append(-relief.similarity(relief.bands_of(heights))[0] - 0.5 * scores[i])
    return [chosen[k] for k in np.argsort(ranks, kind="stable")[:_FITTED]]


def _fitted(points: Float, pose: _Poses, times: int) -> _Poses:
    """Return the best of several poses along Gauss-Newton steps on points (3, P) of a face."""
    relief, best = _reliefs(coarse=True)[0], (-1.0, pose)
    for _ in range(times):
        heights = relief.on_disc(_raster(points[:, ::3], pose, relief.count))[None]
        best = max(best, (float(relief.map.correlation(heights)[0]), pose), key=lambda fit: fit[0])
        pose = relief.map.step(heights, pose)
    return best[1]


def _similarity(points: Float, pose: _Poses, coarse: bool = False) -> float:
    """Return the score of a pose for points (3, P) on the surface: mean correlation of the bands,
    plus a part of their amplitude, minus the root mean square difference of heights."""
    scores, reliefs = [], _reliefs(coarse)
    few = _raster(points[:, ::3], pose, _CELLS // 2)
    bands = reliefs[0].bands_of(few if coarse else _raster(points, pose, _CELLS))
    for relief, half in zip(reliefs, _reliefs(coarse=True), strict=True):
        correlation, amplitude = relief.similarity(bands)
        off = half.on_disc(few) - half.map.heights
        off = (off - np.median(off)).clip(-0.3, 0.3) * half.map.weights
        score = correlation + 0.1 * min(amplitude, 0.8) - math.sqrt(_dot(off, off) / len(off))
        scores.append(float(score))
    return max(scores)


def _raster(points: Float, pose: _Poses, count: int) -> Float:
    """Return the mean height of the front layer of points (3, P) in each cell, (count, count), with
    row 0 at the bottom; NaN without points."""
    (tip,), (axes,), (size,) = pose
    offset = (points - tip[:, None]) / size
    x, y, z = (offset[0] * axis[0] + offset[1] * axis[1] + offset[2] * axis[2] for axis in axes)
    inside = (np.abs(x) < _HALF) & (np.abs(y) < _HALF) & (z < 0.7) & (z > _FLOOR - 0.3)
    pixels = (np.stack([x[inside], y[inside]]) + _HALF) * (count / 2.0 / _HALF)
    column, row = pixels.astype(np.int64).clip(0, count - 1)
    cells, z = row * count + column, z[inside]
    top = np.full(count * count, -np.inf)
    np.maximum.at(top, cells, z)
    front = z > top[cells] - 0.12
    counts = np.bincount(cells[front], minlength=count * count)
    total = np.bincount(cells[front], z[front], count * count)
    heights = np.where(counts > 0, total / np.maximum(counts, 1), np.nan)
    return np.maximum(heights, _FLOOR).reshape(count, count)


def _near(points: Float, pose: _Poses, max_distance: float) -> NDArray[np.intp]:
    """Return the indices of points (3, P) within a distance of the nose, in eye distances."""
    x, y, z = points - pose.tip[0][:, None]
    return np.flatnonzero(x * x + y * y + z * z < (max_distance * pose.size[0]) ** 2)


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


class _Grid:
    """Points (3, P) with normals (3, P) in the cells of a grid for one distance of the eyes: mean
    point and mean normal of each occupied cell, and the tips."""

    def __init__(self, points: Float, normals: Float, size: float) -> None:
        self.cell, margin = size * _CELL, 7  # empty cells around the points, for the blur
        self.low = points.min(axis=1) - margin * self.cell
        self.last = ((points.max(axis=1) - self.low) / self.cell).astype(np.int64) + margin
        shape = self.last + 1
        self.steps = np.array([shape[1] * shape[2], shape[2], 1])
        keys = self._keys((points - self.low[:, None]) / self.cell)
        counts = np.bincount(keys, minlength=int(shape.prod())).astype(np.int32)
        cells = np.flatnonzero(counts > _OCCUPIED * len(keys) / np.count_nonzero(counts))
        self.index = np.full(counts.size, -1, np.int32)
        self.index[cells] = np.arange(len(cells))
        keep = self.index[keys] >= 0
        index, sizes = self.index[keys[keep]], counts[cells]
        self.mean, self.normal = (
            np.stack([np.bincount(index, row[keep], len(cells)) / sizes for row in rows], axis=1)
            for rows in (points, normals)
        )
        for step in self.steps:
            for _ in range(4):  # four boxes of three cells resemble a Gaussian of 1.6 cells
                blurred = counts.copy()
                blurred[step:] += counts[:-step]
                blurred[:-step] += counts[step:]
                counts = blurred
        slope = np.stack([counts[cells - step] - counts[cells + step] for step in self.steps], 1)
        shift = slope / counts[cells][:, None]
        field, length = np.zeros(counts.size), np.sqrt(_dot(shift, shift))
        field[cells] = length
        peaks = np.flatnonzero(length > _SHIFT)
        for offset in np.ndindex(3, 3, 3):
            neighbours = cells[peaks] + ((np.array(offset) - 1) * self.steps).sum()
            peaks = peaks[length[peaks] >= field[neighbours]]
        peaks = peaks[np.argsort(-length[peaks], kind="stable")[:_TIPS]]
        front = shift[peaks] / length[peaks, None]
        right = np.cross(np.where(np.abs(front[:, :1]) < 0.7, (1.0, 0, 0), (0, 1.0, 0)), front)
        right /= np.sqrt(_dot(right, right))[:, None]
        axes = np.stack([right, np.cross(front, right), front], axis=1)
        self.tips = _Poses(self.mean[peaks], axes, np.full(len(peaks), size))

    def _keys(self, cells: Any) -> Integers:
        """Return the numbers of cells from three coordinates in cells, clipped to the grid."""
        columns = zip(cells, self.last, self.steps, strict=True)
        keys = (np.clip(c, 0, end).astype(np.int32) * np.int32(step) for c, end, step in columns)
        return np.asarray(sum(keys))

    def heights(self, poses: _Poses) -> Float:
        """Return polar height maps (N, rings * angles), in distances between the eyes."""
        right, up, front = (poses.axes[:, i, :, None] for i in range(3))
        size, (x, y) = poses.size[:, None], _polar()[0].positions
        start = poses.tip[:, :, None] + size[:, None] * (x * right + y * up)
        cells = [
            ((start[:, i] - self.low[i]) / self.cell).astype(np.float32)
            + (_RAY[:, None, None] * (size * front[:, i] / self.cell)).astype(np.float32)
            for i in range(3)
        ]
        hits = self.index[self._keys(cells)]  # the sides of the grid are empty
        hit = np.take_along_axis(hits, (hits >= 0).argmax(axis=0)[None], 0)[0]
        offset, normal = self.mean[hit] - np.moveaxis(start, 1, 2), self.normal[hit]
        facing, high = (_dot(vectors, poses.axes[:, None, 2]) for vectors in (normal, offset))
        # The ray meets the plane through the cell's mean point.
        aside = (_dot(offset, normal) - high * facing) * facing / np.maximum(facing * facing, 0.09)
        high = high / size + (aside / size).clip(-_CELL, _CELL)
        return np.where(hit >= 0, np.maximum(high, _FLOOR), _FLOOR)


class _Map:
    """Heights of a relief and slopes along x and y, (3, K), with weights (K,), at points (2, K)."""

    def __init__(self, positions: Float, columns: Float, weights: Float) -> None:
        self.positions, self.heights, self.weights = positions, columns[0], weights
        (x, y), (heights, across, along), one = positions, columns, np.ones(len(weights))
        # The best quadratic surface is removed from heights: it is the same for heads and heels.
        basis: list[Float] = []
        for column in (one, x, y, x * x, x * y, y * y):
            column = column * weights
            for other in (*basis, *basis):
                column = column - other * _dot(other, column)
            basis.append(column / np.sqrt(_dot(column, column)))
        self.basis = np.stack(basis)
        flat = heights * weights - self._quadratic((heights * weights)[None])[0]
        length = np.sqrt(_dot(flat, flat))
        self.flat, self.soft = flat / length, 0.15 * length
        # Unknowns: rotation about x, y and z; shift along x, y and z; growth; bending.
        rotation = y + along * heights, -x - across * heights, across * y - along * x
        growth = heights - across * x - along * y
        changes = *rotation, -across, -along, one, growth, x * x, x * y, y * y
        self.changes = np.stack(changes, axis=1)
        self.squares = (self.changes[:, :, None] * self.changes[:, None]).reshape(len(x), -1)

    def _quadratic(self, maps: Float) -> Float:
        return _product(_product(maps, self.basis.T), self.basis)

    def residual(self, heights: Float) -> Float:
        """Return weighted heights (N, K) without their best quadratic surface, robustly."""
        result = weighted = heights * self.weights
        for _ in range(2):
            surface = self._quadratic(result)
            result = np.clip(weighted, surface - 0.35, surface + 0.35)
        return np.asarray(result - self._quadratic(result))

    def correlation(self, heights: Float) -> Float:
        """Return the correlation (N,) of heights (N, K) with the relief; plain surfaces have 0."""
        rest = self.residual(heights)
        return np.asarray(_dot(rest, self.flat) / (np.sqrt(_dot(rest, rest)) + self.soft))

    def step(self, heights: Float, poses: _Poses) -> _Poses:
        """Return better poses for height maps (N, K), by a robust Gauss-Newton step."""
        off = heights - self.heights
        weights = (heights > _FLOOR) * self.weights**2 / (1.0 + (off / 0.2) ** 2)
        systems = _product(weights, self.squares).reshape(-1, 10, 10) + _DAMPING
        change = _solved(systems, _product(weights * off, self.changes))
        return poses.changed(change.clip(-0.3, 0.3))


class _Relief:
    """A relief (count, count) with its bands, and as a map in a disc. The bands of a map are its
    differences of two blurred maps, with weights that are small at holes."""

    def __init__(self, relief: Float) -> None:
        self.count = count = len(relief)
        side = (np.arange(count) + 0.5) * (2.0 * _HALF / count)
        steps = (side[:, None] - side) / np.reshape(_WIDTHS, (2, 2, 1, 1))
        self.blurs = np.round(np.exp(-(steps**2) / 2.0), 9)
        x, y = np.meshgrid(side - _HALF, side - _HALF)
        face = (x * x + y * y < 1.25**2) & (y > -1.1)
        self.masks = face, face & (y > -0.3)  # the face, and the face without mouth and chin
        self.bands = self.bands_of(relief)
        self.disc = x * x + y * y <= _HALF**2
        along, across = np.gradient(relief, side[1] - side[0])
        self.columns = np.stack([relief, across, along])
        weights = np.where(y > -0.35, 1.0, 0.5)[self.disc]
        self.map = _Map(np.stack([x, y])[:, self.disc], self.columns[:, self.disc], weights)

    def on_disc(self, heights: Float) -> Float:
        return np.asarray(np.nan_to_num(heights, nan=_FLOOR)[self.disc])

    def bands_of(self, heights: Float) -> _Bands:
        """Return for each band of a map the differences and the weights."""
        seen = (heights > _FLOOR).astype(np.float64)  # 0 for NaN
        filled, bands = np.where(seen > 0.0, heights, 0.0), []
        for blurs in self.blurs:
            totals = [_product(_product(blur, seen), blur) for blur in blurs]
            fine, broad = (
                _product(_product(blur, filled), blur) / np.maximum(total, 1e-9)
                for blur, total in zip(blurs, totals, strict=True)
            )
            full = blurs[0].sum(axis=0)
            weights = totals[0] / (full[:, None] * full)
            bands.append(((fine - broad).clip(-0.25, 0.25), weights * (weights > 0.3)))
        return bands

    def similarity(self, bands: _Bands) -> tuple[float, float]:
        """Return the mean correlation of bands with the relief's bands, and the amplitude of the
        finest band, 1 as in the relief."""
        results = []
        for mask in self.masks:
            for (band, weights), (relief, known) in zip(bands, self.bands, strict=True):
                weights = weights * known * mask
                share = min(1.0, weights.sum() / (0.6 * (known * mask).sum()))  # that is compared
                weights = weights / max(weights.sum(), 1e-9)
                a, b = (values - (weights * values).sum() for values in (band, relief))
                ab, aa, bb = ((weights * values).sum() for values in (a * b, a * a, b * b))
                results.append((share * ab / math.sqrt(aa * bb + 1e-12), ab / (bb + 1e-9)))
        return sum(value for value, _ in results) / len(results), results[0][1]


@cache
def _reliefs(coarse: bool) -> list[_Relief]:
    """Return the reliefs, with half the resolution if ``coarse``: of the built-in head, and a mean
    with a flatter nose and lower eyes."""
    reliefs = np.load(RELIEFS).astype(np.float64)
    if coarse:
        reliefs = reliefs.reshape(2, _CELLS // 2, 2, _CELLS // 2, 2).mean(axis=(2, 4))
    return [*map(_Relief, reliefs)]


@cache
def _polar() -> tuple[_Map, Float]:
    """Return the first relief at the points of polar maps, ring by ring, and its flat part, which
    correlation uses, for each roll (K, angles)."""
    relief = _reliefs(coarse=True)[0]
    positions = np.stack([np.outer(_RINGS, column).ravel() for column in (_COS, _SIN)])
    cells = ((positions + _HALF) * (relief.count / 2.0 / _HALF)).astype(np.int64)
    column, row = cells.clip(0, relief.count - 1)
    weights = np.repeat(2.0 * np.sqrt(_RINGS / _RINGS[-1]), _ANGLES)
    polar = _Map(positions, relief.columns[:, row, column], weights)
    rings = polar.flat.reshape(-1, _ANGLES)
    return polar, np.stack([np.roll(rings, k, 1).ravel() for k in range(_ANGLES)], axis=1)
