"""Detection of head and face from the geometry of a mesh.

The mesh must have y up, and its face must look along +z.

The algorithm scans rows of a front view from the top down. The head ends at the neck: the narrowest
row between the head's widest row and the shoulders, if the head's height is then plausible. If hair
hides the neck, the head ends at the shoulders. Without neck and shoulders, the whole mesh is the
head. If the part above a neck is small and has no nose, that part is a hair bun, and the head ends
at the next neck below.

The nose is the row whose middle protrudes most beyond the points on both sides. The chin is the row
below which the front of the face recedes. Nose and chin determine the hairline and the sides of the
face by the proportions of faces (Farkas (1994), "Anthropometry of the head and face"). If nose or
chin is not found, as on an egg, the row at the usual height is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.scenes.mesh import Mesh, Region

Float = NDArray[np.float64]

_SAMPLES = 300_000  # approximate number of points on the surface
_ROWS, _FACE_ROWS = 256, 96  # number of rows for the whole mesh, and for its head
# Ratios of lengths. The size of a row is the geometric mean of its width and depth.
_SHOULDERS = 1.55  # minimum: width of the shoulders / width of the head
# Maximum: size of the neck / size of the head. Minimum: size below the neck / size of the neck.
_NECK, _WIDENED = 0.88, 1.2
_HEAD = (0.8, 2.0)  # range: height of the head / size of the head
_BREADTH = 0.75  # maximum: width of the head / height of the head; wider hair is ignored
_NOSE = (0.3, 0.82)  # range: distance from the top of the head to the nose / height of the head
_USUAL_NOSE = 0.6
_RIDGE = 0.16  # distance from the middle to the nose's sides / width of the head
# Range: protrusion of the nose / distance from the middle to the nose's sides.
_RIDGE_LEAST, _RIDGE_MOST = 0.35, 1.0
_CHIN = (0.3, 0.95)  # range: distance from nose to chin / from the top of the head to the nose
_USUAL_CHIN = 0.52
# Minimum: recession within three rows below the chin / distance from middle to nose's sides.
_FALL = 0.4
# Distances from nose to hairline and from middle to face's sides, both / from nose to chin.
_HAIRLINE, _SIDE = 1.35, 0.95
_MARGIN = 1.1
_MOST_HEADS = 2  # candidates for the head: a hair bun, and the head below the bun
_BUN = 0.35  # maximum: height of a hair bun / height of bun and head

_known: WeakKeyDictionary[Mesh, Mapping[str, Region]] = WeakKeyDictionary()


def find_regions(mesh: Mesh) -> Mapping[str, Region]:
    """Return the regions "head" and "face" of a mesh; results are cached. If the mesh has
    no height, both regions are the whole mesh."""
    if mesh.regions is not None:
        return mesh.regions
    if mesh not in _known:
        _known[mesh] = _found(_surface(mesh))
    return _known[mesh]


def _surface(mesh: Mesh) -> Float:
    """Return points on the surface, (N, 3), in the renderer's space. The points have uniform
    density, with at least one point per triangle."""
    corners = np.concatenate([mesh.normalised(part.positions[part.faces]) for part in mesh.parts])
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    total = float(areas.sum())
    counts = 1 + (areas * (_SAMPLES / total if total > 0.0 else 0.0)).astype(np.int64)
    triangle = np.repeat(np.arange(len(corners)), counts)
    index = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
    # Roberts' sequence fills a square evenly. The half with u + v > 1 is folded onto the other.
    u, v = np.modf((index[:, None] + 0.5) * (0.7548776662466927, 0.5698402909980532))[0].T
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u)[:, None], np.where(over, 1.0 - v, v)[:, None]
    places: Float = a[triangle] + u * (b - a)[triangle] + v * (c - a)[triangle]
    return places


def _found(points: Float) -> dict[str, Region]:
    middle = float(np.median(points[:, 0]))
    body = points[_connected(points[:, 0] - middle, _rows(points[:, 1], _ROWS)[0])]
    if len(body) < 3 or np.ptp(body[:, 1]) < 1e-6:  # no height
        return dict.fromkeys(("head", "face"), _region(points))
    found = [(neck, *_face(body, neck, middle)) for neck, middle in _ends(body)]
    first, last, top = found[0], found[-1], float(body[:, 1].max())
    bun = last[3] and not first[3] and top - first[0] < _BUN * (top - last[0])
    neck, face, chin, _ = last if bun else first
    return {"head": _region(body[body[:, 1] >= min(neck, chin)]), "face": face}


def _rows(y: Float, count: int) -> tuple[NDArray[np.int64], float]:
    """Return the row index of each height y, from 0 at the top, and the height of one row."""
    step = float(np.ptp(y)) / count or 1.0
    return ((y.max() - y) / step).astype(np.int64).clip(0, count - 1), step


def _region(points: Float) -> Region:
    """Return the upright cylinder that bounds points."""
    # Reduces each column separately, because numpy's reduction over axis 0 takes 80 times as long.
    low, high = (np.array([end(column) for column in points.T]) for end in (np.min, np.max))
    center = (low + high) / 2.0
    radius = float(np.hypot(*(points - center)[:, [0, 2]].T).max())
    return Region(center, radius, float(high[1] - low[1]) / 2.0)


def _ends(points: Float) -> Iterator[tuple[float, float]]:
    """Yield, for each possible head, the height of its lower end and the x of its middle."""
    rows, step = _rows(points[:, 1], _ROWS)
    low, high = np.full((2, _ROWS), np.inf), np.full((2, _ROWS), -np.inf)
    for axis, column in enumerate((0, 2)):
        np.minimum.at(low[axis], rows, points[:, column])
        np.maximum.at(high[axis], rows, points[:, column])
    filled = np.isfinite(low[0])
    extents = np.subtract(high, low, out=np.zeros_like(low), where=filled)
    extents[:, 1:-1] = np.median([extents[:, i : i + _ROWS - 2] for i in range(3)], axis=0)
    size, start = np.sqrt(extents[0] * extents[1]), 0
    for _ in range(_MOST_HEADS):
        end = start + _neck(extents[0, start:], size[start:], step)
        above = filled & (np.arange(_ROWS) <= end) & (np.arange(_ROWS) >= start)
        if not above.any():
            return
        middle = float(np.median(low[0, above] + high[0, above])) / 2.0
        yield float(points[:, 1].max()) - (end + 1) * step, middle
        start = end + 1


def _connected(x: Float, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the points that no gap separates from the middle of their row. The mask
    excludes hands and other parts at the side of the body."""
    cells = 64  # number of cells in each half of a row
    extent = float(np.abs(x).max()) or 1.0
    place = (np.abs(x) * (cells / extent)).astype(np.int64).clip(0, cells - 1)
    side = (x > 0.0).astype(np.int64)
    covered = np.zeros((2, _ROWS, cells + 1), dtype=bool)
    covered[side, rows, place] = True
    covered[..., :2] = True
    empty = ~covered[..., :-1] & ~covered[..., 1:]
    first = np.where(empty.any(axis=-1), empty.argmax(axis=-1), cells)
    return np.asarray(place <= first[side, rows])


def _neck(wide: Float, size: Float, step: float) -> int:
    """Return the index of the row at which the head ends.

    wide : width of each row, from the top down
    size : geometric mean of each row's width and depth
    """
    largest, narrowest, at = 0.0, np.inf, -1
    for row, own in enumerate(size):
        height = (row + 1) * step
        if height < _HEAD[0] * largest or (own > largest and narrowest > _NECK * largest):
            if height > largest > 0.0 and wide[row] > _SHOULDERS * np.median(wide[: row + 1]):
                return row  # shoulders without a visible neck
            largest, narrowest, at = max(largest, own), np.inf, -1
            continue
        if own < narrowest:
            narrowest, at = own, row
        if height > _HEAD[1] * largest or (
            narrowest <= _NECK * largest and own > _WIDENED * narrowest
        ):
            break
    return at if narrowest <= _NECK * largest else len(size) - 1


def _face(body: Float, neck: float, middle: float) -> tuple[Region, float, bool]:
    """Return the region of a head's face, the height of the chin, and whether a nose was found.

    neck : height of the lower end of the head
    """
    head = body[body[:, 1] >= neck]
    high = float(head[:, 1].max())
    step = (high - neck) / _FACE_ROWS
    wide = min(float(np.ptp(head[:, 0])), _BREADTH * _FACE_ROWS * step)
    side = _RIDGE * wide or step
    front, ridge = _front(body, middle, high, step, side)
    first, last = (int(fraction * _FACE_ROWS) for fraction in _NOSE)
    depth = front[first:last]
    out = np.minimum(ridge[first:last], _RIDGE_MOST) + (depth - depth.max()) / side
    nose = first + int(out.argmax())
    has_nose = bool(ridge[nose] >= _RIDGE_LEAST)
    if not has_nose:
        nose = int(_USUAL_NOSE * _FACE_ROWS)
    chin = _chin(front, nose, _FALL * side)
    down = (chin - nose) * step
    bottom, above = high - (chin + 1) * step, high - (nose + 0.5) * step + _HAIRLINE * down
    height, radius = (min(above, high) - bottom) / 2.0, min(_SIDE * down, wide / 2.0)
    center = np.array([middle, bottom + height, front[nose] - radius])
    return Region(center, _MARGIN * radius, _MARGIN * height), bottom, has_nose


def _front(body: Float, middle: float, top: float, step: float, side: float) -> tuple[Float, Float]:
    """Return two depth profiles of a face: a value per row from the top down, also below the head.

    Returns
    -------
    front : largest z near the middle
    ridge : protrusion of the middle beyond points at the distance ``side``, divided by ``side``
    """
    count = 2 * _FACE_ROWS
    rows = ((top - body[:, 1]) / step).astype(np.int64)
    away = np.abs(body[:, 0] - middle)
    every, columns = np.arange(count), []
    for near, far in ((0.0, 0.4), (0.7, 1.3)):
        column = np.full(count, -np.inf)
        there = (away >= near * side) & (away <= far * side) & (rows < count)
        np.maximum.at(column, rows[there], body[there, 2])
        filled = np.isfinite(column)
        columns.append(
            np.interp(every, every[filled], column[filled])
            if filled.any()
            else np.full(count, body[:, 2].max())
        )
    front, sides = columns
    return front[: rows.max() + 1], (front - sides) / side


def _chin(front: Float, nose: int, fall: float) -> int:
    """Return the index of the chin's row: the first row, in a range below the nose, from which the
    front recedes by ``fall`` within three rows. Return the usual row if no row recedes."""
    usual, first, last = (
        min(nose + round(fraction * nose), len(front) - 1) for fraction in (_USUAL_CHIN, *_CHIN)
    )
    falls = front[first : last - 2] - front[first + 3 : last + 1]
    found = np.flatnonzero(falls >= fall)
    return first + 1 + int(found[0]) if len(found) else usual
