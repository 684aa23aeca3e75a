"""Read all mesh instances with triangles from a .gltf or .glb file, in the stored pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.gltf_buffers import Buffers
from facerender.loading.gltf_document import Doc, chunks, damaged, document_of
from facerender.loading.gltf_features import EXTENSIONS, unsupported
from facerender.loading.gltf_material import Materials, TextureTransform
from facerender.loading.gltf_nodes import scene_nodes, transform
from facerender.loading.materials import Look
from facerender.loading.references import References
from facerender.scenes.framing import names_head
from facerender.scenes.material import MAPS, Material
from facerender.scenes.repair import Piece, check_count, placed

_TRIANGLES, _FAN = 4, 6  # primitive modes; mode 5 is a strip
_DRACO = "KHR_draco_mesh_compression"
_BELOW_JOINT = 0.5  # maximum: part of a head below its joint / part of the head above its joint
_AT_ONCE = 1 << 16  # vertices skinned at a time: each vertex needs a 4 x 4 matrix

Float = NDArray[np.float64]


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
        values = self.decoded.get(key)
        if values is None:
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
            found = {each["unique_id"]: np.asarray(each["data"]) for each in decoded.attributes}
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # DracoPy raises several exceptions
            raise ValueError(f"{self.where}: DracoPy failed: {reason(error)}") from None
        values = {key: found[i] for key, i in draco["attributes"].items() if i in found}
        return values if faces is None else values | {"faces": np.asarray(faces)}


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
    known = (faces < count).all(axis=1)
    out_of_range = len(faces) - int(known.sum())
    if out_of_range:
        faces = faces[known]
    if count <= 3 * len(faces):
        return faces, slice(None), out_of_range
    vertices, inverse = np.unique(faces, return_inverse=True)
    return inverse.reshape(-1, 3), vertices, out_of_range


def unit_colors(colors: NDArray[Any]) -> NDArray[np.float64]:
    """Return vertex colours as linear RGB in [0, 1]."""
    if colors.dtype.kind != "f":  # normalise integers even without the flag "normalized"
        colors = colors / np.iinfo(colors.dtype).max
    return np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)


def skinned(
    positions: NDArray[Any],
    normals: NDArray[Any] | None,
    joints: NDArray[Any],
    weights: NDArray[Any],
    matrices: Float,
) -> tuple[Float, Float | None, bool]:
    """Return skinned positions and normals, and whether skinning mirrors most vertices.

    Parameters
    ----------
    joints, weights : (N, K), indices and weights of K joints per vertex
    matrices : (J, 4, 4), a joint's world matrix times its inverse bind matrix; transforms column
        vectors from mesh space to scene space

    Raises
    ------
    ValueError : a joint index is out of range
    """
    if joints.size and joints.max() >= len(matrices):
        raise ValueError(f"a vertex uses joint {joints.max()}, the skin has {len(matrices)}")
    fractions = np.maximum(np.nan_to_num(weights.astype(np.float64)), 0.0)
    total = fractions.sum(axis=1, keepdims=True)
    fractions = np.where(total > 0.0, fractions / np.where(total > 0.0, total, 1.0), 0.0)
    fractions[:, 0] += total[:, 0] <= 0.0  # vertices without weights follow their first joint
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
    own = positions[2.0 * shares > weights.sum(axis=1)]
    if not len(own):
        return None
    low, high = own.min(axis=0), own.max(axis=0)
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
    if unknown := unsupported(document.get("extensionsRequired", ())):
        raise InputError(
            f"{name} requires the extension {clipped(unknown[0], 60)}; export it without this"
        )
    try:
        return _File(name, document, binary, referred, albedo_given).pieces()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise damaged(name, reason(error)) from None


@dataclass(frozen=True)
class _Instance:
    """An instance of a mesh, placed by a node.

    weights : weights of the morph targets
    skin : index of the skin, whose joints place the mesh; None: the node places the mesh
    """

    mesh: int
    name: str
    world: NDArray[np.float64]
    weights: tuple[float, ...]
    skin: int | None


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
        self.worlds: dict[int, NDArray[np.float64]] = {}  # matrices, keyed by the node's index
        self.skins: dict[int, NDArray[np.float64] | None] = {}
        self.own: dict[int, int] = {}  # number of stored elements, keyed by the accessor's index
        self.drawn = 0  # number of drawn vertices and faces

    def pieces(self) -> list[Piece]:
        for each in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.warn(f"{self.name} uses {clipped(each, 60)}, which is not supported: ignored")
        if self.document.get("animations"):
            self.warn(f"{self.name} has animations: drawn in the stored pose")
        meshes: dict[tuple[int, int | None, tuple[float, ...]], list[Piece]] = {}
        pieces = []
        for each in self._instances():
            key = each.mesh, each.skin, each.weights
            if key not in meshes:
                meshes[key] = self._mesh(each)
            for piece in meshes[key]:
                self._count_drawn(len(piece.positions) + len(piece.faces))
                own = ".".join(filter(None, (each.name, piece.name)))
                pieces.append(replace(placed(piece, each.world), name=own))
        return pieces

    def _mesh(self, instance: _Instance) -> list[Piece]:
        skin = instance.skin
        matrices = None if skin is None else self._joints(skin)
        head = None if skin is None or matrices is None else self._head_joints(skin)
        primitives = self.document["meshes"][instance.mesh]["primitives"]
        found = []
        for i, primitive in enumerate(primitives):
            where = f"meshes[{instance.mesh}].primitives[{i}]"
            if piece := self._piece(primitive, where, instance.weights, matrices, head):
                found.append(piece)
        if len(found) == 1:
            found[0].name = ""  # the material's name is only needed to distinguish several pieces
        return found

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
        found: list[_Instance] = []
        count = 0
        for index, node, world, visible in scene_nodes(self.document):
            self.worlds[index] = world
            extensions = node.get("extensions", {})
            if "KHR_lights_punctual" in extensions:
                self.warn(f"{self.name} has lights (KHR_lights_punctual): ignored; use --light")
            if "mesh" not in node or not visible:
                continue
            mesh = self.document["meshes"][node["mesh"]]
            places = self._places(index, world, extensions.get("EXT_mesh_gpu_instancing"))
            count += len(mesh["primitives"]) * len(places)
            check_count(count, self.name)
            name = node.get("name") or mesh.get("name") or ""
            weights = tuple(map(float, node.get("weights", mesh.get("weights", ()))))
            skin = node.get("skin")
            found += [_Instance(node["mesh"], name, each, weights, skin) for each in places]
        return [
            replace(each, world=np.eye(4))  # a skinned mesh ignores its node's transform
            if each.skin is not None and self._joints(each.skin) is not None
            else each
            for each in found
        ]

    def _places(
        self, index: int, world: NDArray[np.float64], instances: Doc | None
    ) -> Sequence[NDArray[np.float64]]:
        """Return the world matrix of each instance of a node's mesh (EXT_mesh_gpu_instancing)."""
        if instances is None:
            return [world]
        columns = {
            key.lower(): self.buffers.accessor(instances["attributes"][key])
            for key in ("TRANSLATION", "ROTATION", "SCALE")
            if key in instances["attributes"]
        }
        for key, values in columns.items():
            if values.shape[1] != (4 if key == "rotation" else 3):
                raise ValueError(f"nodes[{index}]: the {key} of its instances has the wrong type")
        count = min((len(values) for values in columns.values()), default=0)
        check_count(count, self.name)
        return [
            world @ transform({key: values[i] for key, values in columns.items()})
            for i in range(count)
        ]

    def _joints(self, index: int) -> NDArray[np.float64] | None:
        """Return the joint matrices of a skin (J, 4, 4). Warn and return None if a joint is not in
        the scene."""
        if index not in self.skins:
            self.skins[index] = self._matrices(index)
        return self.skins[index]

    def _matrices(self, index: int) -> NDArray[np.float64] | None:
        skin = self.document["skins"][index]
        joints = skin["joints"]
        if not joints or not self.worlds.keys() >= set(joints):
            self.warn(f"{self.name} has a skin whose joints are not in its scene: skin ignored")
            return None
        worlds = np.stack([self.worlds[joint] for joint in joints])
        if "inverseBindMatrices" not in skin:
            return worlds
        inverse = self.buffers.accessor(skin["inverseBindMatrices"])
        if inverse.shape[1] != 16 or len(inverse) < len(joints):
            raise ValueError(f"skins[{index}] has {len(inverse)} matrices for {len(joints)} joints")
        columns = inverse[: len(joints)].reshape(-1, 4, 4).astype(np.float64)
        return np.asarray(worlds @ columns.transpose(0, 2, 1))

    def _head_joints(self, index: int) -> tuple[NDArray[np.bool_], float] | None:
        """Return a mask of the joints of a skin that belong to a head by their names or by the name
        of an ancestor, and the height of the first of them; None without such a joint."""
        nodes = self.document["nodes"]
        heads = [i for i in self.worlds if names_head(nodes[i].get("name", ""))]
        inside, queue = set(heads), heads
        while queue:
            queue = [child for i in queue for child in nodes[i].get("children", ())]
            inside.update(queue)
        joints = self.document["skins"][index]["joints"]
        mask = np.array([joint in inside for joint in joints])
        if not mask.any():
            return None
        return mask, float(self.worlds[joints[int(mask.argmax())]][1, 3])

    # --- triangles -------------------------------------------------------------------------------

    def _piece(
        self,
        properties: Doc,
        where: str,
        weights: Sequence[float],
        matrices: NDArray[np.float64] | None,
        head: tuple[NDArray[np.bool_], float] | None,
    ) -> Piece | None:
        """Return a primitive as a piece in mesh space, or in scene space if it is skinned. Return
        None for a primitive without triangles.

        Parameters
        ----------
        weights : weights of the morph targets
        matrices : joint matrices of the skin (J, 4, 4); None without a skin
        head : result of :meth:`_head_joints`; None without a skin
        """
        attributes = properties["attributes"]
        if properties.get("mode", _TRIANGLES) < _TRIANGLES or "POSITION" not in attributes:
            self.warn(f"{self.name} has points, lines or vertices without positions: not drawn")
            return None
        primitive = Primitive(self.buffers, properties, where)
        self.own[attributes["POSITION"]] = len(primitive.positions)
        self.own[properties.get("indices", -1)] = primitive.corner_count
        shape, normals = self._morphed(primitive, weights)
        faces, bounds = primitive.faces, None
        if matrices is not None:
            if "JOINTS_2" in attributes:
                self.warn(f"{self.name} has more than eight joints per vertex: only eight are used")
            if influences := primitive.influences():
                shape, normals, mirrored = skinned(shape, normals, *influences, matrices)
                faces = faces[:, ::-1] if mirrored else faces
                bounds = head and head_bounds(shape, *influences, *head)
        number = properties.get("material")
        called = "" if number is None else self.document["materials"][number].get("name", "")
        colors = primitive.column("COLOR_0", 3, 4)
        look = self.materials.look(number, colors is not None)
        if colors is not None and colors.shape[1] == 4 and look.material.alpha != "opaque":
            self.warn(f"{self.name} has alpha in its vertex colours: ignored")
        uv, uv2 = primitive.uv(look.first), primitive.uv(look.second)
        return Piece(
            positions=np.asarray(shape, dtype=np.float64),
            faces=faces,
            normals=normals,
            uv=uv,
            colors=None if colors is None else unit_colors(colors),
            material=self._drawn_material(look, uv is not None, uv2 is not None),
            out_of_range=primitive.out_of_range,
            name=called,
            uv2=None if uv is None else uv2,
            material_name=called,
            head=bounds,
        )

    def _drawn_material(self, look: Look[TextureTransform], first: bool, second: bool) -> Material:
        """Return a look's material without the maps whose texture coordinates are missing."""
        material = look.material
        if not first:
            if any(getattr(material, key) for key in MAPS):
                self.warn(f"{self.name} has no texture coordinates: its texture is ignored")
            return material
        if second or not material.second_uv:
            return material
        self.warn(f"{self.name} has no second texture coordinates: maps that use them are ignored")
        without: dict[str, Any] = dict.fromkeys(material.second_uv)
        return replace(material, second_uv=(), **without)

    def _morphed(
        self, primitive: Primitive, weights: Sequence[float]
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Return positions and normals of a primitive's vertices, with morph targets applied."""
        shape, normals = primitive.positions[primitive.vertices], primitive.column("NORMAL", 3)
        targets = primitive.properties.get("targets", ())
        for i, (target, weight) in enumerate(zip(targets, weights, strict=False)):
            for key in ("POSITION", "NORMAL"):
                if not weight or key not in target or (key == "NORMAL" and normals is None):
                    continue
                moves = self.buffers.accessor(target[key])
                self.own[target[key]] = len(moves)
                self._count_drawn(len(moves))
                if moves.shape != primitive.positions.shape:
                    raise ValueError(
                        f"{primitive.where}.targets[{i}]: {key} has the wrong number of entries"
                    )
                step = weight * moves[primitive.vertices].astype(np.float64)
                if key == "POSITION":
                    shape = shape.astype(np.float64) + step
                elif normals is not None:
                    normals = normals.astype(np.float64) + step
        return shape, normals
