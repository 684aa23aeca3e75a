"""Types that :class:`facerender.Scene` accepts in place of a mesh."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import trimesh

    MeshSource = str | os.PathLike[str] | bytes | IO[bytes] | trimesh.Trimesh | trimesh.Scene
else:
    MeshSource = Any

# The package facerender sets this to load_mesh. The subpackage scenes cannot import load_mesh from
# the subpackage loading, which imports scenes.
reader: Callable[[Any], Any] | None = None
