"""Meshes that differ from a given one in their geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import facerender as fr


def with_geometry(
    mesh: fr.Mesh, materials: Sequence[fr.Material] | None = None, **values: Any
) -> fr.Mesh:
    """Return a mesh in the reference pose whose geometry has other values, such as ``parts``."""
    geometry = replace(mesh.geometry, known_framing=None, **values)
    return fr.Mesh(geometry, mesh.materials if materials is None else tuple(materials))
