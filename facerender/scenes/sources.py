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

# facerender.load_mesh, set by the package: loading imports scenes, so scenes cannot import loading.
reader: Callable[[Any], Any] | None = None
