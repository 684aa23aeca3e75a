"""Checks the input files of a table of jobs: each mesh, map, environment map, file of vertices and
landmark file is read once. OpenGL is not used."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from facerender.batch.jobs import Row
from facerender.errors import InputError, clipped
from facerender.job import MESH_PATHS
from facerender.loading import load_mesh
from facerender.loading.environment import load_environment
from facerender.loading.vertices import frame_count
from facerender.scenes.file import STUDIO, EnvironmentFile
from facerender.scenes.landmarks import load_landmarks
from facerender.scenes.material import MAPS
from facerender.scenes.texture import Texture

_File = tuple[Any, ...]  # kind of a file, its path, and options with which it is read


def file_faults(rows: Iterable[tuple[str, Row]]) -> Iterator[str]:
    """Yield a message for each input file that cannot be used, after all rows were read.

    The message names the first row with this file. Maps that a mesh file names are decoded, too.

    rows : pairs of a row's position, as a text for messages, and the row
    """
    first: dict[_File, str] = {}
    for position, row in rows:
        for file in _files(row):
            first.setdefault(file, position)
    for file, position in first.items():
        try:
            _READ[file[0]](*file[1:])
        except InputError as error:
            yield f"{position}: {error}"
        except MemoryError:
            yield f"{position}: {file[1]} does not fit into memory: make it smaller"
        except Exception as error:  # as in the worker, a reader may raise any exception
            yield f"{position}: {file[1]} cannot be read: {clipped(str(error))}"


def _files(row: Row) -> Iterator[_File]:
    mesh = row.tables.get("mesh", {})
    if "path" in mesh:
        yield "mesh", mesh["path"], "albedo" in mesh, mesh.get("allow_outside", False)
    for name in MESH_PATHS:
        if name != "path" and name in mesh:
            yield "map", mesh[name]
    environment = row.tables.get("environment")
    if environment and environment["file"] != STUDIO:
        yield "environment", environment["file"]
    for key in ("pose", "before"):
        if vertices := row.tables.get(key, {}).get("vertices"):
            yield "vertices", vertices
    if "landmarks" in row.tables:
        yield "landmarks", row.tables["landmarks"]


def _read_mesh(path: str, replaced: bool, allow_outside: bool) -> None:
    """Load a mesh and decode its maps; ``replaced``: whether a row replaces the albedo map."""
    albedo = Texture.from_array([[[1.0, 1.0, 1.0]]]) if replaced else None
    mesh = load_mesh(path, albedo=albedo, allow_outside=allow_outside)
    textures = {getattr(material, name) for material in mesh.materials for name in MAPS}
    for texture in textures - {None}:
        texture.rgb()


_READ: dict[str, Callable[..., object]] = {
    "mesh": _read_mesh,
    "map": lambda path: Texture.open(path).rgb(),
    "environment": lambda path: load_environment(EnvironmentFile(path)),
    "vertices": frame_count,
    "landmarks": load_landmarks,
}
