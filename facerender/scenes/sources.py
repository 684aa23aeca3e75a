"""Types that :class:`facerender.Scene` accepts in place of a mesh and an environment map, and the
functions that load them."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import IO, TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import trimesh

    from facerender.scenes.environment import Environment
    from facerender.scenes.file import EnvironmentFile

    MeshSource: TypeAlias = (
        str | os.PathLike[str] | bytes | IO[bytes] | trimesh.Trimesh | trimesh.Scene
    )
    EnvironmentSource: TypeAlias = Environment | EnvironmentFile | str | os.PathLike[str]
else:
    MeshSource = EnvironmentSource = Any

# The package facerender sets these to load_mesh and load_environment. The subpackage scenes cannot
# import them from the subpackage loading, which imports scenes.
reader: Callable[[Any], Any] | None = None
environment_reader: Callable[[Any], Any] | None = None
