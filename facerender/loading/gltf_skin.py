"""Skins of glTF meshes: vertices where the joints of the file put them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STRIP = 1 << 16  # vertices at a time, of which each has a matrix

Float = NDArray[np.float64]


def skinned(
    positions: NDArray[Any],
    normals: NDArray[Any] | None,
    joints: NDArray[Any],
    weights: NDArray[Any],
    matrices: Float,
) -> tuple[Float, Float | None, bool]:
    """Return vertices where the joints put them, their normals, and whether they are mirrored.

    Parameters
    ----------
    joints, weights : (N, K): of K joints the number, and the weight
    matrices : (J, 4, 4), for columns: from the mesh's space by the inverse bind matrix and the
        joint into the scene

    Raises
    ------
    ValueError : joints that are not there
    """
    if joints.size and joints.max() >= len(matrices):
        raise ValueError(f"joint {joints.max()} of {len(matrices)}")
    fractions = np.maximum(np.nan_to_num(weights.astype(np.float64)), 0.0)
    total = fractions.sum(axis=1, keepdims=True)
    fractions = np.where(total > 0.0, fractions / np.where(total > 0.0, total, 1.0), 0.0)
    fractions[:, 0] += total[:, 0] <= 0.0  # of no joint: the first
    moved = np.empty((len(positions), 3))
    turned = None if normals is None else np.empty((len(positions), 3))
    mirrored = 0
    for start in range(0, len(positions), _STRIP):
        rows = slice(start, start + _STRIP)
        blend = np.einsum("nk,nkij->nij", fractions[rows], matrices[joints[rows]])
        linear = blend[:, :3, :3]
        moved[rows] = np.einsum("nij,nj->ni", linear, positions[rows]) + blend[:, :3, 3]
        x, y, z = linear[:, 0], linear[:, 1], linear[:, 2]
        cofactors = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
        sign = np.sign((x * cofactors[:, 0]).sum(axis=1))
        mirrored += int((sign < 0.0).sum())
        if turned is not None and normals is not None:
            turned[rows] = np.einsum("nij,nj->ni", cofactors, normals[rows]) * sign[:, None]
    return moved, turned, 2 * mirrored > len(positions)
