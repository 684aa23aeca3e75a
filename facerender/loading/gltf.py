"""Read all mesh instances with triangles from a .gltf or .glb file, in the stored pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped
from facerender.loading.gltf_accessors import TRIANGLES, Buffers, Primitive, RigReader
from facerender.loading.gltf_document import EXTENSIONS, Doc, chunks, damaged, document_of
from facerender.loading.gltf_material import Materials
from facerender.loading.source import References
from facerender.material import MAPS, Material
from facerender.mesh.framing import names_head
from facerender.mesh.repair import Piece, check_count, placed
from facerender.mesh.rig import Node, Rig, Shape, Skeleton, Skin, local_matrix, morphed, skinned
from facerender.values.vectors import transformed

_TRANSFORMS = ("matrix", "translation", "rotation", "scale")
# Limit of the used vertices plus faces: 8 times the number of stored elements, plus 2^20.
_TIMES, _MOST_REPEATED = 8, 1 << 20

Float = NDArray[np.float64]


def scene_nodes(
    document: Doc, name: str, axes: Float | None
) -> tuple[Skeleton, dict[int, Float], set[int]]:
    """Return the nodes of a checked document's scene as a skeleton without clips, their world
    matrices (4, 4), and the visible nodes. Without a scene, all nodes are used.

    axes : see :func:`facerender.values.vectors.axes_of`

    The matrices are keyed by the node's index, parents first. A node is visible if it and all of
    its ancestors are (KHR_node_visibility). Raises InputError if a node has two parents, or is its
    own ancestor.
    """
    nodes = document["nodes"]
    if scenes := document["scenes"]:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", ())}
        roots = sorted(set(range(len(nodes))) - children)
    tree: dict[int, Node] = {}
    visible: set[int] = set()
    queue: list[tuple[int, int | None]] = [(index, None) for index in reversed(roots)]
    while queue:
        index, parent = queue.pop()
        if index in tree:
            raise damaged(name, f"nodes[{index}] has two parents, or is its own ancestor")
        node = nodes[index]
        transforms = {key: node[key] for key in _TRANSFORMS if key in node}
        tree[index] = Node(index, parent, transforms)
        visibility = node.get("extensions", {}).get("KHR_node_visibility", {})
        if visibility.get("visible", True) and (parent is None or parent in visible):
            visible.add(index)
        queue += [(child, index) for child in reversed(node.get("children", []))]
    skeleton = Skeleton(tuple(tree.values()), root=axes)
    return skeleton, skeleton.worlds({}), visible


def read_gltf(
    data: bytes, references: References, albedo_given: bool, axes: Float | None
) -> list[Piece]:
    """Return a piece for every primitive instance with triangles.

    references : reader of the buffers and images that are separate files
    albedo_given : whether the caller replaces albedo maps, which may then be missing or unreadable
    axes : see :func:`facerender.values.vectors.axes_of`

    Raises
    ------
    InputError : the JSON is damaged or has no mesh, or the file requires an unsupported extension
        or has too many pieces, vertices or faces
    ValueError : the binary data are damaged
    """
    name = references.name
    text, binary = chunks(data, name)
    document = document_of(text, name)
    for extension in sorted(document.get("extensionsRequired", ())):
        if EXTENSIONS.get(extension, ("refused",))[0] == "refused":
            raise InputError(
                f"{name} requires the extension {clipped(extension, 60)}; export it without this"
            )
    return _File(Buffers(name, document, binary, references), albedo_given, axes).pieces()


class _File:
    """A glTF file with checked JSON. Methods raise ValueError if the binary data are damaged.
    A mesh is read once per skin and weights of its nodes. Parameter ``skin`` is the index of the
    skin whose joints place the mesh; None: the node places it.
    """

    def __init__(self, buffers: Buffers, albedo_given: bool, axes: Float | None) -> None:
        self.buffers, self.name, self.document = buffers, buffers.name, buffers.document
        self.materials = Materials(buffers, albedo_given)
        self.warn = self.materials.warn
        for extension in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.warn(f"{self.name} uses {clipped(extension, 60)}, which is not supported: ignored")
        skeleton, self.worlds, self.visible = scene_nodes(self.document, self.name, axes)
        self.rigs = RigReader(buffers)
        clips = self.rigs.clips()
        joints = self.rigs.joints(self.worlds)
        self.skeleton = replace(skeleton, clips=clips, joints=joints)
        moved = {track.node for clip in clips for track in clip.tracks} | {n for _, n in joints}
        if any(clip.fault for clip in clips):
            moved = {*self.worlds}  # a damaged clip may move any node; a rig reports the damage
        self.moving = self.skeleton.below(moved)
        # Joints and inverse bind matrices (J, 4, 4), keyed by the skin's index; None: skin ignored
        self.skins: dict[int | None, tuple[tuple[int, ...], Float | None] | None] = {}
        self.shapes: dict[str, tuple[Shape, ...]] = {}  # keyed by the primitive's path
        self.stored: dict[int, int] = {}  # number of elements, keyed by the accessor's index
        self.used = 0  # number of used vertices and faces, counted for every instance

    def pieces(self) -> list[Piece]:
        meshes: dict[tuple[int, int | None, tuple[float, ...]], list[Piece]] = {}
        pieces = []
        for index, offsets in self._instances().items():
            node = self.document["nodes"][index]
            mesh = self.document["meshes"][node["mesh"]]
            skin = node.get("skin") if self.skins.get(node.get("skin")) else None
            weights = tuple(node.get("weights", mesh.get("weights", ())))
            label = node.get("name") or mesh.get("name")
            key = node["mesh"], skin, weights
            if key not in meshes:
                meshes[key] = self._mesh(*key)
            for offset in offsets:
                world = self.worlds[index] if offset is None else self.worlds[index] @ offset
                if skin is not None:
                    world = np.eye(4)  # a skinned mesh ignores its node's transform
                for piece in meshes[key]:
                    self._count_used(len(piece.positions) + len(piece.faces))
                    if rig := piece.rig:
                        nodes = {index} if rig.skin is None else {*rig.skin.joints}
                        moves = rig.shapes or self.moving & nodes
                        rig = replace(rig, node=index, offset=offset) if moves else None
                    name = ".".join(filter(None, (label, piece.name)))
                    pieces.append(replace(placed(piece, world), name=name, rig=rig))
        return pieces

    def _mesh(self, index: int, skin: int | None, weights: tuple[float, ...]) -> list[Piece]:
        """Return the pieces of a mesh, in mesh space, or in scene space if they are skinned."""
        mesh = self.document["meshes"][index]
        pieces = []
        for i, properties in enumerate(mesh["primitives"]):
            attributes = properties["attributes"]
            if properties.get("mode", TRIANGLES) < TRIANGLES or "POSITION" not in attributes:
                self.warn(f"{self.name} has points, lines or vertices without positions: not drawn")
                continue
            primitive = Primitive(self.buffers, mesh, i, f"meshes[{index}].primitives[{i}]")
            pieces.append(self._piece(primitive, skin, weights))
        if len(pieces) == 1:
            pieces[0].name = ""  # the material's name is only needed to distinguish several pieces
        return pieces

    def _count_used(self, count: int) -> None:
        self.used += count
        if self.used > _TIMES * sum(self.stored.values()) + _MOST_REPEATED:
            raise InputError(
                f"{self.name} draws its geometry more than {_TIMES} times: export fewer instances"
            )

    def _instances(self) -> dict[int, Sequence[Float | None]]:
        """Return the transforms of the instances of each visible node with a mesh, keyed by the
        node's index; None: no transform."""
        instances: dict[int, Sequence[Float | None]] = {}
        count = 0
        for index in self.worlds:
            node = self.document["nodes"][index]
            extensions = node.get("extensions", {})
            if "KHR_lights_punctual" in extensions:
                self.warn(f"{self.name} has lights (KHR_lights_punctual): ignored; use --light")
            if "mesh" not in node or index not in self.visible:
                continue
            instancing = extensions.get("EXT_mesh_gpu_instancing")
            instances[index] = self._offsets(index, instancing) if instancing else [None]
            primitives = self.document["meshes"][node["mesh"]]["primitives"]
            count += len(primitives) * len(instances[index])
            check_count(count, self.name)
            if "skin" in node and node["skin"] not in self.skins:
                self.skins[node["skin"]] = self._joints(node["skin"])
        return instances

    def _offsets(self, index: int, instancing: Doc) -> list[Float]:
        """Return the transforms of a node's instances within the node's space."""
        accessors, keys = instancing["attributes"], ("TRANSLATION", "ROTATION", "SCALE")
        columns = {k.lower(): self.buffers.accessor(accessors[k]) for k in keys if k in accessors}
        for key, values in columns.items():
            if values.shape[1] != (4 if key == "rotation" else 3):
                raise ValueError(f"nodes[{index}]: the {key} of its instances has the wrong type")
        check_count(min(map(len, columns.values()), default=0), self.name)
        rows = zip(*columns.values(), strict=False)
        return [local_matrix(dict(zip(columns, row, strict=True))) for row in rows]

    def _joints(self, index: int) -> tuple[tuple[int, ...], Float | None] | None:
        """Return the joints and inverse bind matrices of a skin; None if it is ignored."""
        skin = self.document["skins"][index]
        joints = tuple(skin["joints"])
        if not joints or not self.worlds.keys() >= set(joints):
            self.warn(f"{self.name} has a skin whose joints are not in its scene: skin ignored")
            return None
        if "inverseBindMatrices" not in skin:
            return joints, None
        inverse = self.buffers.accessor(skin["inverseBindMatrices"])
        if inverse.shape[1] != 16 or len(inverse) < len(joints):
            raise ValueError(f"skins[{index}] has {len(inverse)} matrices for {len(joints)} joints")
        columns = inverse[: len(joints)].reshape(-1, 4, 4).astype(np.float64)
        return joints, columns.transpose(0, 2, 1)

    @cached_property
    def _head_nodes(self) -> set[int]:
        """The nodes that belong to a head by their name or by the name of an ancestor."""
        names = {index: self.document["nodes"][index].get("name", "") for index in self.worlds}
        return self.skeleton.below(index for index, name in names.items() if names_head(name))

    def _head_bounds(
        self, positions: Float, skin: Skin, joints: NDArray[Any], weights: NDArray[Any]
    ) -> Float | None:
        """Return the bounds (2, 3) of the vertices that follow the joints of a head, without hair
        far below the head; None without such vertices. ``joints`` and ``weights`` are (N, K)."""
        of_head = np.array([joint in self._head_nodes for joint in skin.joints])
        shares = np.where(of_head[joints], weights, 0.0).sum(axis=1)
        head = positions[of_head.any() & (2.0 * shares > weights.sum(axis=1))]
        if not len(head):
            return None
        low, high = head.min(axis=0), head.max(axis=0)
        height = self.worlds[skin.joints[of_head.argmax()]][1, 3]
        # At most a third of a head is below its joint.
        low[1] = max(low[1], height - 0.5 * (high[1] - height))
        return np.array([low, high])

    def _piece(self, primitive: Primitive, skin: int | None, weights: tuple[float, ...]) -> Piece:
        """Return a primitive as a piece. Its rig has no node yet."""
        self.stored[primitive.attributes["POSITION"]] = len(primitive.positions)
        self.stored[primitive.properties.get("indices", -1)] = primitive.corner_count
        base, base_normals = primitive.positions[primitive.vertices], primitive.column("NORMAL", 3)
        shapes = self._shapes(primitive, weights)
        positions, normals = morphed(base, base_normals, shapes, weights)
        faces, bounds, rig_skin = primitive.faces, None, None
        if joints := self.skins.get(skin):
            if "JOINTS_2" in primitive.attributes:
                self.warn(f"{self.name} has more than eight joints per vertex: only eight are used")
            if influences := primitive.influences():
                rig_skin = Skin.of(*joints, *influences)
                positions, normals, mirrored = skinned(positions, normals, rig_skin, self.worlds)
                faces = faces[:, ::-1] if mirrored else faces
                bounds = self._head_bounds(positions, rig_skin, *influences)
            elif self.skeleton.root is not None:  # neither joints nor the node place the part
                positions, normals, _ = transformed(positions, normals, self.skeleton.root)
        index = primitive.properties.get("material")
        name = "" if index is None else self.document["materials"][index].get("name", "")
        colors = primitive.column("COLOR_0", 3, 4)
        material, first, second = self.materials.look(index, colors is not None)
        if colors is not None:
            if colors.shape[1] == 4 and material.alpha != "opaque":
                self.warn(f"{self.name} has alpha in its vertex colours: ignored")
            if colors.dtype.kind != "f":  # normalise integers even without the flag "normalized"
                colors = colors / np.iinfo(colors.dtype).max
            colors = np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)
        uv, uv2 = primitive.uv(first), primitive.uv(second)
        rig = None
        if shapes or self.moving:
            arrays = np.array(base), None if base_normals is None else np.array(base_normals)
            stored = (*weights, *[0.0] * len(shapes))[: len(shapes)]
            rig = Rig(self.skeleton, -1, *arrays, stored, shapes, rig_skin, skin is None)
        return Piece(
            positions=np.asarray(positions, dtype=np.float64),
            faces=faces,
            normals=normals,
            uv=uv,
            colors=colors,
            material=self._usable(material, uv is not None, uv2 is not None),
            out_of_range=primitive.out_of_range,
            name=name,
            uv2=None if uv is None else uv2,
            material_name=name,
            head=bounds,
            rig=rig,
        )

    def _usable(self, material: Material, has_uv: bool, has_uv2: bool) -> Material:
        """Return a material without the maps whose texture coordinates are missing."""
        if not has_uv and any(getattr(material, key) for key in MAPS):
            self.warn(f"{self.name} has no texture coordinates: its texture is ignored")
        if not has_uv or has_uv2 or not material.second_uv:
            return material
        self.warn(f"{self.name} has no second texture coordinates: maps that use them are ignored")
        no_maps: dict[str, Any] = dict.fromkeys(material.second_uv)
        return replace(material, second_uv=(), **no_maps)

    def _shapes(self, primitive: Primitive, weights: tuple[float, ...]) -> tuple[Shape, ...]:
        """Return a primitive's morph targets, and count the vertices that the stored pose uses."""
        if primitive.where not in self.shapes:
            self.shapes[primitive.where] = self.rigs.shapes(primitive)
        for target, weight in zip(primitive.targets, weights, strict=False):
            for index in target.values() if weight else ():
                count = self.stored[index] = self.document["accessors"][index]["count"]
                self._count_used(count)
        return self.shapes[primitive.where]
