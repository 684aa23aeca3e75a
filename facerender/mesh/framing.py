"""The regions of a mesh that cameras frame: head, face and eyes.

The mesh should have y up, and its face should look along +z. The regions follow from the eyes that
:mod:`facerender.mesh.face` finds on the surface. If it finds no face, as on a doll, they are a
guess: the head is what the names of parts and joints call a head, or else the whole mesh, above
its neck in both cases. Of a mesh without height, all regions are the whole mesh."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facerender.mesh.face import Surface, find_faces
from facerender.mesh.part import Face, Framing, Part, Region, Space
from facerender.values.vectors import Float, Mask

# Regions of a face in distances between the eyes, from the middle of the eyes: lower end, upper end
# and half the width. Source: Farkas (1994), "Anthropometry of the head and face".
_REGIONS = {"eyes": (-0.5, 0.5, 0.85), "face": (-1.775, 1.1, 1.137)}
# Ranges of the head with its hair, to the viewer's right, up and front.
_HEAD = (-2.3, 2.3), (-1.85, 3.2), (-4.1, 1.35)
_MARGIN = 1.095  # with the margin of the view, the face fills 87.5 % of the image
_ROWS = 128  # rows of a front view, in which the neck is narrow
_HEADS = (0.8, 2.0)  # range: height of a head / its size, the geometric mean of width and depth
# Most size of a neck / of the head; least size below / of the neck; least width of shoulders / of
# the rows above.
_NECK, _WIDENED, _SHOULDERS = 0.88, 1.2, 1.55
_RIDGE, _NOSE_ROWS = 0.16, 32  # distance of a nose's sides from its middle / width of the head
_USUAL = {"eyes": (0.4, 0.56), "face": (0.15, 0.9)}  # distance from the crown / height of the head
_SIDE = 0.36  # half the width of a face / height of its head

_WORD = re.compile("[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_HEAD_WORDS = {"head", "face", "skull"}
_HAIR_WORDS = {"braid", "braids", "hair", "ponytail"}
# Words that make the name of a head the name of something else, such as head_light and HeadTop_End.
_NO_HEAD_WORDS = {
    *("band", "cap", "dress", "gear", "hat", "light", "phone", "phones", "rest", "scarf", "set"),
    *("wear", "end", "nub", "top", *_HAIR_WORDS),
}
_EYE_WORDS = {"eye", "eyeball", "eyeballs", "eyes"}


def framing_of(
    parts: Sequence[Part], space: Space, profile: Float, face: Face | None = None
) -> Framing:
    """Find the face of a mesh, unless it is known, and its regions; see :class:`Geometry`."""
    corners = [space.normalised(part.positions)[part.faces] for part in parts]
    surface, source, clear = Surface(np.concatenate(corners)), "", True
    points = np.ascontiguousarray(surface.corners.reshape(-1, 3).T)
    if face is None and (faces := find_faces(surface)):
        clear = len(faces) == 1
        eyes = faces[0].eyes * space.radius + space.center
        face = replace(faces[0], eyes=eyes, eye_distance=faces[0].eye_distance * space.radius)
    if face is not None:
        regions = _of_face(face, space, points)
    else:
        named = np.concatenate([_named(*pair, space) for pair in zip(parts, corners, strict=True)])
        source = "the names of its parts or joints" if named.any() else "its outline"
        chosen = np.flatnonzero(named if named.any() else ~named)
        head = _above_neck(surface.sampled(1 << 15, chosen)[0])
        if head is None:
            mesh = Region(np.zeros(3), *map(float, np.abs(profile).max(axis=0)))
            return Framing(None, dict.fromkeys(("head", "face", "eyes"), mesh) | {"auto": None}, "")
        regions = _guessed(head)
        # A part that is called a head is one if parts are called eyes, or vertices follow a joint
        # that is called a head.
        words = {word for part in parts for word in words_of(part.name)}
        is_head = not _EYE_WORDS.isdisjoint(words) or any(part.head is not None for part in parts)
        clear = _has_nose(head) or (bool(named.any()) and is_head)
    # A mesh is more than a head if its height or width is 1.3 times that of its head.
    largest = 2.0 * 1.3 * np.array([regions["head"].radius, regions["head"].height])
    larger = (np.ptp(points[:2], axis=1) > largest).any()
    return Framing(face, {"auto": regions["head"] if larger and clear else None, **regions}, source)


def _of_face(face: Face, space: Space, points: Float) -> dict[str, Region]:
    """Return the regions of a face, from points (3, N) of the mesh in the renderer's space."""
    middle = space.normalised(face.eyes).mean(axis=0)
    unit = face.eye_distance / space.radius
    away = (points - middle[:, None]) / unit
    inside = np.ones(len(away[0]), dtype=bool)
    for axis, (low, high) in zip(face.axes, _HEAD, strict=True):
        along = away[0] * axis[0] + away[1] * axis[1] + away[2] * axis[2]
        inside &= (along > low) & (along < high)
    regions = {"head": _cylinder(points[:, inside])}
    for name, (low, high, side) in _REGIONS.items():
        height, radius = _MARGIN * (high - low) / 2.0, _MARGIN * side
        if face.up[1] < 0.8:  # the cylinder stays upright, and contains any direction
            height = radius = max(height, radius)
        center = middle + unit * ((low + high) / 2.0 * face.up - radius * face.front)
        regions[name] = Region(center, unit * radius, unit * height)
    return regions


def _cylinder(points: Float) -> Region:
    """Return the upright cylinder that bounds points (3, N)."""
    x, y, z = points
    center = np.array([(c.min() + c.max()) / 2.0 for c in (x, y, z)])
    radius = float(np.hypot(x - center[0], z - center[2]).max())
    return Region(center, radius, float(y.max() - y.min()) / 2.0)


def names_head(name: str) -> bool:
    """Return whether the name of a part or joint has a word for a head, such as ``Wolf3D_Head``."""
    words = words_of(name)
    return not _HEAD_WORDS.isdisjoint(words) and _NO_HEAD_WORDS.isdisjoint(words)


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without digits and separators."""
    return [word.lower() for word in _WORD.findall(name)]


def _named(part: Part, corners: Float, space: Space) -> Mask:
    """Return a mask of a part's triangles that belong to a head by the names in the mesh file.
    Joints restrict named parts, because a part may be a whole body."""
    if part.head is None or not _HAIR_WORDS.isdisjoint(words_of(part.name)):
        return np.full(len(corners), names_head(part.name))
    low, high = space.normalised(part.head)
    return np.asarray(((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high)).all(axis=1))


def _above_neck(points: Float) -> Float | None:
    """Return the points (3, N) above the neck: the narrowest row between the widest row of the head
    and the shoulders. Without a neck, return all points; None if they are flat."""
    x, y, z = points
    extent = float(y.max() - y.min())
    if extent < 1e-6 or x.max() - x.min() < 1e-6 or z.max() - z.min() < 1e-6:
        return None
    step = extent / _ROWS
    rows = ((y.max() - y) / step).astype(np.int64).clip(0, _ROWS - 1)
    ends = np.full((4, _ROWS), -np.inf)
    for end, column in zip(ends, (x, -x, z, -z), strict=True):
        np.maximum.at(end, rows, column)
    wide, deep = (ends[::2] + ends[1::2]).clip(0.0)
    largest, narrowest, neck = 0.0, np.inf, -1
    for row, length in enumerate(np.sqrt(wide * deep)):
        height = (row + 1) * step
        if height < _HEADS[0] * largest or (length > largest and narrowest > _NECK * largest):
            if height > largest > 0.0 and wide[row] > _SHOULDERS * np.median(wide[: row + 1]):
                neck, narrowest = row, 0.0  # shoulders without a visible neck
                break
            largest, narrowest, neck = max(largest, length), np.inf, -1
            continue
        if length < narrowest:
            narrowest, neck = length, row
        visible = narrowest <= _NECK * largest and length > _WIDENED * narrowest
        if height > _HEADS[1] * largest or visible:
            break
    return points[:, rows <= neck] if narrowest <= _NECK * largest else points


def _has_nose(head: Float) -> bool:
    """Return whether the middle of a head with points (3, N) protrudes as a nose does, in the row
    where it protrudes most from its sides and from the front of the other rows."""
    x, y, z = head
    side, middle = _RIDGE * min(np.ptp(x), np.ptp(y)), (x.max() + x.min()) / 2.0
    rows = ((y.max() - y) * (_NOSE_ROWS / max(np.ptp(y), 1e-12))).astype(np.int64)
    fronts = np.full((2, _NOSE_ROWS + 1), -np.inf)
    for front, (near, far) in zip(fronts, ((0.0, 0.4), (0.7, 1.3)), strict=True):
        inside = (np.abs(x - middle) >= near * side) & (np.abs(x - middle) <= far * side)
        np.maximum.at(front, rows[inside], z[inside])
    fronts = fronts[:, np.isfinite(fronts).all(axis=0)]
    count = fronts.shape[1]
    front, beside = fronts[:, count * 3 // 10 : count * 4 // 5]
    if not len(front) or side < 1e-6:
        return False
    ridge = (front - beside) / side
    nose = (np.minimum(ridge, 1.0) + (front - front.max()) / side).argmax()
    return bool(0.35 <= ridge[nose] <= 2.0)


def _guessed(head: Float) -> dict[str, Region]:
    """Return the regions of a head with points (3, N), by usual proportions."""
    region = _cylinder(head)
    top, height = region.center[1] + region.height, 2.0 * region.height
    regions = {"head": region}
    for name, (high, low) in _USUAL.items():
        x, y, z = head
        near = np.abs(x - region.center[0]) < _SIDE * height
        near &= (y < top - high * height) & (y > top - low * height)
        radius = min(_SIDE * height, region.radius)
        front = float(z[near].max()) if near.any() else region.center[2] + radius
        center = np.array([region.center[0], top - (low + high) / 2.0 * height, front - radius])
        regions[name] = Region(center, radius, _MARGIN * (low - high) / 2.0 * height)
    return regions
