"""Poses of a rigged mesh: checked weights, joints, clip and time, evaluated in float64."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, check_range, check_type, clipped, shown, warn
from facerender.mesh.geometry import Geometry
from facerender.mesh.part import Part
from facerender.mesh.rig import Clip, Moves, Rig
from facerender.values.vectors import ROTATIONS, SHAPE_WEIGHTS, unit

Float = NDArray[np.float64]
_Rows = list[Float | None]


@np.errstate(all="ignore")  # MeshPose refuses positions that cause overflow
def posed(
    rest: Geometry,
    weights: Mapping[str, float] | None,
    joints: Mapping[str, Sequence[float]] | None,
    clip: str | None,
    time: float | None,
) -> tuple[_Rows, _Rows]:
    """Return positions and normals of each part of a mesh in a pose; None for a part in its stored
    pose. The normals have any length. For the pose see :meth:`Mesh.with_pose`."""
    skeleton = next((part.rig.skeleton for part in rest.parts if part.rig), None)
    if skeleton is None:
        remedy = "give a glTF file with a rig, or leave out the pose"
        raise InputError(f"{rest.name} has no shapes, clips or joints: {remedy}")
    known = dict(skeleton.joints)
    overrides = _checked(rest, "weights", weights, rest.shapes)
    rotations = _checked(rest, "joints", joints, [*known])
    selected = _clip(rest, skeleton.clips, clip, time)
    moves: dict[int, dict[str, Sequence[float]]] = {}
    if selected is not None:
        moves = selected.at(0.0 if time is None else float(time))
        if selected.ignored:
            name, ignored = shown(selected.name), selected.ignored
            warn(f"clip {name} of {rest.name} has channels of {ignored}: ignored")
    for name, angles in rotations.items():
        if any(angles):
            moves.setdefault(known[name], {})["angles"] = angles
    return _evaluated(rest, skeleton.worlds(moves), overrides, moves)


def _checked(
    geometry: Geometry, option: str, values: Mapping[str, Any] | None, known: Sequence[str]
) -> dict[str, Any]:
    """Return checked weights, keyed by shape, or joints, keyed by name."""
    noun, label, limits = {
        "weights": ("shape", "weight of", SHAPE_WEIGHTS),
        "joints": ("joint", "joint", ROTATIONS),
    }[option]
    check_type(option, values, Mapping | None, f"a mapping from names of {noun}s to numbers")
    for name in values or {}:
        if name not in known:
            names = _known(f"{noun}s", known)
            raise InputError(f"{geometry.name} has no {noun} {shown(name)}: {names}")
    return {n: limits.check(f"{label} {shown(n)}", value) for n, value in (values or {}).items()}


def _known(kind: str, names: Sequence[str]) -> str:
    return f"its {kind} are {clipped(', '.join(names), 300)}" if names else f"it has no {kind}"


def _clip(
    geometry: Geometry, clips: Sequence[Clip], name: str | None, time: float | None
) -> Clip | None:
    """Return the clip of a name, or the first clip if only a time is given."""
    if name is None and time is None:
        return None
    check_type("clip", name, str | None, "the name of a clip")
    matches = [clip for clip in clips if name in (None, clip.name)]
    if not matches:
        problem = f"time = {shown(time)} needs a clip" if name is None else f"clip = {shown(name)}"
        known = _known("clips", [clip.name for clip in clips])
        raise InputError(f"{problem}, which {geometry.name} lacks: {known}")
    clip = matches[0]
    label = f"clip {shown(clip.name)}"
    if clip.fault:
        raise InputError(f"{label} of {geometry.name} is damaged ({clip.fault}); export it again")
    if time is not None:
        check_range(f"time of {label}", time, 0.0, clip.duration)
    return clip


def _evaluated(
    geometry: Geometry, worlds: Mapping[int, Float], overrides: Mapping[str, float], moves: Moves
) -> tuple[_Rows, _Rows]:
    positions: _Rows = []
    normals: _Rows = []
    behind: dict[int, Float] = {}
    turned_nodes = any(node_moves.keys() - {"weights"} for node_moves in moves.values())
    for number, part in enumerate(geometry.parts):
        places = turned = None
        if (rig := part.rig) is not None:
            clip_weights = moves.get(rig.node, {}).get("weights", rig.weights)
            pairs = zip(rig.shapes, [*clip_weights, *[0.0] * len(rig.shapes)], strict=False)
            weights = tuple(float(overrides.get(shape.name, weight)) for shape, weight in pairs)
            if turned_nodes or weights != rig.weights:
                places, turned = _posed(geometry, part, rig, worlds, weights)
            if (lagging := rig.lagging(weights)) != weights:
                behind[number] = part.positions
                if turned_nodes or lagging != rig.weights:
                    behind[number], _ = replace(rig, normals=None).posed(worlds, lagging)
        positions.append(places)
        normals.append(turned)
    if behind:
        normals = _following(geometry, positions, behind, normals)
    return positions, normals


def _posed(
    geometry: Geometry, part: Part, rig: Rig, worlds: Mapping[int, Float], weights: Sequence[float]
) -> tuple[Float, Float]:
    """Return positions and normals of a part. A normal that is not finite becomes 0."""
    try:
        places, normals = rig.posed(worlds, weights)
    except ValueError as error:
        name = geometry.name
        raise InputError(f"a shape of {name} is damaged ({error}); export it again") from None
    if normals is None:
        return places, part.normals
    if not np.isfinite(normals).all():
        normals[~np.isfinite(normals).all(axis=1)] = 0.0
    return places, normals


def _following(
    geometry: Geometry, positions: _Rows, behind: Mapping[int, Float], normals: _Rows
) -> _Rows:
    """Return normals that follow shapes without own normals. A normal changes by the difference of
    the face normals around its position with and without these shapes.

    positions, normals : (N, 3) for each part; None for a part in its stored pose
    behind : positions of the same pose in which these shapes have their stored weights, keyed by
        the part's index; other parts have the same positions
    """
    pairs = zip(geometry.parts, positions, strict=True)
    moved = [part.positions if places is None else places for part, places in pairs]
    lagging = [behind.get(number, places) for number, places in enumerate(moved)]
    means = (_mean_normals(geometry, pose) for pose in (moved, lagging))
    new_normals: _Rows = []
    for part, normal, after, before in zip(geometry.parts, normals, *means, strict=True):
        step = after - before
        base = part.normals if normal is None else normal
        new_normals.append(None if normal is None and not step.any() else unit(base) + step)
    return new_normals


def _mean_normals(geometry: Geometry, positions: Sequence[Float]) -> list[Float]:
    """Return the mean face normals around each vertex as unit vectors."""
    pairs = zip(positions, geometry.parts, strict=True)
    if all(rows is part.positions for rows, part in pairs):
        return geometry.mean_normals
    return [*map(unit, geometry.corners.normal_sums(positions))]
