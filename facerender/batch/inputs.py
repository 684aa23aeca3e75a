"""Checks the input files of a table of jobs: each mesh, map, environment map, file of vertices and
landmark file is read once, and poses and landmarks must fit their meshes. OpenGL is not used."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from facerender.batch.jobs import FILES, Row
from facerender.errors import InputError, clipped
from facerender.loading import load_mesh
from facerender.loading.environment import load_environment
from facerender.loading.vertices import frame_count, posed
from facerender.scenes.file import STUDIO, EnvironmentFile, Pose
from facerender.scenes.landmarks import load_landmarks
from facerender.scenes.material import MAPS
from facerender.scenes.mesh import Mesh
from facerender.scenes.texture import Texture

_File = tuple[Any, ...]  # kind of a file, its path, and options with which it is read
_Use = tuple[str, str | None]  # "weights", "clip", "vertices" or "landmarks", with a name or path
_Call = Callable[..., Any]
_Place = tuple[int, str]  # number of a row, and its position as a text for messages
_OPTIONS = ("allow_outside", "as_is", "parts", "hide")  # keys of a mesh that change its vertices


def file_faults(rows: Iterable[tuple[str, Row]]) -> list[str]:
    """Return a message for each input file that cannot be used, and for each shape, clip, file of
    vertices and landmark file that does not fit its mesh.

    A message names the first row with this file; for a clip and a file of vertices, the row with
    the largest time or frame. Maps that a mesh file names are decoded, too.

    rows : pairs of a row's position, as a text for messages, and the row
    """
    first_places: dict[_File, _Place] = {}
    uses: dict[_File, dict[_Use, tuple[float, _Place]]] = {}  # by mesh, with the time or frame
    for position, row in rows:
        place = row.number, position
        for file in (mesh := _mesh_of(row), *_files(row)):
            first_places.setdefault(file, place)
        mesh_uses = uses.setdefault(mesh, {})
        for use, moment in _uses(row):
            if use not in mesh_uses or moment > mesh_uses[use][0]:
                mesh_uses[use] = moment, place
    faults: dict[tuple[_File, str], _Place] = {}

    def attempt(file: _File, place: _Place, name: str, call: _Call, *arguments: Any) -> Any:
        """Return the result of a call, or note its error and return None."""
        try:
            return call(*arguments)
        except InputError as error:
            text = str(error)
        except MemoryError:
            text = f"{name} does not fit into memory: make it smaller"
        except Exception as error:  # as in the worker, a reader may raise any exception
            text = f"{name} cannot be read: {clipped(str(error))}"
        faults.setdefault((file, text), place)
        return None

    unread = set[str]()
    for file in first_places.keys() - uses.keys():
        if attempt(file, first_places[file], file[1], _READ[file[0]], *file[1:]) is None:
            unread.add(file[1])
    for file, mesh_uses in uses.items():
        name = file[1] or "the built-in head"
        mesh = attempt(file, first_places[file], name, _read_mesh, *file[1:])
        for use, (moment, place) in mesh_uses.items():
            if mesh is not None and use[1] not in unread:
                attempt(file, place, use[1] or "its clip", _check_use, mesh, *use, moment)
    places = sorted((place, text) for (_, text), place in faults.items())
    return [f"{position}: {text}" for (_, position), text in places]


def _mesh_of(row: Row) -> _File:
    mesh = row.tables.get("mesh", {})
    options = {name: mesh[name] for name in _OPTIONS if name in mesh}
    return "mesh", mesh.get("path"), "albedo" in mesh, json.dumps(options)


def _files(row: Row) -> Iterator[_File]:
    """Yield the files of a row, without the mesh."""
    for key, names in FILES.items():
        kind = {"mesh": "map", "environment": "environment"}.get(key, "vertices")
        table = row.tables.get(key, {})
        for path in (table.get(name) for name in names if name != "path"):
            if path and path != STUDIO:
                yield kind, path
    if "landmarks" in row.tables:
        yield "landmarks", row.tables["landmarks"]


def _uses(row: Row) -> Iterator[tuple[_Use, float]]:
    """Yield the names and files that must fit the row's mesh, each with its time or frame."""
    moves = not {"motion", "layers"}.isdisjoint(row.outputs)
    for key in ("pose", "before") if moves else ("pose",):
        pose = row.tables.get(key, {})
        for name in pose.get("weights", ()):
            yield ("weights", name), 0.0
        if "vertices" in pose:
            yield ("vertices", pose["vertices"]), pose.get("frame", 0)
        elif "clip" in pose or "time" in pose:
            yield ("clip", pose.get("clip")), pose.get("time", 0.0)
    if "landmarks" in row.tables:
        yield ("landmarks", row.tables["landmarks"]), 0.0


def _check_use(mesh: Mesh, kind: str, name: Any, moment: Any) -> None:
    """Raise InputError if a mesh lacks a shape or clip, or vertices or landmarks do not fit it."""
    if kind == "landmarks":
        load_landmarks(name).positions(mesh)
    elif kind == "vertices":
        posed(mesh, Pose(vertices=name, frame=moment))
    elif kind == "clip":
        posed(mesh, Pose(clip=name, time=moment))
    elif name not in mesh.shapes:
        posed(mesh, Pose({name: 0.0}))


def _read_mesh(path: str | None, replaced: bool, options: str) -> Mesh:
    """Load a mesh and decode its maps; ``replaced``: whether a row replaces the albedo map."""
    albedo = Texture.from_array([[[1.0, 1.0, 1.0]]]) if replaced else None
    mesh = load_mesh(path, albedo=albedo, **json.loads(options))
    textures = {getattr(material, name) for material in mesh.materials for name in MAPS}
    for texture in textures - {None}:
        texture.rgb()
    return mesh


_READ: dict[str, _Call] = {
    "map": lambda path: Texture.open(path).rgb(),
    "environment": lambda path: load_environment(EnvironmentFile(path)),
    "vertices": frame_count,
    "landmarks": load_landmarks,
}
