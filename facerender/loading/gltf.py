"""Read all mesh instances with triangles from a .gltf or .glb file, in the stored pose, and their
materials: factors, maps and transforms of texture coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, clipped, warn
from facerender.loading.gltf_accessors import TRIANGLES, Buffers, Primitive, RigReader
from facerender.loading.gltf_document import EXTENSIONS, Doc, chunks, damaged, document_of
from facerender.loading.source import References, inline, is_image, missing_image
from facerender.material import MAPS, MAX_NORMAL_STRENGTH, SKIN_ALBEDO, Alpha, Material
from facerender.mesh.framing import names_head
from facerender.mesh.repair import Piece, check_count, placed
from facerender.mesh.rig import Node, Rig, Shape, Skeleton, Skin, local_matrix, morphed, skinned
from facerender.texture.texture import Texture, Wrap
from facerender.values.fields import range_of
from facerender.values.vectors import MAX_RADIANCE, transformed

_TRANSFORMS = ("matrix", "translation", "rotation", "scale")
# Limit of the used vertices plus faces: 8 times the number of stored elements, plus 2^20.
_TIMES, _MAX_REPEATED = 8, 1 << 20
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror"}
_Channel = int | Literal["alpha"] | None  # None: the colours
_ALPHAS: dict[str, Alpha] = {"MASK": "mask", "BLEND": "blend"}
# Objects of a texture whose image is used, in order; "": the texture itself
_SOURCES = ("EXT_texture_webp", "", "EXT_texture_avif", "MSFT_texture_dds")

# A material and the transforms of its texture coordinates: the second for the maps named in
# ``material.second_uv``, the first for the other maps
MaterialUv = tuple[Material, Doc, Doc | None]
# Colours and alpha of an image; None if it is missing or unreadable
_Image = tuple[Texture, Texture | None] | None
Float = NDArray[np.float64]


def scene_nodes(
    document: Doc, name: str, axes: Float | None
) -> tuple[Skeleton, dict[int, Float], set[int]]:
    """Return the nodes of a checked document's scene as a skeleton without clips, their world
    matrices (4, 4), keyed by the node's index, parents first, and the visible nodes. Without a
    scene, all nodes are used. A node is visible if it and all of its ancestors are
    (KHR_node_visibility)."""
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
        tree[index] = Node(index, parent, {key: node[key] for key in _TRANSFORMS if key in node})
        visibility = node.get("extensions", {}).get("KHR_node_visibility", {})
        if visibility.get("visible", True) and (parent is None or parent in visible):
            visible.add(index)
        queue += [(child, index) for child in reversed(node.get("children", []))]
    skeleton = Skeleton(tuple(tree.values()), root=axes)
    return skeleton, skeleton.world_matrices({}), visible


def read_gltf(
    data: bytes, references: References, albedo_given: bool, axes: Float | None
) -> list[Piece]:
    """Return a piece for every primitive instance with triangles, in the ``axes`` of
    :func:`facerender.values.vectors.axes_of`. Raise ValueError for damaged binary data."""
    name = references.name
    text, binary = chunks(data, name)
    document = document_of(text, name)
    for extension in sorted(document.get("extensionsRequired", ())):
        if EXTENSIONS.get(extension, "refused").startswith("refused"):
            required = f"{name} requires the extension {clipped(extension, 60)}"
            raise InputError(f"{required}; export it without this")
    return _File(Buffers(name, document, binary, references), albedo_given, axes).pieces()


class _File:
    """A glTF file with checked JSON. Methods raise ValueError if the binary data are damaged. A
    mesh is read once per skin and weights of its nodes. Parameter ``skin`` is the index of the skin
    whose joints place the mesh; None: the node places it."""

    def __init__(self, buffers: Buffers, albedo_given: bool, axes: Float | None) -> None:
        self.buffers, self.name, self.document = buffers, buffers.name, buffers.document
        self.materials = Materials(buffers, albedo_given)
        self.warn = self.materials.warn
        for extension in sorted(set(self.document.get("extensionsUsed", ())) - EXTENSIONS.keys()):
            self.warn(f"{self.name} uses {clipped(extension, 60)}, which is not supported: ignored")
        skeleton, self.matrices, self.visible = scene_nodes(self.document, self.name, axes)
        self.rigs = RigReader(buffers)
        clips = self.rigs.clips()
        joints = self.rigs.joints(self.matrices)
        self.skeleton = replace(skeleton, clips=clips, joints=joints)
        moved = {track.node for clip in clips for track in clip.tracks} | {n for _, n in joints}
        if any(clip.fault for clip in clips):
            moved = {*self.matrices}  # a damaged clip may move any node; a rig reports the damage
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
                world = self.matrices[index] if offset is None else self.matrices[index] @ offset
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
        if self.used > _TIMES * sum(self.stored.values()) + _MAX_REPEATED:
            remedy = "export fewer instances"
            raise InputError(f"{self.name} draws its geometry more than {_TIMES} times: {remedy}")

    def _instances(self) -> dict[int, Sequence[Float | None]]:
        """Return the transforms (or None) of the instances of visible meshes, keyed by the node."""
        instances: dict[int, Sequence[Float | None]] = {}
        count = 0
        for index in self.matrices:
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
        if not joints or not self.matrices.keys() >= set(joints):
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
        nodes = self.document["nodes"]
        return self.skeleton.below(i for i in self.matrices if names_head(nodes[i].get("name", "")))

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
        height = self.matrices[skin.joints[of_head.argmax()]][1, 3]
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
                positions, normals, mirrored = skinned(positions, normals, rig_skin, self.matrices)
                faces = faces[:, ::-1] if mirrored else faces
                bounds = self._head_bounds(positions, rig_skin, *influences)
            elif self.skeleton.root is not None:  # neither joints nor the node place the part
                positions, normals, _ = transformed(positions, normals, self.skeleton.root)
        index = primitive.properties.get("material")
        name = "" if index is None else self.document["materials"][index].get("name", "")
        colors = primitive.column("COLOR_0", 3, 4)
        material, first, second = self.materials.material_uv(index, colors is not None)
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


def _transform_of(texture_info: Doc) -> Doc:
    """Return KHR_texture_transform of a textureInfo, with all properties."""
    defaults = {"offset": [0.0, 0.0], "rotation": 0.0, "scale": [1.0, 1.0]}
    stored = texture_info.get("extensions", {}).get("KHR_texture_transform", {})
    return {"texCoord": texture_info.get("texCoord", 0), **defaults, **stored}


class Materials:
    """The materials of a checked glTF file. Methods raise ValueError if the data are damaged."""

    def __init__(self, buffers: Buffers, albedo_given: bool) -> None:
        self.buffers, self.name, self.document = buffers, buffers.name, buffers.document
        self.albedo_given = albedo_given
        self.images: dict[int | None, _Image] = {}  # keyed by the image's index
        self.material_uvs: dict[int, MaterialUv] = {}
        self.warn = cache(warn)

    def material_uv(self, index: int | None, has_colors: bool) -> MaterialUv:
        """Return a material; ``has_colors``: its primitive has vertex colours."""
        if index is None:
            albedo = (1.0, 1.0, 1.0) if has_colors else SKIN_ALBEDO
            return Material(albedo=albedo, double_sided=False), _transform_of({}), None
        if index not in self.material_uvs:
            self.material_uvs[index] = self._read(self.document["materials"][index])
        return self.material_uvs[index]

    def _read(self, source: Doc) -> MaterialUv:
        extensions = source.get("extensions", {})
        metallic = source.get("pbrMetallicRoughness", {})
        glossy = extensions.get("KHR_materials_pbrSpecularGlossiness", {})
        specular = extensions.get("KHR_materials_specular", {})
        unlit = "KHR_materials_unlit" in extensions
        self._warn_of(extensions)
        base = glossy.get("diffuseTexture", metallic.get("baseColorTexture"))
        alpha = _ALPHAS.get(source.get("alphaMode", "OPAQUE"), "opaque")
        emissive = self._emissive(source, extensions)
        # Keyed by map: its textureInfo, and the image channel that the map uses
        texture_infos: dict[str, tuple[Any, _Channel]] = {
            "albedo_map": (base, None),
            "opacity_map": (base if alpha != "opaque" else None, "alpha"),
            "normal_map": (source.get("normalTexture"), None),
            "roughness_map": (metallic.get("metallicRoughnessTexture"), 1),
            "occlusion_map": (source.get("occlusionTexture"), 0),
            "emissive_map": (source.get("emissiveTexture") if any(emissive) else None, None),
            "specular_map": (specular.get("specularTexture"), "alpha"),
        }
        transforms = {key: _transform_of(info) for key, (info, _) in texture_infos.items() if info}
        first = next(iter(transforms.values()), _transform_of({}))
        second = next((other for other in transforms.values() if other != first), None)
        maps: dict[str, Any] = {}
        for key, transform in transforms.items():
            map_name = "emission" if key == "emissive_map" else key.removesuffix("_map")
            if transform in (first, second):
                maps[key] = self._map(map_name, *texture_infos[key])
            else:
                problem = "needs a third set or transform of texture coordinates"
                cause = "a material can have only two"
                self.warn(f"the {map_name} map of {self.name} {problem}: ignored, because {cause}")
        if not glossy and not unlit:
            self._look_for_metal(metallic)
        factor = glossy.get("diffuseFactor", metallic.get("baseColorFactor", [1.0] * 4))
        red, green, blue, opacity = (self._factor("albedo", channel) for channel in factor)
        albedo = (red, green, blue)
        lost_images = None in self.images.values()
        if lost_images and maps.get("albedo_map") is None and min(albedo) > 0.99:
            albedo = SKIN_ALBEDO  # the file's white multiplies only the missing map
        material = Material(
            albedo=albedo,
            # Has no effect without a roughness map, because exporters write 1 or 0.5 by default.
            roughness_factor=self._factor("roughness", metallic.get("roughnessFactor", 1.0)),
            f0=self._f0(extensions),
            ks=self._factor("specular", specular.get("specularFactor", 1.0)),
            alpha=alpha,
            opacity=opacity if alpha != "opaque" else 1.0,
            alpha_cutoff=self._factor("alphaCutoff", source.get("alphaCutoff", 0.5), MAX_RADIANCE),
            emissive=emissive,
            unlit=unlit,
            double_sided=source.get("doubleSided", False),
            normal_strength=self._strength(source, "normalTexture", "scale", MAX_NORMAL_STRENGTH),
            occlusion_strength=self._strength(source, "occlusionTexture", "strength", 1.0),
            second_uv=tuple(key for key in maps if maps[key] and transforms[key] != first),
            **({} if unlit else self._transmission(extensions, metallic)),
            **maps,
        )
        return material, first, second

    def _warn_of(self, extensions: Mapping[str, Doc]) -> None:
        """Warn of the material's unsupported extensions that have an effect."""
        for key, extension in extensions.items():
            fate, _, how = EXTENSIONS.get(key, "").partition(": ")
            # A factor of 0 has no effect.
            effect = "Glossiness" in key or any(map(np.any, extension.values()))
            if fate == "warned" and effect:
                self.warn(f"{self.name} has {key}, which is not supported: {how}")

    def _factor(self, name: str, value: float, high: float = 1.0) -> float:
        if not 0.0 <= value <= high:
            warn(f"the {name} factor {value:.6g} of {self.name} is outside [0, {high:g}]: clamped")
        return float(min(max(value, 0.0), high))

    def _strength(self, source: Doc, name: str, key: str, high: float) -> float:
        return self._factor(f"{name}.{key}", source.get(name, {}).get(key, 1.0), high)

    def _emissive(self, source: Doc, extensions: Doc) -> tuple[float, float, float]:
        stored = extensions.get("KHR_materials_emissive_strength", {})
        strength = stored.get("emissiveStrength", 1.0)
        strength = self._factor("emissiveStrength", strength, MAX_RADIANCE)
        factor = source.get("emissiveFactor", (0.0, 0.0, 0.0))
        red, green, blue = (strength * self._factor("emissive", channel) for channel in factor)
        return red, green, blue

    def _f0(self, extensions: Doc) -> float:
        f0 = 0.028
        if "KHR_materials_ior" in extensions:
            n = extensions["KHR_materials_ior"].get("ior", 1.5)
            if n and n < 1.0:
                warn(f"the ior {n:.6g} of {self.name} is below 1: clamped to 1")
                n = 1.0
            f0 = ((n - 1.0) / (n + 1.0)) ** 2
        specular = extensions.get("KHR_materials_specular", {})
        tint = specular.get("specularColorFactor", (1.0, 1.0, 1.0))
        if "specularColorTexture" in specular or max(tint) - min(tint) > 0.01 * max(tint):
            self.warn(f"{self.name} has a specular colour (KHR_materials_specular): drawn grey")
        return min(f0 * self._factor("specularColor", sum(tint) / 3.0, MAX_RADIANCE), 0.999)

    def _transmission(self, extensions: Doc, metallic: Doc) -> dict[str, Any]:
        """Return transmission, refraction and m. A surface without thickness does not refract."""
        transmission = extensions.get("KHR_materials_transmission", {})
        factor = self._factor("transmission", transmission.get("transmissionFactor", 0.0))
        if not factor:
            return {}
        if "transmissionTexture" in transmission:
            self.warn(f"{self.name} has a transmission map: ignored, only the factor is used")
        thickness = extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0.0)
        ior = extensions.get("KHR_materials_ior", {}).get("ior", 1.5) if thickness > 0.0 else 1.0
        max_ior = range_of(Material, "refraction").high
        roughness = self._factor("roughness", metallic.get("roughnessFactor", 1.0))
        m = max(roughness * roughness, range_of(Material, "m").low)
        return {"transmission": factor, "refraction": min(max(ior, 1.0), max_ior), "m": m}

    def _look_for_metal(self, metallic: Doc) -> None:
        """Warn of a metallic material. This check decodes a metallic map of up to 2^22 texels."""
        info = metallic.get("metallicRoughnessTexture")
        factor = metallic.get("metallicFactor", 0.0 if info is None else 1.0)
        if factor <= 0.0:
            return
        source = self._source(self.document["textures"][info["index"]]) if info else None
        if (record := self.images.get(source)) is not None:
            texture, _ = record
            if math.prod(texture.size) > 1 << 22:
                self.warn(f"{self.name} has a metallic map: ignored, drawn as a dielectric")
                return
            try:
                factor *= float(texture.channel(2, texture.name).texels().max()) / 255.0
            except InputError:  # drawing the map reports the error
                return
        if factor > 0.1:  # lower values may be JPEG noise in a map without metal
            self.warn(f"{self.name} has metallic materials: drawn as dielectrics, like skin")

    @staticmethod
    def _source(texture: Doc) -> Any:
        """Return the index of the image that is read for a texture; None without such an image."""
        tables = {"": texture, **texture.get("extensions", {})}
        stored = (tables[key] for key in _SOURCES if key in tables)
        return next((table["source"] for table in stored if "source" in table), None)

    def _map(self, map_name: str, texture_info: Doc, channel: _Channel) -> Texture | None:
        """Return a material's map, or None if its image is missing."""
        texture = self.document["textures"][texture_info["index"]]
        source = self._source(texture)
        replaced = map_name == "albedo" and self.albedo_given
        if source is None:
            basis = "KHR_texture_basisu" in texture.get("extensions", {})
            if not replaced:
                problem = f"has no image in a supported format{' (KHR_texture_basisu)' * basis}"
                self.warn(f"the {map_name} map of {self.name} {problem}: ignored")
            self.images[None] = None
        elif source not in self.images:
            self.images[source] = self._image(source, map_name, replaced)
        if (record := self.images[source]) is None:
            return None
        sampler = self.document["samplers"][texture["sampler"]] if "sampler" in texture else {}
        u, v = (_WRAPS.get(sampler.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
        nearest = sampler.get("magFilter") == 9728  # GL_NEAREST
        colors, alpha = record
        image_texture = alpha if channel == "alpha" else colors
        if isinstance(channel, int):
            image_texture = colors.channel(channel, colors.name)
        return image_texture and image_texture.sampled((u, v), nearest)

    def _image(self, index: int, map_name: str, replaced: bool) -> _Image:
        """Return an entry of ``images``. An unreadable image raises InputError, or causes a warning
        if the caller replaces the albedo map; ``replaced``: without a warning."""
        entry = self.document["images"][index]
        name = label = f"the {map_name} map of {self.name}"
        content: bytes | None
        try:
            if "bufferView" in entry:
                content = bytes(self.buffers.view(entry["bufferView"]))
            elif "uri" not in entry:
                raise ValueError(f"images[{index}] has neither uri nor bufferView")
            elif (content := inline(entry["uri"])) is None:
                label = f"{clipped(entry['uri'], 80)} (named by {self.name})"
                content = self.buffers.referred.read(entry["uri"], "an image file")
        except FileNotFoundError:
            if not replaced:
                missing_image(self.buffers.referred, entry["uri"])
            return None
        if not is_image(content, label, map_name, not self.albedo_given, replaced):
            return None
        alpha = Texture.alpha_of(content, f"the opacity map of {self.name}")
        return Texture.of(content, name), alpha
