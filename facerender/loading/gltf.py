"""glTF files, text or binary: every instance of a triangle mesh, in the shape that is stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, reason
from facerender.loading.gltf_buffers import Buffers, Doc
from facerender.loading.gltf_document import chunks, damaged, document_of
from facerender.loading.gltf_features import EXTENSIONS, not_understood
from facerender.loading.gltf_material import Materials, TextureTransform
from facerender.loading.gltf_nodes import scene_nodes, transform
from facerender.loading.gltf_primitive import Primitive, has_triangles, skinned, unit_colors
from facerender.loading.looks import Look
from facerender.loading.references import References
from facerender.scenes.material import MAPS, Material
from facerender.scenes.repair import Piece, check_count, placed

_TIMES, _MOST_REPEATED = 8, 1 << 20  # vertices and faces are drawn, and so many more at most


def read_gltf(data: bytes, referred: References, without_albedo: bool) -> list[Piece]:
    """Return every instance of a primitive with triangles.

    referred : reads buffers and images
    without_albedo : the albedo of the file is not wanted

    Raises
    ------
    InputError : it is damaged, requires what is not understood, or draws no triangles
    """
    name = referred.name
    text, binary = chunks(data, name)
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
        referred: References,
        without_albedo: bool,
    ) -> None:
        self.name = name
        self.document = document
        self.buffers = Buffers(name, document, binary, referred)
        self.materials = Materials(self.buffers, without_albedo)
        self.warn = self.materials.warn
        self.worlds: dict[int, NDArray[np.float64]] = {}  # of the scene's nodes
        self.skins: dict[int, NDArray[np.float64] | None] = {}
        self.own: dict[int, int] = {}  # elements of accessors that faces are made of
        self.drawn = 0  # vertices and faces

    def pieces(self) -> list[Piece]:
        for each in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.warn(f"{self.name} uses {clipped(each, 60)}, which is not understood: left out")
        if self.document.get("animations"):
            self.warn(f"{self.name} has animations: drawn as its nodes and weights are stored")
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
        found = []
        for i, primitive in enumerate(primitives):
            where = f"meshes[{instance.mesh}].primitives[{i}]"
            if piece := self._piece(primitive, where, instance.weights, matrices):
                found.append(piece)
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
        """Every mesh that a node of the scene shows, by the node's name or else the mesh's."""
        found: list[_Instance] = []
        count = 0
        for index, node, world, visible in scene_nodes(self.document):
            self.worlds[index] = world
            extensions = node.get("extensions", {})
            if "KHR_lights_punctual" in extensions:
                self.warn(f"{self.name} has lights (KHR_lights_punctual): not drawn; give --light")
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
            world @ transform({key: values[i] for key, values in columns.items()})
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
            self.warn(f"{self.name} has a skin whose joints are not in its scene: drawn without")
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
        properties: Doc,
        where: str,
        weights: Sequence[float],
        matrices: NDArray[np.float64] | None,
    ) -> Piece | None:
        """Return a primitive in its own space, or in the scene's where it has joints; None where it
        has no triangles.

        Parameters
        ----------
        weights : of its morph targets
        matrices : of its joints, or None
        """
        attributes = properties["attributes"]
        if not has_triangles(properties):
            self.warn(f"{self.name} has points or lines, or vertices without places: not drawn")
            return None
        primitive = Primitive(self.buffers, properties, where)
        self.own[attributes["POSITION"]] = len(primitive.positions)
        self.own[properties.get("indices", -1)] = primitive.corner_count
        shape, normals = self._morphed(primitive, weights)
        faces = primitive.faces
        if matrices is not None:
            if "JOINTS_2" in attributes:
                self.warn(f"{self.name} has more than eight joints for a vertex: eight count")
            if influences := primitive.influences():
                shape, normals, mirrored = skinned(shape, normals, *influences, matrices)
                faces = faces[:, ::-1] if mirrored else faces
        number = properties.get("material")
        colors = primitive.column("COLOR_0", 3, 4)
        look = self.materials.look(number, colors is not None)
        if colors is not None and colors.shape[1] == 4 and look.material.alpha != "opaque":
            self.warn(f"{self.name} has alpha in its vertex colours: left out")
        uv, uv2 = primitive.uv(look.first), primitive.uv(look.second)
        return Piece(
            positions=np.asarray(shape, dtype=np.float64),
            faces=faces,
            normals=normals,
            uv=uv,
            colors=None if colors is None else unit_colors(colors),
            material=self._drawn_material(look, uv is not None, uv2 is not None),
            out_of_range=primitive.out_of_range,
            name="" if number is None else self.document["materials"][number].get("name", ""),
            uv2=None if uv is None else uv2,
        )

    def _drawn_material(self, look: Look[TextureTransform], first: bool, second: bool) -> Material:
        """Return a look's material without the maps whose texture coordinates are not there."""
        material = look.material
        if not first:
            if any(getattr(material, key) for key in MAPS):
                self.warn(f"{self.name} has no texture coordinates: its texture is ignored")
            return material
        if second or not material.second_uv:
            return material
        self.warn(f"{self.name} has no second texture coordinates: the maps by them are left out")
        without: dict[str, Any] = dict.fromkeys(material.second_uv)
        return replace(material, second_uv=(), **without)

    def _morphed(
        self, primitive: Primitive, weights: Sequence[float]
    ) -> tuple[NDArray[Any], NDArray[Any] | None]:
        """Return positions and normals of a primitive's vertices, with the morph targets."""
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
                        f"{primitive.where}.targets[{i}]: {key} has another number of entries"
                    )
                step = weight * moves[primitive.vertices].astype(np.float64)
                if key == "POSITION":
                    shape = shape.astype(np.float64) + step
                elif normals is not None:
                    normals = normals.astype(np.float64) + step
        return shape, normals
