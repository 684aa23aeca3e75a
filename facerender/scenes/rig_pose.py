"""Poses by a mesh's rig: check the weights, the clip and the time, evaluate the rigs of the parts,
and complete the normals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from facerender.errors import InputError, check_range, check_type, clipped, shown, warn
from facerender.scenes.normals import Corners
from facerender.scenes.repair import used
from facerender.scenes.rig import Clip, Float, Moves, Rig
from facerender.scenes.vectors import MOST_RADII, SHAPE_WEIGHTS, unit

if TYPE_CHECKING:
    from facerender.scenes.mesh import Mesh, Part

_Rows = list[Float | None]

_MOST_NAMES = 300  # characters of the names in a message


def posed(
    rest: Mesh,
    corners: Callable[[], Corners],
    weights: Mapping[str, float] | None,
    clip: str | None,
    time: float | None,
) -> tuple[_Rows, _Rows]:
    """Return positions and normals of each part of a mesh in a pose; None for a part in its stored
    pose. The normals have any length.

    Parameters
    ----------
    rest : the mesh in the reference pose
    corners : returns the corners of the mesh
    weights, clip, time : see :meth:`Mesh.with_pose`
    """
    skeleton = next((part.rig.skeleton for part in rest.parts if part.rig), None)
    if skeleton is None:
        raise InputError(
            f"{rest.name} has no shapes and no clips: give a glTF file with a rig, or leave out "
            "the pose"
        )
    given = _checked(rest, weights)
    chosen = _chosen(rest, skeleton.clips, clip, time)
    moves: Moves = {}
    if chosen is not None:
        moves = chosen.at(0.0 if time is None else float(time))
        if chosen.ignored:
            warn(
                f"clip {shown(chosen.name)} of {rest.name} has channels of {chosen.ignored}: "
                "ignored"
            )
    with np.errstate(all="ignore"):
        return _evaluated(rest, corners, skeleton.worlds(moves), given, moves)


def _checked(mesh: Mesh, weights: Mapping[str, float] | None) -> dict[str, float]:
    check_type("weights", weights, Mapping | None, "a mapping from names of shapes to numbers")
    known = mesh.shapes
    for name, weight in (weights or {}).items():
        if name not in known:
            raise InputError(f"{mesh.name} has no shape {shown(name)}: {_known('shapes', known)}")
        check_range(f"weight of {shown(name)}", weight, SHAPE_WEIGHTS.low, SHAPE_WEIGHTS.high)
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
    rest: Mesh,
    corners: Callable[[], Corners],
    worlds: Mapping[int, Float],
    given: Mapping[str, float],
    moves: Moves,
) -> tuple[_Rows, _Rows]:
    positions: _Rows = []
    normals: _Rows = []
    behind: dict[int, Float] = {}
    turned_nodes = any(own.keys() - {"weights"} for own in moves.values())
    for number, part in enumerate(rest.parts):
        places = turned = None
        if (rig := part.rig) is not None:
            stored, weights = rig.stored_weights, _weights(rig, given, moves)
            if turned_nodes or weights != stored:
                places, turned = _posed(rest, part, rig, worlds, weights)
            if (lagging := rig.lagging(weights)) != weights:
                behind[number] = part.positions
                if turned_nodes or lagging != stored:
                    behind[number], _ = replace(rig, normals=None).posed(worlds, lagging)
        positions.append(places)
        normals.append(turned)
    if behind:
        normals = _following(rest, corners(), positions, behind, normals)
    return positions, normals


def _weights(rig: Rig, given: Mapping[str, float], moves: Moves) -> list[float]:
    """Return a weight for each shape: given, or of the clip, or stored."""
    weights = list(moves.get(rig.node, {}).get("weights", rig.weights))
    weights += [0.0] * (len(rig.shapes) - len(weights))
    return [
        given.get(shape.name, weight) for shape, weight in zip(rig.shapes, weights, strict=False)
    ]


def _posed(
    rest: Mesh, part: Part, rig: Rig, worlds: Mapping[int, Float], weights: Sequence[float]
) -> tuple[Float, Float]:
    """Return positions and normals of a part. A normal that is not finite becomes 0."""
    try:
        places, normals = rig.posed(worlds, weights)
    except ValueError as error:
        raise InputError(f"a shape of {rest.name} is damaged ({error}); export it again") from None
    if not _reach(rest, places) <= MOST_RADII:
        far = _reach(rest, places[used(places, part.faces)])
        if not far <= MOST_RADII:
            raise InputError(
                f"the pose moves vertices of {rest.name} to {far:.3g} mesh radii from its centre: "
                f"give weights, a clip or a time within {MOST_RADII:g} radii"
            )
    if normals is None:
        return places, part.normals
    if not np.isfinite(normals).all():
        normals[~np.isfinite(normals).all(axis=1)] = 0.0
    return places, normals


def _reach(rest: Mesh, places: Float) -> float:
    return float(np.abs(places - rest.center).max()) / rest.radius


def _following(
    rest: Mesh, corners: Corners, positions: _Rows, behind: Mapping[int, Float], normals: _Rows
) -> _Rows:
    """Return normals that follow shapes without own normals. A normal changes by the difference of
    the face normals around its position with and without these shapes.

    Parameters
    ----------
    positions, normals : (N, 3) for each part; None for a part in its stored pose
    behind : positions of the same pose in which these shapes have their stored weights, keyed by
        the part's index; other parts have the same positions
    """
    stored = [part.positions for part in rest.parts]
    after = [a if b is None else b for a, b in zip(stored, positions, strict=True)]
    before = [behind.get(number, own) for number, own in enumerate(after)]
    pairs = zip(*(_face_normals(rest, corners, each) for each in (after, before)), strict=True)
    steps = [now - then for now, then in pairs]
    found: _Rows = []
    for part, own, step in zip(rest.parts, normals, steps, strict=True):
        moves = own is not None or step.any()
        found.append(unit(part.normals if own is None else own) + step if moves else None)
    return found


# Keyed by the corners of a mesh: result of _face_normals in the stored pose.
_stored: WeakKeyDictionary[Corners, list[Float]] = WeakKeyDictionary()


def _face_normals(rest: Mesh, corners: Corners, positions: Sequence[Float]) -> list[Float]:
    """Return the mean face normals around each vertex as unit vectors."""
    still = all(own is part.positions for own, part in zip(positions, rest.parts, strict=True))
    if still and corners in _stored:
        return _stored[corners]
    found = [unit(each) for each in corners.normal_sums(positions)]
    if still:
        _stored[corners] = found
    return found
