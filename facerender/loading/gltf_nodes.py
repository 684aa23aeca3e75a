"""The nodes of a glTF scene and their world matrices."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from facerender.loading.gltf_document import Doc

_TRANSFORMS = ("matrix", "translation", "rotation", "scale")


class Node(NamedTuple):
    """A node of a scene.

    Attributes
    ----------
    number, properties : index and JSON object of the node
    world : (4, 4), transforms column vectors from node space to scene space
    visible : whether the node and all of its ancestors are visible (KHR_node_visibility)
    """

    number: int
    properties: Doc
    world: NDArray[np.float64]
    visible: bool


def scene_nodes(document: Doc) -> Iterator[Node]:
    """Yield the nodes of a checked document's scene, parents first; without a scene, all nodes.

    Raises
    ------
    ValueError : a node has two parents, or is its own ancestor
    """
    nodes = document["nodes"]
    if scenes := document["scenes"]:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", ())}
        roots = sorted(set(range(len(nodes))) - children)
    found: set[int] = set()
    queue = [(index, np.eye(4), True) for index in reversed(roots)]
    while queue:
        index, world, visible = queue.pop()
        if index in found:
            raise ValueError(f"nodes[{index}] has two parents, or is its own ancestor")
        found.add(index)
        node = nodes[index]
        if not node.keys().isdisjoint(_TRANSFORMS):
            world = world @ transform(node)
        own = node.get("extensions", {}).get("KHR_node_visibility", {})
        visible = visible and own.get("visible", True)
        yield Node(index, node, world, visible)
        queue += [(child, world, visible) for child in reversed(node.get("children", []))]


def transform(node: Doc) -> NDArray[np.float64]:
    """Return the local matrix of a node, (4, 4), for column vectors."""
    matrix = np.eye(4)
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    local = np.eye(4)
    if "rotation" in node:
        local[:3, :3] = _rotation(np.array(node["rotation"], dtype=np.float64))
    if "scale" in node:
        local[:3, :3] *= np.array(node["scale"], dtype=np.float64)
    if "translation" in node:
        local[:3, 3] = node["translation"]
    return matrix @ local


def _rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix (3, 3) of a quaternion x, y, z, w of any length."""
    length = float(np.linalg.norm(quaternion))
    if not 1e-12 < length < np.inf:
        return np.eye(3)
    x, y, z, w = quaternion / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
