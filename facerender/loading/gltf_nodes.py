"""The nodes of a glTF scene and their world matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facerender.loading.gltf_document import Doc
from facerender.scenes.rig import Node, Skeleton

_TRANSFORMS = ("matrix", "translation", "rotation", "scale")


@dataclass(frozen=True)
class SceneNode:
    """A node of a scene."""

    number: int
    properties: Doc
    world: NDArray[np.float64]  # (4, 4), transforms column vectors from node space to scene space
    visible: bool  # whether the node and all of its ancestors are visible (KHR_node_visibility)


def scene_nodes(document: Doc) -> tuple[Skeleton, Sequence[SceneNode]]:
    """Return the nodes of a checked document's scene, parents first; without a scene, all nodes.
    The skeleton has no clips.

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
    tree: dict[int, Node] = {}
    visible: dict[int | None, bool] = {None: True}
    queue: list[tuple[int, int | None]] = [(index, None) for index in reversed(roots)]
    while queue:
        index, parent = queue.pop()
        if index in tree:
            raise ValueError(f"nodes[{index}] has two parents, or is its own ancestor")
        node = nodes[index]
        transforms = {key: tuple(node[key]) for key in _TRANSFORMS if key in node}
        tree[index] = Node(index, parent, **transforms)
        visibility = node.get("extensions", {}).get("KHR_node_visibility", {})
        visible[index] = visible[parent] and visibility.get("visible", True)
        queue += [(child, index) for child in reversed(node.get("children", []))]
    skeleton = Skeleton(tuple(tree.values()))
    worlds = skeleton.worlds({})
    return skeleton, [SceneNode(i, nodes[i], worlds[i], visible[i]) for i in tree]
