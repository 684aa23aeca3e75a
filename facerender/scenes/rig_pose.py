"""Poses by a mesh's rig: check the weights, the clip and the time, evaluate the rigs of the parts,
and complete the normals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from facerender.errors import InputError, check_range, check_type, clipped, shown, warn
from facerender.scenes.rig import Clip, Float, Moves, Rig
from facerender.scenes.vectors import MOST_RADII, SHAPE_WEIGHTS, unit

if TYPE_CHECKING:
    from facerender.scenes.mesh import Mesh, Part

_Rows = list[Float | None]


def posed(
    rest: Mesh, weights: Mapping[str, float] | None, clip: str | None, time: float | None
) -> tuple[_Rows, _Rows]:
    """Return positions and normals of each part of a mesh in a pose; None for a part in its stored
    pose. The normals have any length.

    Parameters
    ----------
    rest : the mesh in the reference pose
    weights, clip, time : see :meth:`Mesh.with_pose`
    """
    skeleton = next((part.rig.skeleton for part in rest.parts if part.rig), None)
    if skeleton is None:
        remedy = "give a glTF file with a rig, or leave out the pose"
        raise InputError(f"{rest.name} has no shapes and no clips: {remedy}")
    overrides = _checked(rest, weights)
    selected = _clip(rest, skeleton.clips, clip, time)
    moves: Moves = {}
    if selected is not None:
        moves = selected.at(0.0 if time is None else float(time))
        if selected.ignored:
            name, ignored = shown(selected.name), selected.ignored
            warn(f"clip {name} of {rest.name} has channels of {ignored}: ignored")
    with np.errstate(all="ignore"):
        return _evaluated(rest, skeleton.worlds(moves), overrides, moves)


def _checked(mesh: Mesh, weights: Mapping[str, float] | None) -> dict[str, float]:
    check_type("weights", weights, Mapping | None, "a mapping from names of shapes to numbers")
    shapes = mesh.shapes
    for name, weight in (weights or {}).items():
        if name not in shapes:
            raise InputError(f"{mesh.name} has no shape {shown(name)}: {_known('shapes', shapes)}")
        check_range(f"weight of {shown(name)}", weight, SHAPE_WEIGHTS.low, SHAPE_WEIGHTS.high)
    return {name: float(weight) for name, weight in (weights or {}).items()}


def _known(kind: str, names: Sequence[str]) -> str:
    return f"its {kind} are {clipped(', '.join(names), 300)}" if names else f"it has no {kind}"


def _clip(mesh: Mesh, clips: Sequence[Clip], name: str | None, time: float | None) -> Clip | None:
    """Return the clip of a name, or the first clip if only a time is given."""
    if name is None and time is None:
        return None
    check_type("clip", name, str | None, "the name of a clip")
    matches = [clip for clip in clips if name in (None, clip.name)]
    if not matches:
        problem = f"time = {shown(time)} needs a clip" if name is None else f"clip = {shown(name)}"
        known = _known("clips", [clip.name for clip in clips])
        raise InputError(f"{problem}, which {mesh.name} lacks: {known}")
    clip = matches[0]
    label = f"clip {shown(clip.name)}"
    if clip.fault:
        raise InputError(f"{label} of {mesh.name} is damaged ({clip.fault}); export it again")
    if time is not None:
        check_range(f"time of {label}", time, 0.0, clip.duration)
    return clip


def _evaluated(
    rest_mesh: Mesh, worlds: Mapping[int, Float], overrides: Mapping[str, float], moves: Moves
) -> tuple[_Rows, _Rows]:
    positions: _Rows = []
    normals: _Rows = []
    behind: dict[int, Float] = {}
    turned_nodes = any(node_moves.keys() - {"weights"} for node_moves in moves.values())
    for number, part in enumerate(rest_mesh.parts):
        places = turned = None
        if (rig := part.rig) is not None:
            stored = rig.stored_weights
            clip_weights = moves.get(rig.node, {}).get("weights", stored)
            pairs = zip(rig.shapes, [*clip_weights, *[0.0] * len(stored)], strict=False)
            weights = [overrides.get(shape.name, weight) for shape, weight in pairs]
            if turned_nodes or weights != stored:
                places, turned = _posed(rest_mesh, part, rig, worlds, weights)
            if (lagging := rig.lagging(weights)) != weights:
                behind[number] = part.positions
                if turned_nodes or lagging != stored:
                    behind[number], _ = replace(rig, normals=None).posed(worlds, lagging)
        positions.append(places)
        normals.append(turned)
    if behind:
        normals = _following(rest_mesh, positions, behind, normals)
    return positions, normals


def _posed(
    rest_mesh: Mesh, part: Part, rig: Rig, worlds: Mapping[int, Float], weights: Sequence[float]
) -> tuple[Float, Float]:
    """Return positions and normals of a part. A normal that is not finite becomes 0."""
    try:
        places, normals = rig.posed(worlds, weights)
    except ValueError as error:
        name = rest_mesh.name
        raise InputError(f"a shape of {name} is damaged ({error}); export it again") from None
    drawn = places if part.drawn is None else places[part.drawn[:, 0]]
    reach = float(np.abs(drawn - rest_mesh.center).max()) / rest_mesh.radius
    if not reach <= MOST_RADII:
        raise InputError(
            f"the pose moves vertices of {rest_mesh.name} to {reach:.3g} mesh radii from its "
            f"centre: give weights, a clip or a time within {MOST_RADII:g} radii"
        )
    if normals is None:
        return places, part.normals
    if not np.isfinite(normals).all():
        normals[~np.isfinite(normals).all(axis=1)] = 0.0
    return places, normals


def _following(
    rest_mesh: Mesh, positions: _Rows, behind: Mapping[int, Float], normals: _Rows
) -> _Rows:
    """Return normals that follow shapes without own normals. A normal changes by the difference of
    the face normals around its position with and without these shapes.

    positions, normals : (N, 3) for each part; None for a part in its stored pose
    behind : positions of the same pose in which these shapes have their stored weights, keyed by
        the part's index; other parts have the same positions
    """
    stored = [part.positions for part in rest_mesh.parts]
    moved = [a if b is None else b for a, b in zip(stored, positions, strict=True)]
    lagging = [behind.get(number, places) for number, places in enumerate(moved)]
    means = (_mean_normals(rest_mesh, pose) for pose in (moved, lagging))
    new_normals: _Rows = []
    for part, normal, after, before in zip(rest_mesh.parts, normals, *means, strict=True):
        step = after - before
        base = part.normals if normal is None else normal
        new_normals.append(None if normal is None and not step.any() else unit(base) + step)
    return new_normals


def _mean_normals(rest_mesh: Mesh, positions: Sequence[Float]) -> list[Float]:
    """Return the mean face normals around each vertex as unit vectors."""
    pairs = zip(positions, rest_mesh.parts, strict=True)
    if all(rows is part.positions for rows, part in pairs):
        return rest_mesh.mean_normals
    return [*map(unit, rest_mesh.corners.normal_sums(positions))]
