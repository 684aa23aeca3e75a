"""Landmarks: named points on a mesh's triangles, which move with the mesh. Reads their file and
finds their pixels, depths and visibility. No OpenGL here."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from facerender.errors import InputError, clipped, quoted, reason
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import used
from facerender.scene.job import MAX_TEXT_BYTES
from facerender.scene.view import View
from facerender.system.files import read_file
from facerender.values.fields import PATH, TEXT, IntegerRange, Range
from facerender.values.vectors import Float, Float32, Integers, Mask, rows_of

MAX_LANDMARKS = 100_000
_VERTICES = IntegerRange(0, (1 << 31) - 1)
_WEIGHTS = Range(-2.0, 2.0)  # wider than the valid range, which Landmarks checks with a tolerance
_ROUNDED = 0.02  # tolerance of weights and of their sum: files may have weights of two digits
_KEYS = ("name", "vertices", "weights", "part")
# Error bounds of a depth image: float32 resolves 2^-24 of a depth; a driver interpolates positions
# in the renderer's space with an error of less than 4e-6 (tests/test_landmarks.py).
_RESOLUTION, _INTERPOLATION = 2.0**-23, 4e-6


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points on triangles of a mesh, such as the tip of the nose.

    Parameters
    ----------
    names : a different name for each of the N landmarks, 1 <= N <= 100000
    vertices : (N, 3) vertex numbers from 0, see ``parts``
    weights : (N, 3) weights of the vertices, in [0, 1], with the sum 1. A tolerance of 0.02 allows
        rounded weights, which are scaled to the sum 1
    parts : for each landmark the name of the part whose vertices the numbers count, or "" to count
        the vertices of the whole mesh; () for "" everywhere. If a mesh file shares its vertices
        between texture seams and parts (:attr:`Part.sources`), the numbers count the vertices of
        the file

    Raises InputError if a shape, number, weight or name is invalid.
    """

    names: tuple[str, ...]
    vertices: Integers
    weights: Float
    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        names = tuple(TEXT.check("landmark name", name) for name in self.names)
        if not 0 < len(names) <= MAX_LANDMARKS:
            raise InputError(f"{len(names)} landmarks: give 1 to {MAX_LANDMARKS}")
        if len({*names}) < len(names):
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise InputError(f"two landmarks are called {quoted(twice)}: give different names")
        weights = rows_of("landmark weights", self.weights, (3,), count=len(names))
        vertices = rows_of("landmark vertices", self.vertices, (3,), count=len(names))
        wrong = (vertices != np.floor(vertices)) | (vertices < 0) | (vertices > _VERTICES.high)
        for row, column in np.argwhere(wrong):
            vertex = f"landmark {quoted(names[row])}: vertex {vertices[row, column]:g}"
            raise InputError(f"{vertex}: give a vertex number from 0 on")
        sums = weights.sum(axis=1)
        wrong = (np.abs(sums - 1.0) > _ROUNDED) | (weights.min(axis=1) < -_ROUNDED)
        for row in np.flatnonzero(wrong):
            pair = f"weights {weights[row].tolist()} have the sum {sums[row]:.4g}"
            remedy = "give weights in [0, 1] with the sum 1"
            raise InputError(f"landmark {quoted(names[row])}: {pair}: {remedy}")
        weights = np.maximum(weights, 0.0)
        parts = tuple(TEXT.check("landmark part", part) for part in self.parts)
        if parts and len(parts) != len(names):
            remedy = f"give {len(names)}, one for each landmark"
            raise InputError(f"{len(parts)} landmark parts: {remedy}")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "vertices", vertices.astype(np.int64))
        object.__setattr__(self, "weights", weights / weights.sum(axis=1, keepdims=True))
        object.__setattr__(self, "parts", parts or ("",) * len(names))

    def __repr__(self) -> str:
        return f"<Landmarks, {len(self.names)} from {self.names[0]!r} on>"

    def positions(self, mesh: Mesh) -> Float:
        """Return the positions (N, 3) of the landmarks on a mesh, in mesh space.

        Raises InputError if a vertex is missing or unused, or a part missing or ambiguous.
        """
        positions = np.concatenate([part.positions for part in mesh.parts])
        rows, part_names = np.empty_like(self.vertices), np.array(self.parts)
        for name in dict.fromkeys(self.parts):
            of_part = np.flatnonzero(part_names == name)
            table, numbers = _vertices_of(mesh, name), self.vertices[of_part]
            beyond = numbers >= len(table)
            rows[of_part] = table[np.where(beyond, 0, numbers)]
            for row, column in np.argwhere(beyond | (rows[of_part] < 0)):
                owner = f"part {quoted(name)} of {mesh.name}" if name else mesh.name
                why = f"no triangle of {owner} uses it"
                if beyond[row, column]:
                    why = f"{owner} has {len(table)} vertices"
                vertex = f"{quoted(self.names[of_part[row]])}: vertex {numbers[row, column]}"
                remedy = "give the number of a vertex of a triangle"
                raise InputError(f"landmark {vertex}, but {why}: {remedy}")
        return np.asarray(np.einsum("nkj,nk->nj", positions[rows], self.weights))


def _vertices_of(mesh: Mesh, name: str) -> Integers:
    """Return, for each vertex number of a part ("": of the mesh), the index of the vertex in the
    positions of all parts; -1 for a vertex that no triangle uses."""
    starts = np.cumsum([0, *(len(part.positions) for part in mesh.parts)])
    indices = mesh.called(name) if name else range(len(mesh.parts))
    if name and (count := len(indices)) > 1:
        raise InputError(f"landmark part {quoted(name)} matches {count} parts: give one part")
    shared = [i for i in indices if mesh.parts[i].sources is not None]
    counts = {mesh.parts[i].source_count for i in shared}
    by_file = len(counts) == 1  # otherwise, the parts have no common numbers
    table = np.full(counts.pop() if by_file else int(starts[-1]), -1)
    for i in shared if by_file else indices:
        part, sources = mesh.parts[i], mesh.parts[i].sources if by_file else None
        vertices = np.flatnonzero(used(part.positions, part.faces))
        rows = starts[i] + vertices
        table[rows if sources is None else sources[vertices]] = rows
    return table if by_file or not name else table[starts[indices[0]] : starts[indices[0] + 1]]


def load_landmarks(path: str | os.PathLike[str]) -> Landmarks:
    """Return the landmarks of a JSON file.

    The file has a list of landmarks, or a table of landmarks by name. A landmark is a vertex
    number, or a table with these keys:

    - vertices: one to three vertex numbers from 0, as a list, or one number
    - weights: the weight of each vertex; the default for one vertex is 1
    - part: name of the part whose vertices the numbers count, see :class:`Landmarks`; optional
    - name: in a list; the default is the index in the list

    Arrays of embedded landmarks, such as the vertices ``faces[lmk_faces_idx]`` and the weights
    ``lmk_b_coords`` of FLAME, need no file: pass them to :class:`Landmarks`.

    Raises InputError if the file cannot be read, has another structure, or an invalid landmark.
    """
    file = PATH.check("landmark file", path)
    content = read_file(file, "a JSON file with landmarks", MAX_TEXT_BYTES)
    name = clipped(Path(file).name)
    try:
        landmarks: Any = json.loads(content)
    except (ValueError, RecursionError) as error:
        remedy = f"its JSON cannot be read ({reason(error)}); correct it"
        raise InputError(f"{name}: {remedy}") from None
    try:
        if not isinstance(landmarks, list | dict):
            remedy = "give a list of landmarks, or a table by name"
            raise InputError(f"content = {quoted(landmarks)}: {remedy}")
        if not 0 < len(landmarks) <= MAX_LANDMARKS:
            raise InputError(f"{len(landmarks)} landmarks: give 1 to {MAX_LANDMARKS}")
        keyed = isinstance(landmarks, dict)
        pairs: Any = landmarks.items() if isinstance(landmarks, dict) else enumerate(landmarks)
        rows = [_item(str(key), landmark, not keyed) for key, landmark in pairs]
        names, vertices, weights, parts = zip(*rows, strict=True)
        return Landmarks(names, np.array(vertices), np.array(weights), parts)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _item(name: str, landmark: Any, named: bool) -> tuple[str, list[int], list[float], str]:
    """Return name, three vertices, three weights and part of a landmark, which may have the key
    "name" if ``named`` is true."""
    label = f"landmark {quoted(name)}"
    table = landmark if isinstance(landmark, Mapping) else {"vertices": landmark}
    keys = _KEYS if named else _KEYS[1:]
    if unknown := [key for key in table if key not in keys]:
        raise InputError(f"{label}: unknown key {quoted(unknown[0])}; known: {', '.join(keys)}")
    for key in ("name", "part"):
        TEXT.check(f"{label}: {key}", table.get(key, ""))
    vertices: Any = table.get("vertices")
    numbers = vertices if isinstance(vertices, list) and table is landmark else [vertices]
    if not 0 < len(numbers) <= 3 or not all(number in _VERTICES for number in numbers):
        text = quoted(vertices)
        raise InputError(f"{label}: vertices = {text}: give one to three vertex numbers")
    weights = table.get("weights", [1.0] if len(numbers) == 1 else None)
    weights = weights if isinstance(weights, list) else [weights]
    if len(weights) != len(numbers) or not all(weight in _WEIGHTS for weight in weights):
        weight_text = quoted(table.get("weights"))
        raise InputError(f"{label}: weights = {weight_text}: give {len(numbers)} numbers in [0, 1]")
    numbers, weights = [*numbers, *numbers[:1] * 2][:3], [*map(float, weights), 0.0, 0.0][:3]
    return table.get("name") or name, numbers, weights, table.get("part", "")


def located(view: View, mesh: Mesh, points: Float, image: Float32) -> tuple[Float, Float, Mask]:
    """Return pixels and depth, as :meth:`View.project`, of points on the surface of a scene, and
    whether the points are visible: in the image, and not hidden.

    A point is hidden if its pixel shows no surface, or if the surfaces at the four pixel centres
    around it are all nearer than the point, by more than a tolerance. At a silhouette, one of these
    centres shows the surface behind.

    points : (N, 3), in mesh space
    image : (H, W, 4), image of the term depth
    """
    height, width = image.shape[:2]
    pixels, depth = view.project(mesh, points, (width, height))
    # A plane through the point is at least as far as the point at one of the centres, so that
    # slanted surfaces need no tolerance. The tolerance is the size of a pixel at the point's depth,
    # because a hollow that the image resolves is not deeper between two pixels; and rounding.
    slack = view.pixel(mesh, (width, height), depth) + depth * _RESOLUTION
    slack = slack + mesh.radius * _INTERPOLATION
    surface = np.where(image[..., 3] > 0.0, image[..., 0].astype(np.float64), np.inf)
    with np.errstate(invalid="ignore"):  # at the border, slopes continue; inf - inf is NaN
        inside = np.all((pixels >= 0.0) & (pixels < (width, height)), axis=1)
        surface = np.pad(surface, 1, mode="reflect", reflect_type="odd")
    positions = np.where(inside[:, None], pixels, 0.0)
    column, row = positions.astype(np.int64).T
    covered = image[row, column, 3] > 0.0
    column, row = np.floor(positions + 0.5).astype(np.int64).T
    around = [surface[row + i, column + j] for i in (0, 1) for j in (0, 1)]
    visible = inside & covered & (np.nanmax(around, axis=0) >= depth - slack)
    return pixels, depth, visible
