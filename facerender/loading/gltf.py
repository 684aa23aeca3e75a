"""Read all mesh instances with triangles from a .gltf or .glb file, in the stored pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.gltf_accessors import Buffers, RigReader
from facerender.loading.gltf_document import EXTENSIONS, Doc, chunks, damaged, document_of
from facerender.loading.gltf_material import Look, Materials, TextureTransform
from facerender.loading.source import References
from facerender.scenes.framing import names_head
from facerender.scenes.material import MAPS, Material
from facerender.scenes.repair import Piece, check_count, placed
from facerender.scenes.rig import Node, Rig, Shape, Skeleton, Skin, local_matrix, morphed, skinned

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


_TRIANGLES, _FAN = 4, 6  # primitive modes; mode 5 is a strip
_DRACO = "KHR_draco_mesh_compression"
_BELOW_JOINT = 0.5  # maximum: part of a head below its joint / part of the head above its joint

Float = NDArray[np.float64]
_Joints = tuple[tuple[int, ...], Float | None]  # joints and inverse bind matrices (J, 4, 4)
_Head = tuple[NDArray[np.bool_], float]  # mask of the joints of a head, height of the first


class Primitive:
    """The triangles of a glTF primitive. Methods raise ValueError if the data are damaged.

    Attributes
    ----------
    properties : the primitive's JSON object
    where : the primitive's path in the document, for messages
    positions : (N, 3), all vertices
    vertices : indices of the vertices that the faces use, or the slice of all vertices
    faces : (F, 3), indices into ``positions[vertices]``
    corner_count : number of the primitive's vertex indices in the file
    out_of_range : number of faces that were dropped because they use a missing vertex
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
        if key in self.decoded:
            values = self.buffers.converted(self.decoded[key], accessors[key])
        else:
            values = self.buffers.accessor(accessors[key])
        if values.ndim != 2 or values.shape[1] not in widths:
            raise ValueError(f"{self.where}: {key} has the wrong type")
        return values

    def _corners(self) -> NDArray[Any]:
        """Return the vertex index of each corner in file order."""
        if "faces" in self.decoded:
            return self.decoded["faces"].reshape(-1)
        if "indices" not in self.properties:
            return np.arange(len(self.positions))
        indices = self.buffers.accessor(self.properties["indices"])
        if indices.shape[1] != 1 or indices.dtype.kind != "u":
            raise ValueError(f"{self.where}: its indices have the wrong type")
        return indices.reshape(-1)

    def column(self, key: str, *widths: int) -> NDArray[Any] | None:
        """Return an attribute's values at ``vertices``, (N, K in ``widths``); None if missing."""
        values = self._attribute(key, widths)
        if values is not None and len(values) != len(self.positions):
            raise ValueError(
                f"{self.where}: {key} has {len(values)} entries, POSITION has {len(self.positions)}"
            )
        return None if values is None else values[self.vertices]

    def uv(self, transform: TextureTransform | None) -> NDArray[np.float64] | None:
        """Return texture coordinates with v upwards; None if they are missing."""
        if transform is None:
            return None
        uv = self.column(f"TEXCOORD_{transform.texcoord}", 2)
        return None if uv is None else transform.applied(uv)

    def influences(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Return joint indices and weights, (N, 4 or 8), of ``vertices``; None without joints."""
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
        """Return the decompressed attributes, keyed by name. Any faces have the key "faces"."""
        try:
            import DracoPy
        except ImportError:
            name = self.buffers.name
            raise InputError(f"{name} is compressed with Draco: pip install DracoPy") from None
        content = bytes(self.buffers.view(draco["bufferView"]))
        try:
            decoded = DracoPy.decode(content)
            arrays = {
                attribute["unique_id"]: np.asarray(attribute["data"])
                for attribute in decoded.attributes
            }
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # DracoPy raises several exceptions
            raise ValueError(f"{self.where}: DracoPy failed: {reason(error)}") from None
        attributes = {key: arrays[i] for key, i in draco["attributes"].items() if i in arrays}
        return attributes if faces is None else attributes | {"faces": np.asarray(faces)}


def _triangles(flat: NDArray[Any], mode: int, where: str) -> NDArray[np.int64]:
    """Return the faces (F, 3) of a triangle list, strip or fan."""
    flat = flat.astype(np.int64)
    if mode == _TRIANGLES:
        if len(flat) % 3:
            raise ValueError(f"{where}: {len(flat)} corners are not a multiple of 3")
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
    """Return the valid faces as indices into the kept vertices, the indices of the kept vertices,
    and the number of dropped faces.

    Primitives may share a vertex array, so most of its vertices may belong to other primitives.
    """
    valid = (faces < count).all(axis=1)
    out_of_range = len(faces) - int(valid.sum())
    if out_of_range:
        faces = faces[valid]
    if count <= 3 * len(faces):
        return faces, slice(None), out_of_range
    vertices, inverse = np.unique(faces, return_inverse=True)
    return inverse.reshape(-1, 3), vertices, out_of_range


def head_bounds(
    positions: Float,
    joints: NDArray[Any],
    weights: NDArray[Any],
    of_head: NDArray[np.bool_],
    height: float,
) -> Float | None:
    """Return the bounds (2, 3) of the vertices that follow the joints of a head, without hair far
    below the head; None without such vertices.

    Parameters
    ----------
    positions : (N, 3), skinned
    joints, weights : (N, K), indices and weights of K joints per vertex
    of_head : (J,), mask of the joints
    height : y of the head's first joint
    """
    shares = np.where(of_head[joints], weights, 0.0).sum(axis=1)
    head = positions[2.0 * shares > weights.sum(axis=1)]
    if not len(head):
        return None
    low, high = head.min(axis=0), head.max(axis=0)
    low[1] = max(low[1], height - _BELOW_JOINT * (high[1] - height))
    return np.array([low, high])


# Limit of the drawn vertices plus faces: 8 times the number of stored elements, plus 2^20.
_TIMES, _MOST_REPEATED = 8, 1 << 20


def read_gltf(data: bytes, referred: References, albedo_given: bool) -> list[Piece]:
    """Return a piece for every primitive instance with triangles.

    referred : reader of the buffers and images that are separate files
    albedo_given : whether the caller replaces albedo maps, which may then be missing or unreadable

    Raises
    ------
    InputError : the file is damaged, has no mesh, requires an unsupported extension, or has too
        many pieces, vertices or faces
    """
    name = referred.name
    text, binary = chunks(data, name)
    document = document_of(text, name)
    for extension in sorted(document.get("extensionsRequired", ())):
        if extension not in EXTENSIONS or EXTENSIONS[extension].fate == "refused":
            raise InputError(
                f"{name} requires the extension {clipped(extension, 60)}; export it without this"
            )
    try:
        return _File(name, document, binary, referred, albedo_given).pieces()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise damaged(name, reason(error)) from None


@dataclass(frozen=True)
class _Instance:
    """An instance of a mesh, placed by a node."""

    mesh: int
    name: str
    node: int
    offset: Float | None  # transform of the instance within the node's space; None: no transform
    world: Float
    weights: tuple[float, ...]  # of the morph targets
    skin: int | None  # index of the skin, whose joints place the mesh; None: the node places it
    joints: _Joints | None


class _File:
    """A glTF file with checked JSON and unchecked buffers. Methods raise ValueError if the data are
    damaged."""

    def __init__(
        self,
        name: str,
        document: Doc,
        binary: memoryview | None,
        referred: References,
        albedo_given: bool,
    ) -> None:
        self.name = name
        self.document = document
        self.buffers = Buffers(name, document, binary, referred)
        self.materials = Materials(self.buffers, albedo_given)
        self.warn = self.materials.warn
        self.worlds: dict[int, Float] = {}  # matrices, keyed by the node's index
        self.rigs = RigReader(self.buffers)
        self.skeleton = Skeleton(())
        self.moving: set[int] | None = set()  # nodes that clips move; None: all
        self.skins: dict[int | None, _Joints | None] = {}
        self.shapes: dict[str, tuple[Shape, ...]] = {}  # keyed by the primitive's path
        self.own: dict[int, int] = {}  # number of stored elements, keyed by the accessor's index
        self.drawn = 0  # number of drawn vertices and faces

    def pieces(self) -> list[Piece]:
        for extension in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.warn(f"{self.name} uses {clipped(extension, 60)}, which is not supported: ignored")
        meshes: dict[tuple[int, int | None, tuple[float, ...]], list[Piece]] = {}
        pieces = []
        for instance in self._instances():
            key = instance.mesh, instance.skin, instance.weights
            if key not in meshes:
                meshes[key] = self._mesh(instance)
            for piece in meshes[key]:
                self._count_drawn(len(piece.positions) + len(piece.faces))
                name = ".".join(filter(None, (instance.name, piece.name)))
                if rig := piece.rig:
                    node, offset = instance.node, instance.offset
                    nodes = {node} if rig.skin is None else {*rig.skin.joints}
                    moves = rig.shapes or self.moving is None or self.moving & nodes
                    rig = replace(rig, node=node, offset=offset) if moves else None
                pieces.append(replace(placed(piece, instance.world), name=name, rig=rig))
        return pieces

    def _mesh(self, instance: _Instance) -> list[Piece]:
        mesh = self.document["meshes"][instance.mesh]
        head = None if instance.joints is None else self._head_joints(instance.joints[0])
        where = f"meshes[{instance.mesh}].primitives"
        primitives = enumerate(mesh["primitives"])
        results = [self._piece(p, f"{where}[{i}]", instance, head) for i, p in primitives]
        pieces = [*filter(None, results)]
        if len(pieces) == 1:
            pieces[0].name = ""  # the material's name is only needed to distinguish several pieces
        return pieces

    def _count_drawn(self, count: int) -> None:
        self.drawn += count
        if self.drawn > _TIMES * sum(self.own.values()) + _MOST_REPEATED:
            raise InputError(
                f"{self.name} draws its geometry more than {_TIMES} times: export fewer instances"
            )

    # --- nodes -----------------------------------------------------------------------------------

    def _instances(self) -> list[_Instance]:
        """Return all visible mesh instances. An instance is named after its node or, if the node
        has no name, after its mesh."""
        instances: list[_Instance] = []
        count = 0
        self.skeleton, nodes = scene_nodes(self.document)
        self.worlds = {scene_node.number: scene_node.world for scene_node in nodes}
        if clips := self.rigs.clips():
            self.skeleton = replace(self.skeleton, clips=clips)
            # A damaged clip may move any node. Parts need a rig to report the damage.
            self.moving = None
            if not any(clip.fault for clip in clips):
                moved = {track.node for clip in clips for track in clip.tracks}
                self.moving = self.skeleton.below(moved)
        for scene_node in nodes:
            node = scene_node.properties
            extensions = node.get("extensions", {})
            if "KHR_lights_punctual" in extensions:
                self.warn(f"{self.name} has lights (KHR_lights_punctual): ignored; use --light")
            if "mesh" not in node or not scene_node.visible:
                continue
            mesh = self.document["meshes"][node["mesh"]]
            places = self._places(scene_node.number, extensions.get("EXT_mesh_gpu_instancing"))
            count += len(mesh["primitives"]) * len(places)
            check_count(count, self.name)
            name = node.get("name") or mesh.get("name") or ""
            weights = tuple(map(float, node.get("weights", mesh.get("weights", ()))))
            skin, number = node.get("skin"), scene_node.number
            if skin is not None and skin not in self.skins:
                self.skins[skin] = self._joints(skin)
            if (joints := self.skins.get(skin)) is None:
                skin = None
            for offset in places:
                world = scene_node.world if offset is None else scene_node.world @ offset
                if joints is not None:
                    world = np.eye(4)  # a skinned mesh ignores its node's transform
                instances.append(
                    _Instance(node["mesh"], name, number, offset, world, weights, skin, joints)
                )
        return instances

    def _places(self, index: int, instances: Doc | None) -> Sequence[Float | None]:
        """Return the transform of each instance of a node's mesh within the node's space."""
        if instances is None:
            return [None]
        accessors, keys = instances["attributes"], ("TRANSLATION", "ROTATION", "SCALE")
        columns = {k.lower(): self.buffers.accessor(accessors[k]) for k in keys if k in accessors}
        for key, values in columns.items():
            if values.shape[1] != (4 if key == "rotation" else 3):
                raise ValueError(f"nodes[{index}]: the {key} of its instances has the wrong type")
        count = min((len(values) for values in columns.values()), default=0)
        check_count(count, self.name)
        rows = ({key: values[i] for key, values in columns.items()} for i in range(count))
        return [local_matrix(**row) for row in rows]

    def _joints(self, index: int) -> _Joints | None:
        """Return the joints and the inverse bind matrices (J, 4, 4) of a skin. Warn and return None
        if a joint is not in the scene."""
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

    def _head_joints(self, joints: tuple[int, ...]) -> _Head | None:
        """Return a mask of the joints that belong to a head by their names or by the name of an
        ancestor, and the height of the first of them; None without such a joint."""
        nodes = self.document["nodes"]
        heads = [i for i in self.worlds if names_head(nodes[i].get("name", ""))]
        inside, queue = set(heads), heads
        while queue:
            queue = [child for i in queue for child in nodes[i].get("children", ())]
            inside.update(queue)
        mask = np.array([joint in inside for joint in joints])
        if not mask.any():
            return None
        return mask, float(self.worlds[joints[int(mask.argmax())]][1, 3])

    # --- triangles -------------------------------------------------------------------------------

    def _piece(
        self, properties: Doc, where: str, instance: _Instance, head: _Head | None
    ) -> Piece | None:
        """Return a primitive as a piece in mesh space, or in scene space if it is skinned. Return
        None for a primitive without triangles."""
        attributes = properties["attributes"]
        if properties.get("mode", _TRIANGLES) < _TRIANGLES or "POSITION" not in attributes:
            self.warn(f"{self.name} has points, lines or vertices without positions: not drawn")
            return None
        primitive = Primitive(self.buffers, properties, where)
        self.own[attributes["POSITION"]] = len(primitive.positions)
        self.own[properties.get("indices", -1)] = primitive.corner_count
        base, base_normals = primitive.positions[primitive.vertices], primitive.column("NORMAL", 3)
        shapes = self._shapes(primitive, base_normals is not None, instance)
        shape, normals = morphed(base, base_normals, shapes, instance.weights)
        faces, bounds, skin = primitive.faces, None, None
        if instance.joints is not None:
            if "JOINTS_2" in attributes:
                self.warn(f"{self.name} has more than eight joints per vertex: only eight are used")
            if influences := primitive.influences():
                skin = Skin.of(*instance.joints, *influences)
                shape, normals, mirrored = skinned(shape, normals, skin, self.worlds)
                faces = faces[:, ::-1] if mirrored else faces
                bounds = head and head_bounds(shape, *influences, *head)
        number = properties.get("material")
        called = "" if number is None else self.document["materials"][number].get("name", "")
        colors = primitive.column("COLOR_0", 3, 4)
        look = self.materials.look(number, colors is not None)
        if colors is not None and colors.shape[1] == 4 and look.material.alpha != "opaque":
            self.warn(f"{self.name} has alpha in its vertex colours: ignored")
        if colors is not None:
            if colors.dtype.kind != "f":  # normalise integers even without the flag "normalized"
                colors = colors / np.iinfo(colors.dtype).max
            colors = np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)
        uv, uv2 = primitive.uv(look.first), primitive.uv(look.second)
        rig = None
        if shapes or self.skeleton.clips:
            arrays = np.array(base), None if base_normals is None else np.array(base_normals)
            weights, by_node = instance.weights, instance.skin is None
            rig = Rig(self.skeleton, instance.node, *arrays, weights, shapes, skin, by_node)
        return Piece(
            positions=np.asarray(shape, dtype=np.float64),
            faces=faces,
            normals=normals,
            uv=uv,
            colors=colors,
            material=self._drawn_material(look, uv is not None, uv2 is not None),
            out_of_range=primitive.out_of_range,
            name=called,
            uv2=None if uv is None else uv2,
            material_name=called,
            head=bounds,
            rig=rig,
        )

    def _drawn_material(self, look: Look, has_uv: bool, has_uv2: bool) -> Material:
        """Return a look's material without the maps whose texture coordinates are missing."""
        material = look.material
        if not has_uv:
            if any(getattr(material, key) for key in MAPS):
                self.warn(f"{self.name} has no texture coordinates: its texture is ignored")
            return material
        if has_uv2 or not material.second_uv:
            return material
        self.warn(f"{self.name} has no second texture coordinates: maps that use them are ignored")
        no_maps: dict[str, Any] = dict.fromkeys(material.second_uv)
        return replace(material, second_uv=(), **no_maps)

    def _shapes(
        self, primitive: Primitive, has_normals: bool, instance: _Instance
    ) -> tuple[Shape, ...]:
        """Return a primitive's morph targets, and count the vertices of the targets that the stored
        pose uses."""
        targets = primitive.properties.get("targets", ())
        if targets and primitive.where not in self.shapes:
            mesh = self.document["meshes"][instance.mesh]
            extras = mesh.get("extras")
            self.shapes[primitive.where] = self.rigs.shapes(primitive, extras, has_normals)
        for target, weight in zip(targets, instance.weights, strict=False):
            for key in ("POSITION", "NORMAL"):
                if weight and key in target and (has_normals or key == "POSITION"):
                    count = self.document["accessors"][target[key]]["count"]
                    self.own[target[key]] = count
                    self._count_drawn(count)
        return self.shapes.get(primitive.where, ())
