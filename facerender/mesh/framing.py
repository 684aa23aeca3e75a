"""Detection of head and face from the names in a mesh file and the geometry of the mesh.

The mesh must have y up, and its face must look along +z.

If the mesh file names parts or joints of a head, the search uses only the surface of these parts or
joints, and then adds the hair and other parts near it. Otherwise it uses the whole surface.

The algorithm scans rows of a front view from the top down, below the thin rows of a tip such as a
strand of hair. The head ends at the neck: the narrowest row between the head's widest row and the
shoulders, if the head's height is then plausible. If hair hides the neck, the head ends at the
shoulders. Without neck and shoulders, the whole surface is the head. If the part above a neck is
small and has no nose, that part is a hair bun, and the head ends at the next neck below. A flat
mesh has no head.

The nose is the row whose middle protrudes most beyond the points on both sides. The chin is the row
below which the front of the face recedes and stays behind. The root of the nose is the row above
the nose that recedes most behind the forehead. The root and the chin determine the hairline by the
proportions of faces (Farkas (1994), "Anthropometry of the head and face"); on a bald skull, the
height of the skull counts as well. If nose, root or chin is not found, as on an egg, the row at the
usual height is used."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.mesh.part import Part, Region, Space
from facerender.mesh.repair import double_areas

Float = NDArray[np.float64]

_SAMPLES, _FACE_SAMPLES = 1 << 16, 1 << 15  # numbers of points on the surface and the face
_ROWS, _FACE_ROWS = 256, 96  # number of rows for the whole mesh, and for its head
# Ratios of lengths. The size of a row is the geometric mean of its width and depth.
_SHOULDERS = 1.55  # minimum: width of the shoulders / width of the head
# Maximum: size of the neck / size of the head. Minimum: size below the neck / size of the neck.
_NECK, _WIDENED = 0.88, 1.2
_TIP = 0.05  # maximum: size of a tip above the head, such as a strand of hair / largest size
_HEAD = (0.8, 2.0)  # range: height of the head / size of the head
_BREADTH = 0.75  # maximum: width of the head / height of the head; wider hair is ignored
_NOSE = (0.3, 0.82)  # range: distance from the top of the head to the nose / height of the head
_USUAL_NOSE = 0.6
_RIDGE = 0.16  # distance from the middle to the nose's sides / width of the head
# Minimum and maximum: protrusion of a nose / distance from the middle to the nose's sides. Between
# rows with at least the protrusion _RIDGE_MOST, only the depth decides.
_RIDGE_LEAST, _LONGEST, _RIDGE_MOST = 0.35, 2.0, 1.0
_CHIN = (0.3, 1.25)  # range: distance from nose to chin / from the top of the head to the nose
_USUAL_CHIN = 0.52
# Distances below the chin at which the front is behind the chin by the depth of the neck, and
# recession of the front at the chin, all / height of the head.
_BELOW, _NECK_DEPTH, _FALL = (0.04, 0.12), 0.06, 0.03
_ROOT, _USUAL_ROOT = 0.8, 0.5  # maximum: distance from nose to its root / from nose to chin
# Distance from the root of the nose to the hairline / to the chin; from the crown to the hairline
# / to the chin; from the middle to the face's sides / from nose to chin.
_HAIRLINE, _CROWN, _SIDE = 0.575, 0.2, 0.95
_MARGIN = 1.095  # with the margin of the view, the face fills 87.5 % of the image
_SKULL = 0.28  # minimum: recession of the crown behind the nose / height of the head
_MOST_HEADS = 2  # candidates for the head: a hair bun, and the head below the bun
_HOLE = 0.1  # maximum: height of a hole / height of the mesh
_BUN = 0.35  # maximum: height of a hair bun / height of bun and head
# Limits of the surface that the search for nose and chin needs: distance to each side of the middle
# / height of the head, and fraction of the head's surface that is behind this surface.
_NEAR, _BEHIND = 0.16, 0.2
# Limits of hair and other parts: distance above the head, to each side of its middle, behind its
# front, and before its front, all / height of the head.
_ABOVE, _BESIDE, _BACK, _BEFORE = 0.35, 0.62, 1.3, 0.15
_LARGER = 1.3  # minimum: height or width of a mesh that is more than a head / of its head
_SECOND = 0.5  # minimum: surface of a second head / surface of the head

_NAME_WORDS = re.compile("[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_HEAD_WORDS = {"head", "face", "skull"}
# Words that make the name of a head the name of something else, such as head_light and HeadTop_End.
_OTHER_WORDS = {
    *("band", "cap", "dress", "gear", "hat", "light", "phone", "phones", "rest", "scarf", "set"),
    *("wear", "end", "nub", "top"),
}
_EYE_WORDS = {"eye", "eyeball", "eyeballs", "eyes"}
_HAIR_WORDS = {"braid", "braids", "hair", "ponytail"}


class _Head(NamedTuple):
    """A head in the renderer's space."""

    points: Float  # (N, 3), on the surface
    chin: float  # height of the chin
    face: Region
    has_nose: bool


def regions_of(parts: Sequence[Part], space: Space, profile: Float) -> Mapping[str, Region | None]:
    """Return the regions "head", "face" and "auto" of a geometry.

    "auto" is the head if a head is found and the mesh is clearly larger than the head. Otherwise
    "auto" is None, which means the whole mesh. If the mesh is flat, "head" and "face" are the whole
    mesh.

    parts, space, profile : see :class:`facerender.mesh.geometry.Geometry`
    """
    surface = _Surface(parts, space)
    points = surface.points(surface.all, _SAMPLES)
    named, clear = surface.named(), False
    head: _Head | None = None
    for chosen in (named, surface.all) if named.any() else (surface.all,):
        chosen_points = points if chosen.all() else surface.points(chosen, _SAMPLES)
        if (candidate := _head(surface, chosen, chosen_points)) is not None:
            clear = candidate.has_nose or (chosen is named and _is_clear(parts))
            head = candidate if clear or head is None else head
        if clear:
            break
    if head is None:
        region = Region(np.zeros(3), *map(float, np.abs(profile).max(axis=0)))
        return {"auto": None, "head": region, "face": region}
    region = _region(_with_hair(np.concatenate([points, head.points]), head.points))
    wide, high = float(np.ptp(points[:, 0])), float(np.ptp(points[:, 1]))
    larger = wide > 2.0 * _LARGER * region.radius or high > 2.0 * _LARGER * region.height
    larger = larger and clear and not _has_second(surface, head)
    return {"auto": region if larger else None, "head": region, "face": head.face}


def names_head(name: str) -> bool:
    """Return whether the name of a part or joint has a word for a head, such as ``Wolf3D_Head``."""
    words = _words(name)
    return not _HEAD_WORDS.isdisjoint(words) and words.isdisjoint(_OTHER_WORDS | _HAIR_WORDS)


def _words(name: str) -> set[str]:
    return {word.lower() for word in _NAME_WORDS.findall(name)}


def _is_clear(parts: Sequence[Part]) -> bool:
    """Return whether a part that is called a head needs no nose: it follows a joint that is also
    called a head, or other parts are called eyes."""
    words = {word for part in parts for word in _words(part.name)}
    return not _EYE_WORDS.isdisjoint(words) or any(part.head is not None for part in parts)


class _Surface:
    """The triangles of a mesh: corners (F, 3, 3) in mesh space, bounds low and high (F, 3) in the
    renderer's space, index of the part (F,), and a mask of all triangles (F,)."""

    def __init__(self, parts: Sequence[Part], space: Space) -> None:
        self.parts, self.space = parts, space
        self.corners = np.concatenate([part.positions[part.faces] for part in parts])
        a, b, c = np.moveaxis(self.corners, 1, 0)
        self.areas = double_areas(self.corners)
        self.areas /= self.areas.max() or 1.0  # all are 0 in a mesh without height
        self.low = space.normalised(np.minimum(np.minimum(a, b), c))
        self.high = space.normalised(np.maximum(np.maximum(a, b), c))
        counts = [len(part.faces) for part in parts]
        self.owners = np.repeat(np.arange(len(counts)), counts)
        self.all = np.ones(len(self.corners), dtype=bool)

    def points(self, chosen: NDArray[np.bool_], count: int) -> Float:
        """Return points of uniform density on the triangles in a mask (F,): (count, 3), in the
        renderer's space."""
        steps = np.cumsum(np.where(chosen, self.areas, 0.0))
        index = np.arange(count) + 0.5
        triangle = np.searchsorted(steps, index * (steps[-1] / count))
        # Roberts' sequence fills a square evenly. The half with u + v > 1 is folded onto the other.
        u, v = (np.modf(index * step)[0] for step in (0.7548776662466927, 0.5698402909980532))
        folded = u + v > 1.0
        u[folded], v[folded] = 1.0 - u[folded], 1.0 - v[folded]
        shares = np.stack([1.0 - u - v, u, v], axis=1)
        return self.space.normalised(np.einsum("nk,nki->ni", shares, self.corners[triangle]))

    def within(self, low: Float, high: Float) -> NDArray[np.bool_]:
        """Return a mask of the triangles whose bounds overlap a box."""
        return np.asarray(((self.high >= low) & (self.low <= high)).all(axis=1))

    def named(self) -> NDArray[np.bool_]:
        """Return a mask of the triangles that belong to a head by the names in the mesh file.
        Joints restrict named parts, because a part may be a whole body."""
        named = [names_head(part.name) for part in self.parts]
        chosen = np.zeros(len(self.corners), dtype=bool)
        for number, part in enumerate(self.parts):
            hair = not _words(part.name).isdisjoint(_HAIR_WORDS)
            if not named[number] and (any(named) or hair or part.head is None):
                continue
            mask = self.owners == number
            if part.head is not None:
                low, high = self.space.normalised(part.head)
                mask &= self.within(low, high)
            chosen |= mask
        return chosen


def _head(surface: _Surface, chosen: NDArray[np.bool_], points: Float) -> _Head | None:
    """Return the head that the triangles in a mask (F,), with points (N, 3) on them, contain; None
    if they are flat."""
    middle = float(np.median(points[:, 0]))
    body = points[_connected(points[:, 0] - middle, _rows(points[:, 1], _ROWS)[0])]
    if len(body) < 3 or np.ptp(body[:, 1]) < 1e-6:
        return None
    top = float(body[:, 1].max())
    choice: tuple[float, Region, float, bool] | None = None
    for neck, middle in _ends(body):
        head, reach = body[body[:, 1] >= neck], _NEAR * (top - neck)
        low = np.array((middle - reach, 2.0 * neck - top, np.quantile(head[:, 2], _BEHIND)))
        near = surface.within(low, np.array((middle + reach, top, np.inf)))
        front = surface.points(chosen & near, _FACE_SAMPLES)
        candidate = (neck, *_face(head, front, neck, middle))
        bun = choice and candidate[3] and top - choice[0] < _BUN * (top - neck)
        choice = candidate if choice is None or bun else choice
        if choice[3]:
            break
    if choice is None:
        return None
    neck, face, chin, has_nose = choice
    return _Head(body[body[:, 1] >= min(neck, chin)], chin, face, has_nose)


def _with_hair(points: Float, head: Float) -> Float:
    """Return the points of a mesh that are in the head's neighbourhood: hair, but neither arms nor
    long ponytails. If these are fewer than half of the head's points, return the head."""
    low, high = head.min(axis=0), head.max(axis=0)
    middle, height = (low[0] + high[0]) / 2.0, high[1] - low[1]
    x, y, z = points.T
    near = (y >= low[1]) & (y <= high[1] + _ABOVE * height)
    near &= np.abs(x - middle) <= _BESIDE * height
    near &= (z >= high[2] - _BACK * height) & (z <= high[2] + _BEFORE * height)
    return points[near] if 2 * near.sum() >= len(head) else head


def _has_second(surface: _Surface, head: _Head) -> bool:
    """Return whether the mesh has another head next to the given one."""
    low, high = head.points[:, 0].min(), head.points[:, 0].max()
    above = surface.low[:, 1] >= head.chin
    beside = above & ((surface.high[:, 0] < low) | (surface.low[:, 0] > high))
    if surface.areas[beside].sum() < _SECOND * surface.areas[above & ~beside].sum():
        return False
    second_head = _head(surface, beside, surface.points(beside, _SAMPLES))
    return second_head is not None and second_head.has_nose


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
    extents[:, [0, -1]] = extents[:, [1, -2]]  # few points are in the first and the last row
    size = np.sqrt(extents[0] * extents[1])
    if not size.any():
        return  # flat
    start = int((size > _TIP * size.max()).argmax())
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
    excludes hands and other parts at the side of the body. A low hole, such as an open mouth, is no
    gap."""
    cells = 64  # number of cells in each half of a row
    extent = float(np.abs(x).max()) or 1.0
    place = (np.abs(x) * (cells / extent)).astype(np.int64).clip(0, cells - 1)
    side = (x > 0.0).astype(np.int64)
    covered = np.zeros((2, _ROWS, cells + 1), dtype=bool)
    covered[side, rows, place] = True
    every = np.arange(_ROWS)[:, None]
    above = np.maximum.accumulate(np.where(covered, every, -_ROWS), axis=1)
    below = np.minimum.accumulate(np.where(covered, every, 2 * _ROWS)[:, ::-1], axis=1)[:, ::-1]
    covered |= below - above <= _HOLE * _ROWS
    covered[..., :2] = True
    empty = ~covered[..., :-1] & ~covered[..., 1:]
    gap = np.where(empty.any(axis=-1), empty.argmax(axis=-1), cells)
    return np.asarray(place <= gap[side, rows])


def _neck(wide: Float, size: Float, step: float) -> int:
    """Return the index of the row at which the head ends. ``wide`` is the width of each row, from
    the top down, and ``size`` the geometric mean of each row's width and depth."""
    largest, narrowest, neck = 0.0, np.inf, -1
    for row, row_size in enumerate(size):
        height = (row + 1) * step
        if height < _HEAD[0] * largest or (row_size > largest and narrowest > _NECK * largest):
            if height > largest > 0.0 and wide[row] > _SHOULDERS * np.median(wide[: row + 1]):
                return row  # shoulders without a visible neck
            largest, narrowest, neck = max(largest, row_size), np.inf, -1
            continue
        if row_size < narrowest:
            narrowest, neck = row_size, row
        if height > _HEAD[1] * largest or (
            narrowest <= _NECK * largest and row_size > _WIDENED * narrowest
        ):
            break
    return neck if narrowest <= _NECK * largest else len(size) - 1


def _face(head: Float, body: Float, neck: float, middle: float) -> tuple[Region, float, bool]:
    """Return the region of a head's face, the height of the chin, and whether a nose was found.

    head, body : points of the head, and more points in the middle of the head and below
    neck, middle : height of the lower end of the head, and x of its middle
    """
    high = float(head[:, 1].max())
    step = (high - neck) / _FACE_ROWS
    wide = min(float(np.ptp(head[:, 0])), _BREADTH * _FACE_ROWS * step)
    front, ridge = _front(body, middle, high, step, _RIDGE * wide or step)
    first, last = (int(fraction * _FACE_ROWS) for fraction in _NOSE)
    depth = front[first:last]
    out = np.minimum(ridge[first:last], _RIDGE_MOST)
    nose = first + int((out + (depth - depth.max()) / (_RIDGE * wide or step)).argmax())
    has_nose = bool(_RIDGE_LEAST <= ridge[nose] <= _LONGEST)
    if not has_nose:
        nose = int(_USUAL_NOSE * _FACE_ROWS)
    chin = _chin(front, nose, step)
    hairline = _hairline(front, nose, chin, step)
    height = (chin - hairline) * step / 2.0
    radius = _MARGIN * min(_SIDE * (chin - nose) * step, wide / 2.0)
    end_depths = np.interp((hairline, chin), np.arange(len(front)), front)
    center = np.array([middle, high - chin * step + height, end_depths.mean() - radius])
    return Region(center, radius, _MARGIN * height), high - chin * step, has_nose


def _front(body: Float, middle: float, top: float, step: float, side: float) -> tuple[Float, Float]:
    """Return two depth profiles of a face: a value per row from the top down, also below the head.

    Returns
    -------
    front : largest z near the middle
    ridge : protrusion of the middle beyond points at the distance ``side``, divided by ``side``
    """
    count = 2 * _FACE_ROWS
    rows = np.floor((top - body[:, 1]) / step).astype(np.int64)
    away = np.abs(body[:, 0] - middle)
    every, columns = np.arange(count), []
    for near, far in ((0.0, 0.4), (0.7, 1.3)):
        column = np.full(count, -np.inf)
        inside = (away >= near * side) & (away <= far * side) & (rows >= 0) & (rows < count)
        np.maximum.at(column, rows[inside], body[inside, 2])
        if not (filled := np.isfinite(column)).any():
            column, filled = np.full(count, body[:, 2].max()), np.full(count, True)
        columns.append(np.interp(every, every[filled], column[filled]))
    front, sides = columns
    min_rows = int(_NOSE[1] * _FACE_ROWS)
    return front[: max(rows.max() + 1, min_rows)], (front - sides) / side


def _chin(front: Float, nose: int, step: float) -> float:
    """Return the chin's distance from the top in rows. Above the chin, in a range below the nose,
    the front recedes and stays behind; the end of the mesh also counts. The chin is the place where
    the front has receded a little. Return the usual distance if no row recedes."""
    first, last = (nose + round(fraction * nose) for fraction in _CHIN)
    height = _FACE_ROWS * step
    near, far = (round(fraction * _FACE_ROWS) for fraction in _BELOW)
    ended = np.concatenate([front, np.full(far + 1, -np.inf)])
    for row in range(first, min(last, len(front))):
        if front[row] - ended[row + near : row + far + 1].max() < _NECK_DEPTH * height:
            continue
        limit = front[row - near : row + 1].max() - _FALL * height
        end = row + int((ended[row:] < limit).argmax())
        down = max(ended[end - 1] - ended[end], 1e-9)
        return end - 0.5 + float(np.clip((ended[end - 1] - limit) / down, 0.0, 0.5))
    return min(nose + _USUAL_CHIN * nose, len(front))


def _hairline(front: Float, nose: int, chin: float, step: float) -> float:
    """Return the hairline's distance from the top in rows."""
    first = max(nose - int(_ROOT * (chin - nose)), 0)
    behind = np.maximum.accumulate(front[first : nose + 1]) - front[first : nose + 1]
    weights = np.maximum(behind - behind.max() / 2.0, 0.0)
    root = nose - _USUAL_ROOT * (chin - nose)
    if weights.any():
        root = first + 0.5 + float(np.average(np.arange(len(weights)), weights=weights))
    row = root - _HAIRLINE * (chin - root)
    if front[nose] - front[1] >= _SKULL * _FACE_ROWS * step:
        row = max(row, (row + 2.0 * _CROWN * chin) / 3.0)
    return max(row, 0.0)
