"""What stands for a mesh: a file, its content, or objects of trimesh. What reads them is above this
room, and is named here when the package is imported."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import trimesh

    MeshSource = str | os.PathLike[str] | bytes | IO[bytes] | trimesh.Trimesh | trimesh.Scene
else:
    MeshSource = Any

reader: Callable[[Any], Any] | None = None  # facerender.load_mesh
