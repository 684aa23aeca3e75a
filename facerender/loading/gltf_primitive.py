"""Primitives of glTF files: their triangles, and the attributes of the vertices of these; skins."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason
from facerender.loading.gltf_buffers import Buffers, Doc
from facerender.loading.gltf_material import TextureTransform

_TRIANGLES, _FAN = 4, 6  # modes; 5 are strips
_DRACO = "KHR_draco_mesh_compression"
_AT_ONCE = 1 << 16  # vertices at a time, of which each has a matrix

Float = NDArray[np.float64]


def has_triangles(properties: Doc) -> bool:
    """Whether a primitive has triangles, and vertices with positions."""
    mode = properties.get("mode", _TRIANGLES)
    return bool(mode >= _TRIANGLES and "POSITION" in properties["attributes"])


class Primitive:
    """The triangles of a primitive. Methods raise ValueError for what is damaged.

    Attributes
    ----------
    properties : of the document
    where : its path in the document, for messages
    positions : (N, 3), of all vertices
    vertices : which of them the faces use
    faces : (F, 3), of these vertices
    corner_count : how many vertices the indices name
    out_of_range : number of the other faces, of vertices that are not there
    """

    def __init__(self, buffers: Buffers, properties: Doc, where: str) -> None:
        self.buffers, self.properties, self.where = buffers, properties, where
        draco = properties.get("extensions", {}).get(_DRACO)
        self.decoded = {} if draco is None else self._draco(draco)
        positions = self._attribute("POSITION", (3,))
        assert positions is not None
        self.positions = positions
        corners = self._corners()
        self.corner_count = len(corners)
        faces = _triangles(corners, properties.get("mode", _TRIANGLES), where)
        self.faces, self.vertices, self.out_of_range = _compact(faces, len(positions))

    def _attribute(self, key: str, widths: tuple[int, ...]) -> NDArray[Any] | None:
        accessors = self.properties["attributes"]
        if key not in accessors:
            return None
        values = self.decoded.get(key)
        if values is None:
            values = self.buffers.accessor(accessors[key])
        if values.ndim != 2 or values.shape[1] not in widths:
            raise ValueError(f"{self.where}: {key} has the wrong type")
        return values

    def _corners(self) -> NDArray[Any]:
        """Return the vertices that the primitive names one after the other."""
        if "faces" in self.decoded:
            return self.decoded["faces"].reshape(-1)
        if "indices" not in self.properties:
            return np.arange(len(self.positions))
        indices = self.buffers.accessor(self.properties["indices"])
        if indices.shape[1] != 1 or indices.dtype.kind != "u":
            raise ValueError(f"{self.where}: its indices have the wrong type")
        return indices.reshape(-1)

    def column(self, key: str, *widths: int) -> NDArray[Any] | None:
        """Return an attribute, (N, one of the widths), of the vertices that the faces use."""
        values = self._attribute(key, widths)
        if values is not None and len(values) != len(self.positions):
            raise ValueError(
                f"{self.where}: {key} has {len(values)} entries, POSITION {len(self.positions)}"
            )
        return None if values is None else values[self.vertices]

    def uv(self, transform: TextureTransform | None) -> NDArray[np.float64] | None:
        """Return texture coordinates, v upwards, or None where they are not there."""
        if transform is None:
            return None
        uv = self.column(f"TEXCOORD_{transform.texcoord}", 2)
        return None if uv is None else transform.applied(uv)

    def influences(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return joints and their weights, (N, 4) or (N, 8), or None."""
        accessors = self.properties["attributes"]
        sets = [i for i in (0, 1) if f"JOINTS_{i}" in accessors and f"WEIGHTS_{i}" in accessors]
        if not sets:
            return None
        joints, weights = (
            np.concatenate([np.asarray(self.column(f"{key}_{i}", 4)) for i in sets], axis=1)
            for key in ("JOINTS", "WEIGHTS")
        )
        if joints.dtype.kind != "u":
            raise ValueError(f"{self.where}: its joints have the wrong type")
        return joints, weights

    def _draco(self, draco: Doc) -> dict[str, NDArray[Any]]:
        """Return what is compressed of a primitive: attributes by name, and faces."""
        try:
            import DracoPy
        except ImportError:
            name = self.buffers.name
            raise InputError(f"{name} is compressed with Draco: pip install DracoPy") from None
        content = bytes(self.buffers.view(draco["bufferView"]))
        try:
            decoded = DracoPy.decode(content)
            found = {each["unique_id"]: np.asarray(each["data"]) for each in decoded.attributes}
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # its decoder fails in several ways
            raise ValueError(f"{self.where}: Draco says {reason(error)}") from None
        values = {key: found[i] for key, i in draco["attributes"].items() if i in found}
        return values if faces is None else values | {"faces": np.asarray(faces)}


def _triangles(flat: NDArray[Any], mode: int, where: str) -> NDArray[np.int64]:
    """Return the faces (F, 3) of a list, strip or fan of vertices."""
    flat = flat.astype(np.int64)
    if mode == _TRIANGLES:
        if len(flat) % 3:
            raise ValueError(f"{where}: {len(flat)} corners are no triangles")
        return flat.reshape(-1, 3)
    if mode == _FAN:
        first = np.full_like(flat[2:], flat[0] if len(flat) else 0)
        return np.stack([first, flat[1:-1], flat[2:]], axis=1)
    strip = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
    strip[1::2] = strip[1::2, ::-1]
    return strip


def _compact(
    faces: NDArray[np.int64], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64] | slice, int]:
    """Return the faces of the vertices that are there, which vertices to keep, and how many faces
    are of others. Where primitives share vertices, most of them are another's."""
    known = (faces < count).all(axis=1)
    out_of_range = len(faces) - int(known.sum())
    if out_of_range:
        faces = faces[known]
    if count <= 3 * len(faces):
        return faces, slice(None), out_of_range
    vertices, inverse = np.unique(faces, return_inverse=True)
    return inverse.reshape(-1, 3), vertices, out_of_range


def unit_colors(colors: NDArray[Any]) -> NDArray[np.float64]:
    """Return linear RGB in [0, 1]."""
    if colors.dtype.kind != "f":  # not said to be normalised, and meant so
        colors = colors / np.iinfo(colors.dtype).max
    return np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)


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
    for start in range(0, len(positions), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
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
