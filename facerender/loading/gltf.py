"""glTF files, text or binary: every instance of a triangle mesh, in the shape that is stored."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.gltf_buffers import Buffers, Doc
from facerender.loading.gltf_features import EXTENSIONS, not_understood
from facerender.loading.gltf_material import Look, Materials, Place
from facerender.loading.gltf_pose import morphed, skinned
from facerender.loading.gltf_schema import damaged, document_of
from facerender.loading.referred import Referred
from facerender.scenes.material import MAPS, Material
from facerender.scenes.repair import Piece, check_count, placed

_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # kinds of chunks
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_TIMES, _MOST_REPEATED = 8, 1 << 20  # vertices and faces are drawn, and so many more at most
_TRANSFORMS = ("matrix", "translation", "rotation", "scale")
_DRACO = "KHR_draco_mesh_compression"


def read_gltf(data: bytes, referred: Referred, without_albedo: bool) -> list[Piece]:
    """Return every instance of a primitive with triangles.

    referred : reads buffers and images
    without_albedo : the albedo of the file is not wanted

    Raises
    ------
    InputError : it is damaged, requires what is not understood, or draws no triangles
    """
    name = referred.name
    text, binary = _chunks(data, name)
    document = document_of(text, name)
    if unknown := not_understood(document.get("extensionsRequired", ())):
        raise InputError(
            f"{name} requires the extension {clipped(unknown[0], 60)}; export it without"
        )
    try:
        return _File(name, document, binary, referred, without_albedo).pieces()
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise damaged(name, reason(error)) from None


def _chunks(data: bytes, name: str) -> tuple[bytes, memoryview | None]:
    """Return the JSON and the binary chunk of a file; without the latter, a text is all JSON."""
    if data[:4] != b"glTF":
        return data, None
    declared = struct.unpack_from("<I", data, 8)[0] if len(data) >= 20 else 20
    if declared > len(data):
        said = declared if len(data) >= 20 else "at least 20"
        raise InputError(
            f"{name} is truncated: its header says {said} bytes, the file has {len(data)}"
        )
    if (version := struct.unpack_from("<I", data, 4)[0]) != 2:
        raise InputError(f"{name} is glTF of version {version}: export it as version 2")
    chunks: dict[int, memoryview] = {}
    start = 12
    while start + 8 <= declared:
        length, kind = struct.unpack_from("<II", data, start)
        if start + 8 + length > declared:
            raise damaged(name, f"a chunk of {length} bytes in a file of {declared}")
        chunks.setdefault(kind, memoryview(data)[start + 8 : start + 8 + length])
        start += 8 + length
    if _JSON not in chunks:
        raise damaged(name, "it has no chunk of JSON")
    return bytes(chunks[_JSON]), chunks.get(_BINARY)


@dataclass(frozen=True)
class _Instance:
    """A mesh, where a node places it.

    weights : of its morph targets
    skin : the number of a skin, which places it in the node's stead, or None
    """

    mesh: int
    name: str
    world: NDArray[np.float64]
    weights: tuple[float, ...]
    skin: int | None


class _File:
    """A document whose properties are sound, but not yet what they say of buffers. Methods raise
    ValueError for what is damaged."""

    def __init__(
        self,
        name: str,
        document: Doc,
        binary: memoryview | None,
        referred: Referred,
        without_albedo: bool,
    ) -> None:
        self.name = name
        self.document = document
        self.buffers = Buffers(name, document, binary, referred)
        self.materials = Materials(self.buffers, without_albedo)
        self.tell = self.materials.tell
        self.worlds: dict[int, NDArray[np.float64]] = {}  # of the scene's nodes
        self.skins: dict[int, NDArray[np.float64] | None] = {}
        self.own: dict[int, int] = {}  # elements of accessors that faces are made of
        self.drawn = 0  # vertices and faces

    def pieces(self) -> list[Piece]:
        for each in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.tell(f"{self.name} uses {clipped(each, 60)}, which is not understood: left out")
        if self.document.get("animations"):
            self.tell(f"{self.name} has animations: drawn as its nodes and weights are stored")
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
        matrices = None if instance.skin is None else self._joints(instance.skin)
        primitives = self.document["meshes"][instance.mesh]["primitives"]
        found = [
            piece
            for i, primitive in enumerate(primitives)
            if (
                piece := self._piece(
                    primitive,
                    f"meshes[{instance.mesh}].primitives[{i}]",
                    instance.weights,
                    matrices,
                )
            )
        ]
        if len(found) == 1:
            found[0].name = ""  # the material's, which tells several apart
        return found

    def _count_drawn(self, count: int) -> None:
        self.drawn += count
        if self.drawn > _TIMES * sum(self.own.values()) + _MOST_REPEATED:
            raise InputError(
                f"{self.name} draws what it holds more than {_TIMES} times over: export fewer "
                "instances"
            )

    # --- nodes -----------------------------------------------------------------------------------

    def _instances(self) -> list[_Instance]:
        """Every mesh that a node below the scene's roots shows, by the node's name or else the
        mesh's; without scenes, below all roots."""
        nodes = self.document["nodes"]
        if scenes := self.document["scenes"]:
            roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        else:
            roots = sorted(
                set(range(len(nodes))) - {i for node in nodes for i in node.get("children", ())}
            )
        found: list[_Instance] = []
        count = 0
        queue = [(index, np.eye(4), True) for index in reversed(roots)]
        while queue:
            index, world, shown = queue.pop()
            if index in self.worlds:
                raise ValueError(f"nodes[{index}] has two parents, or is below itself")
            node = nodes[index]
            extensions = node.get("extensions", {})
            if not node.keys().isdisjoint(_TRANSFORMS):
                world = world @ _transform(node)
            self.worlds[index] = world
            shown = shown and extensions.get("KHR_node_visibility", {}).get("visible", True)
            if "KHR_lights_punctual" in extensions:
                self.tell(f"{self.name} has lights (KHR_lights_punctual): not drawn; give --light")
            if "mesh" in node and shown:
                mesh = self.document["meshes"][node["mesh"]]
                places = self._places(index, world, extensions.get("EXT_mesh_gpu_instancing"))
                count += len(mesh["primitives"]) * len(places)
                check_count(count, self.name)
                name = node.get("name") or mesh.get("name") or ""
                weights = tuple(map(float, node.get("weights", mesh.get("weights", ()))))
                skin = node.get("skin")
                found += [_Instance(node["mesh"], name, each, weights, skin) for each in places]
            queue += [(child, world, shown) for child in reversed(node.get("children", []))]
        return [
            replace(each, world=np.eye(4))  # joints place it alone
            if each.skin is not None and self._joints(each.skin) is not None
            else each
            for each in found
        ]

    def _places(
        self, index: int, world: NDArray[np.float64], instances: Doc | None
    ) -> Sequence[NDArray[np.float64]]:
        """Where a node's mesh is drawn: once, or as EXT_mesh_gpu_instancing says."""
        if instances is None:
            return [world]
        columns = {
            key.lower(): self.buffers.accessor(instances["attributes"][key])
            for key in ("TRANSLATION", "ROTATION", "SCALE")
            if key in instances["attributes"]
        }
        for key, values in columns.items():
            if values.shape[1] != (4 if key == "rotation" else 3):
                raise ValueError(f"nodes[{index}]: {key} of its instances has the wrong type")
        count = min((len(values) for values in columns.values()), default=0)
        check_count(count, self.name)
        return [
            world @ _transform({key: values[i] for key, values in columns.items()})
            for i in range(count)
        ]

    def _joints(self, index: int) -> NDArray[np.float64] | None:
        """Return the matrices of a skin's joints (J, 4, 4); None, with a warning, where the scene
        has not all of them."""
        if index not in self.skins:
            self.skins[index] = self._matrices(index)
        return self.skins[index]

    def _matrices(self, index: int) -> NDArray[np.float64] | None:
        skin = self.document["skins"][index]
        joints = skin["joints"]
        if not joints or not self.worlds.keys() >= set(joints):
            self.tell(f"{self.name} has a skin whose joints are not in its scene: drawn without")
            return None
        worlds = np.stack([self.worlds[joint] for joint in joints])
        if "inverseBindMatrices" not in skin:
            return worlds
        inverse = self.buffers.accessor(skin["inverseBindMatrices"])
        if inverse.shape[1] != 16 or len(inverse) < len(joints):
            raise ValueError(f"skins[{index}] has {len(inverse)} matrices of {len(joints)} joints")
        columns = inverse[: len(joints)].reshape(-1, 4, 4).astype(np.float64)
        return np.asarray(worlds @ columns.transpose(0, 2, 1))

    # --- triangles -------------------------------------------------------------------------------

    def _piece(
        self,
        primitive: Doc,
        where: str,
        weights: Sequence[float],
        matrices: NDArray[np.float64] | None,
    ) -> Piece | None:
        """Return a primitive in its own space, or in the scene's where it has joints; None where it
        is none of triangles.

        Parameters
        ----------
        weights : of its morph targets
        matrices : of its joints, or None
        """
        mode = primitive.get("mode", _TRIANGLES)
        numbers = primitive["attributes"]
        if mode < _TRIANGLES or "POSITION" not in numbers:
            self.tell(f"{self.name} has points or lines, or vertices without places: not drawn")
            return None
        draco = primitive.get("extensions", {}).get(_DRACO)
        known = {} if draco is None else self._draco(draco, where)

        def attribute(key: str, widths: tuple[int, ...]) -> NDArray[Any] | None:
            if key not in numbers:
                return None
            values = known[key] if key in known else self.buffers.accessor(numbers[key])
            if values.ndim != 2 or values.shape[1] not in widths:
                raise ValueError(f"{where}: {key} has the wrong type")
            return values

        positions = attribute("POSITION", (3,))
        assert positions is not None
        if "faces" in known:
            flat = known["faces"].reshape(-1)
        elif "indices" in primitive:
            indices = self.buffers.accessor(primitive["indices"])
            if indices.shape[1] != 1 or indices.dtype.kind != "u":
                raise ValueError(f"{where}: its indices have the wrong type")
            flat = indices.reshape(-1)
        else:
            flat = np.arange(len(positions))
        faces, kept, strangers = _compact(_triangles(flat, mode, where), len(positions))
        self.own[numbers["POSITION"]] = len(positions)
        self.own[primitive.get("indices", -1)] = len(flat)

        def column(key: str, *widths: int) -> NDArray[Any] | None:
            """Return the values of the vertices that are kept."""
            values = attribute(key, widths)
            if values is not None and len(values) != len(positions):
                raise ValueError(
                    f"{where}: {key} has {len(values)} entries, POSITION {len(positions)}"
                )
            return None if values is None else values[kept]

        shape, normals = self._morphed(
            primitive, where, weights, positions, column("NORMAL", 3), kept
        )
        if matrices is not None:
            columns = [
                column(f"{key}_{i}", 4)
                for key in ("JOINTS", "WEIGHTS")
                for i in (0, 1)
                if f"JOINTS_{i}" in numbers and f"WEIGHTS_{i}" in numbers
            ]
            if "JOINTS_2" in numbers:
                self.tell(f"{self.name} has more than eight joints for a vertex: eight count")
            if columns:
                half = len(columns) // 2
                joints, shares = (
                    np.concatenate([each for each in half_ if each is not None], axis=1)
                    for half_ in (columns[:half], columns[half:])
                )
                if joints.dtype.kind != "u":
                    raise ValueError(f"{where}: its joints have the wrong type")
                shape, normals, mirrored = skinned(shape, normals, joints, shares, matrices)
                faces = faces[:, ::-1] if mirrored else faces
        number = primitive.get("material")
        colors = column("COLOR_0", 3, 4)
        look = self.materials.look(number, colors is not None)
        if colors is not None and colors.shape[1] == 4 and look.material.alpha != "opaque":
            self.tell(f"{self.name} has alpha in its vertex colours: left out")

        def place(at: Place | None) -> NDArray[np.float64] | None:
            uv = None if at is None else column(f"TEXCOORD_{at.texcoord}", 2)
            return None if uv is None or at is None else at.moved(uv)

        uv, uv2 = place(look.first), place(look.second)
        return Piece(
            positions=np.asarray(shape, dtype=np.float64),
            faces=faces,
            normals=normals,
            uv=uv,
            colors=None if colors is None else _unit_colors(colors),
            material=self._within(look, uv is not None, uv2 is not None),
            strangers=strangers,
            name="" if number is None else self.document["materials"][number].get("name", ""),
            uv2=None if uv is None else uv2,
        )

    def _within(self, look: Look, first: bool, second: bool) -> Material:
        """Return a look's material without the maps whose texture coordinates are not there."""
        material = look.material
        if not first:
            if any(getattr(material, key) for key in MAPS):
                self.tell(f"{self.name} has no texture coordinates: its texture is ignored")
            return material
        if second or not material.second_uv:
            return material
        self.tell(f"{self.name} has no second texture coordinates: the maps by them are left out")
        without: dict[str, Any] = dict.fromkeys(material.second_uv)
        return replace(material, second_uv=(), **without)

    def _morphed(
        self,
        primitive: Doc,
        where: str,
        weights: Sequence[float],
        positions: NDArray[Any],
        normals: NDArray[Any] | None,
        kept: NDArray[np.int64] | slice,
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Return positions and normals of the vertices that are kept, with the morph targets."""
        values = {"POSITION": positions[kept], "NORMAL": normals}
        for i, (target, weight) in enumerate(
            zip(primitive.get("targets", ()), weights, strict=False)
        ):
            for key in ("POSITION", "NORMAL"):
                old = values[key]
                if not weight or key not in target or old is None:
                    continue
                moves = self.buffers.accessor(target[key])
                self.own[target[key]] = len(moves)
                self._count_drawn(len(moves))
                if moves.shape != positions.shape:
                    raise ValueError(f"{where}.targets[{i}]: {key} has another number of entries")
                values[key] = morphed(old, moves[kept], weight)
        shape = values["POSITION"]
        assert shape is not None
        return shape, values["NORMAL"]

    def _draco(self, draco: Doc, where: str) -> dict[str, NDArray[Any]]:
        """Return what is compressed of a primitive: attributes by name, and faces."""
        try:
            import DracoPy
        except ImportError:
            raise InputError(f"{self.name} is compressed with Draco: pip install DracoPy") from None
        content = bytes(self.buffers.view(draco["bufferView"]))
        try:
            decoded = DracoPy.decode(content)
            found = {each["unique_id"]: np.asarray(each["data"]) for each in decoded.attributes}
            faces = getattr(decoded, "faces", None)
        except Exception as error:  # its decoder fails in several ways
            raise ValueError(f"{where}: Draco says {reason(error)}") from None
        values = {key: found[i] for key, i in draco["attributes"].items() if i in found}
        return values if faces is None else values | {"faces": np.asarray(faces)}


def _transform(node: Doc) -> NDArray[np.float64]:
    """Return a node's matrix (4, 4), for columns."""
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
    """Return the matrix (3, 3) of a quaternion x, y, z, w of any length."""
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
    strangers = len(faces) - int(known.sum())
    if strangers:
        faces = faces[known]
    if count <= 3 * len(faces):
        return faces, slice(None), strangers
    kept, inverse = np.unique(faces, return_inverse=True)
    return inverse.reshape(-1, 3), kept, strangers


def _unit_colors(colors: NDArray[Any]) -> NDArray[np.float64]:
    """Return linear RGB in [0, 1]."""
    if colors.dtype.kind != "f":  # not said to be normalised, and meant so
        colors = colors / np.iinfo(colors.dtype).max
    return np.clip(np.nan_to_num(colors[:, :3].astype(np.float64)), 0.0, 1.0)
