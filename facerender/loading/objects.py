"""Meshes and scenes of trimesh that a program has made or read itself, as ours."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.translate import piece_of
from facerender.scenes.repair import Piece, check_count, placed
from facerender.scenes.texture import Texture

if TYPE_CHECKING:
    import trimesh

Instance = tuple[str, "trimesh.Trimesh", NDArray[np.float64]]


def is_object(source: Any) -> TypeGuard[trimesh.Trimesh | trimesh.Scene]:
    """Whether a source is a mesh or a scene of trimesh, for which nothing is imported."""
    library = sys.modules.get("trimesh")
    return library is not None and isinstance(source, library.Trimesh | library.Scene)


def name_of(source: trimesh.Trimesh | trimesh.Scene) -> str:
    """Return what messages call a mesh or a scene: what its metadata do, or its kind."""
    facts = source.metadata
    found = facts.get("name") or facts.get("file_name")
    return clipped(found, 80) if isinstance(found, str) else f"a trimesh.{type(source).__name__}"


def millimetres_of(source: trimesh.Trimesh | trimesh.Scene) -> float | None:
    """Return how many millimetres a unit is; None where the object does not say."""
    import trimesh

    try:
        return float(trimesh.units.unit_conversion(source.units, "millimeters"))
    except Exception:  # no units, none that are known, or several in a scene
        return None


def pieces_of(source: trimesh.Trimesh | trimesh.Scene, name: str) -> list[Piece]:
    """Return copies of every instance of a mesh with faces.

    Raises
    ------
    InputError : there are none, or arrays in them are no mesh
    """
    textures: dict[int, Texture] = {}
    pieces = []
    try:
        for called, mesh, world in _instances(source):
            piece = placed(piece_of(mesh, name, textures, False), world)
            piece.name = called
            pieces.append(piece)
            check_count(len(pieces), name)
    except InputError:
        raise
    except Exception as error:  # what others have put into the arrays
        raise InputError(f"{name} is no mesh that can be drawn: {reason(error)}") from None
    if not pieces:
        raise InputError(f"there is no face in {name}; give a triangle mesh")
    return pieces


def _instances(source: trimesh.Trimesh | trimesh.Scene) -> Iterator[Instance]:
    import trimesh

    if isinstance(source, trimesh.Trimesh):
        if len(source.faces):
            yield str(source.metadata.get("name") or ""), source, np.eye(4)
        return
    for node in source.graph.nodes_geometry:
        world, key = source.graph[node]
        mesh = source.geometry[key]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            yield str(node), mesh, np.asarray(world, dtype=np.float64)
