"""Poses of a mesh: check the weights, the clip and the time, evaluate the rigs of its parts, and
complete the normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range, check_type, clipped, shown, warn
from facerender.scenes.repair import area_normals, stacked, used
from facerender.scenes.rig import Clip, Float, Moves, Rig
from facerender.scenes.vectors import MOST_RADII

if TYPE_CHECKING:
    from facerender.scenes.mesh import Mesh, Part

_MOST_WEIGHT = 100.0  # largest absolute weight that a caller may give
_MOST_NAMES = 300  # characters of the names in a message

# Keyed by the first rig: faces of the parts, result of _welded.
_Weld = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]
_welds: WeakKeyDictionary[Rig, tuple[list[NDArray[Any]], _Weld]] = WeakKeyDictionary()


def posed(
    mesh: Mesh, weights: Mapping[str, float] | None, clip: str | None, time: float | None
) -> tuple[list[Float], list[Float]]:
    """Return positions and normals of each part in a pose; see :meth:`Mesh.with_pose`."""
    rigs = [part.rig for part in mesh.parts]
    skeleton = next((each.skeleton for each in rigs if each is not None), None)
    if skeleton is None:
        raise InputError(f"{mesh.name} has no shapes and no clips: give a glTF file with a rig")
    given = _checked(mesh, weights)
    chosen = _chosen(mesh, skeleton.clips, clip, time)
    moves: Moves = {}
    if chosen is not None:
        moves = chosen.at(0.0 if time is None else float(time))
        if chosen.ignored:
            warn(
                f"clip {shown(chosen.name)} of {mesh.name} has channels of {chosen.ignored}: "
                "ignored"
            )
    with np.errstate(all="ignore"):
        return _evaluated(mesh, rigs, given, moves)


def shapes_of(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return the names of the parts' shapes without repetitions."""
    rigs = (part.rig for part in parts if part.rig is not None)
    return tuple(dict.fromkeys(shape.name for rig in rigs for shape in rig.shapes))


def clips_of(parts: Sequence[Part]) -> tuple[Clip, ...]:
    """Return all clips, also damaged ones."""
    return next((part.rig.skeleton.clips for part in parts if part.rig is not None), ())


def _checked(mesh: Mesh, weights: Mapping[str, float] | None) -> dict[str, float]:
    check_type("weights", weights, Mapping | None, "a mapping from names of shapes to numbers")
    known = shapes_of(mesh.parts)
    for name, weight in (weights or {}).items():
        if name not in known:
            raise InputError(
                f"{mesh.name} has no shape {shown(name)}: {_known('shapes', list(known))}"
            )
        check_range(f"weight of {shown(name)}", weight, -_MOST_WEIGHT, _MOST_WEIGHT)
    return {name: float(weight) for name, weight in (weights or {}).items()}


def _known(kind: str, names: Sequence[str]) -> str:
    return (
        f"its {kind} are {clipped(', '.join(names), _MOST_NAMES)}" if names else f"it has no {kind}"
    )


def _chosen(mesh: Mesh, clips: Sequence[Clip], name: str | None, time: float | None) -> Clip | None:
    """Return the clip of a name, or the first clip if only a time is given."""
    if name is None and time is None:
        return None
    check_type("clip", name, str | None, "the name of a clip")
    found = [each for each in clips if name in (None, each.name)]
    if not found:
        problem = f"time = {shown(time)} needs a clip" if name is None else f"clip = {shown(name)}"
        raise InputError(
            f"{problem}, which {mesh.name} lacks: {_known('clips', [each.name for each in clips])}"
        )
    if found[0].fault:
        raise InputError(
            f"clip {shown(found[0].name)} of {mesh.name} is damaged ({found[0].fault}); export it "
            "again"
        )
    if time is not None:
        check_range(f"time of clip {shown(found[0].name)}", time, 0.0, found[0].duration)
    return found[0]


def _evaluated(
    mesh: Mesh, rigs: Sequence[Rig | None], given: Mapping[str, float], moves: Moves
) -> tuple[list[Float], list[Float]]:
    skeleton = next(each.skeleton for each in rigs if each is not None)
    worlds = skeleton.worlds(moves)
    positions, normals, behind = [], [], []
    lags = False
    for part, rig in zip(mesh.parts, rigs, strict=True):
        places, turned = part.positions, part.normals
        behind.append(places)
        if rig is not None:
            weights = _weights(rig, given, moves)
            places, turned = _posed(mesh, part, rig, worlds, weights)
            behind[-1] = places
            if (lagging := rig.lagging(weights)) != weights:
                lags = True
                behind[-1], _ = replace(rig, normals=None).posed(worlds, lagging)
        positions.append(places)
        normals.append(turned)
    return positions, _following(mesh, positions, behind, normals) if lags else normals


def _weights(rig: Rig, given: Mapping[str, float], moves: Moves) -> list[float]:
    """Return a weight for each shape: given, or of the clip, or stored."""
    weights = list(moves.get(rig.node, {}).get("weights", rig.weights))
    weights += [0.0] * (len(rig.shapes) - len(weights))
    return [
        given.get(shape.name, weight) for shape, weight in zip(rig.shapes, weights, strict=False)
    ]


def _posed(
    mesh: Mesh, part: Part, rig: Rig, worlds: Mapping[int, Float], weights: Sequence[float]
) -> tuple[Float, Float]:
    """Return positions and unit normals of a part. Vertices that no face uses do not move: the
    loader may have moved them."""
    try:
        places, normals = rig.posed(worlds, weights)
    except ValueError as error:
        raise InputError(f"a shape of {mesh.name} is damaged ({error}); export it again") from None
    unused = ~used(places, part.faces)
    if unused.any():
        places[unused] = part.positions[unused]
    far = float(np.abs(places - mesh.center).max()) / mesh.radius
    if not far <= MOST_RADII:
        raise InputError(
            f"the pose moves vertices of {mesh.name} to {far:.3g} mesh radii from its centre: "
            f"give weights, a clip or a time within {MOST_RADII:g} radii"
        )
    return places, part.normals if normals is None else _unit(normals, part.normals)


def _unit(vectors: Float, otherwise: Float) -> Float:
    """Return unit vectors; a vector whose length is 0 or not finite is replaced."""
    x, y, z = vectors.T
    length = np.sqrt(x * x + y * y + z * z)  # the bits of np.linalg.norm in less time
    good = np.isfinite(length) & (length > 0.0)
    unit: Float = vectors / length[:, None]
    if not good.all():
        unit[~good] = otherwise[~good]
    return unit


def _following(
    mesh: Mesh, positions: Sequence[Float], behind: Sequence[Float], normals: Sequence[Float]
) -> list[Float]:
    """Return normals that follow shapes without own normals. A normal changes by the difference of
    the face normals around its position with and without these shapes.

    Parameters
    ----------
    positions : (N, 3) for each part
    behind : positions of the same pose in which these shapes have their stored weights
    """
    corners, welded_corners, welded = _welded(mesh)
    after, before = (
        area_normals(np.concatenate(each), corners, welded_corners) for each in (positions, behind)
    )
    change = (after - before)[welded]
    ends = np.cumsum([len(each) for each in positions])[:-1]
    return [
        _unit(own + step, own) for own, step in zip(normals, np.split(change, ends), strict=True)
    ]


def _welded(mesh: Mesh) -> _Weld:
    """Return the corners of all faces (3, F) as indices of the vertices of all parts and as indices
    of their positions in the stored pose, and the latter index for each vertex. Parts may share
    positions."""
    rigs = [part.rig for part in mesh.parts]
    first = next(rig for rig in rigs if rig is not None)
    faces = [part.faces for part in mesh.parts]
    known, found = _welds.get(first, ([], None))
    if found is None or [*map(id, known)] != [*map(id, faces)]:
        worlds = first.skeleton.worlds({})
        stored = [
            part.positions if rig is None else rig.posed(worlds, rig.stored_weights)[0]
            for part, rig in zip(mesh.parts, rigs, strict=True)
        ]
        _, corners, welded, _ = stacked(stored, faces)
        corners = np.ascontiguousarray(corners.T)
        found = corners, welded[corners], welded
        _welds[first] = faces, found
    return found
