"""The cache of loaded meshes with the mip chains of their maps. The name of a cache
entry is a digest of the mesh's files and of the code that reads them. Reading an entry imports
neither trimesh nor Pillow."""

from __future__ import annotations

import importlib.util
import json
import math
import struct
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.errors import FacerenderError, InputError, check_switch, warn
from facerender.loading.source import Source, check_normal_map_y, content_of
from facerender.scenes.material import MAPS, PROPERTY_MAPS, Material
from facerender.scenes.mesh import Mesh, Part, Region
from facerender.scenes.mips import Kind, Levels
from facerender.scenes.texture import LARGE, Texture, Wrap, pack
from facerender.system import cache
from facerender.system.files import digest_of, read_file

Chains = dict[Texture, dict[Kind, Future[Levels]]]

_KIND = "meshes"
_ALIGNMENT = 64
_LENGTH = struct.Struct("<Q")
_PACKAGE = Path(__file__).parents[1]
_LIBRARIES = ("numpy", "trimesh", "PIL", "DracoPy", "meshoptimizer")
# Keyed by map: the kind of mip chain with which the map is drawn.
_CHAINS: dict[str, Kind] = {
    **dict.fromkeys(("albedo_map", "emissive_map"), "color"),
    "normal_map": "normal",
    **dict.fromkeys(("property_map", "lobe_map", "opacity_map"), "data"),
}
_RIG = ("Clip", "Node", "Rig", "Shape", "Skeleton", "Skin", "Track")  # classes of a rig


@dataclass(frozen=True)
class LoadOptions:
    """Options of :func:`facerender.load_mesh`, whose arguments and errors they share."""

    flip_v: bool = False
    normal_map_y: str = "up"
    allow_outside: bool = False
    as_is: bool = False
    parts: tuple[str, ...] = ()
    hide: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_normal_map_y(self.normal_map_y)
        for name in ("flip_v", "allow_outside", "as_is"):
            check_switch(name, getattr(self, name))


@dataclass(frozen=True)
class MeshFiles:
    """The files from which a mesh is loaded."""

    source: Source
    maps: Mapping[str, Any]  # image files that replace maps, keyed by the field of Material
    options: LoadOptions = LoadOptions()

    def digest(self) -> str | None:
        """Return the name of the cache entry, or None if a file cannot be read."""
        names = [self.source.path.name, *((field, path.name) for field, path in self.maps.items())]
        facts = __version__, _code(), names, self.source.suffix, self.options
        try:
            maps = [read_file(path, "a file") for path in self.maps.values()]
            return digest_of(repr(facts), self.source.read(), *maps)
        except InputError:
            return None

    def find(self) -> Mesh | None:
        """Return the mesh from the cache, and repeat the warnings of its original load. Return None
        if the cache entry is missing or damaged, or a referenced file has changed."""
        name = self.digest()
        content = None if name is None else cache.read(_KIND, name)
        if content is None:
            return None
        try:
            mesh, warnings = self._unpacked(content)
        except Exception:  # another program may have damaged the entry
            return None
        for message in warnings:
            warn(message)
        return mesh

    def _unpacked(self, content: memoryview) -> tuple[Mesh | None, list[str]]:
        """Return mesh and warnings of a cache entry. The mesh is None if a referenced file has
        changed."""
        (length,) = _LENGTH.unpack_from(content)
        facts = json.loads(bytes(content[_LENGTH.size : _LENGTH.size + length]))
        if any(self._digest_of(name) != digest for name, digest in facts["files"].items()):
            return None, []
        mesh = _mesh(facts, _arrays(content, _LENGTH.size + length, facts["arrays"]))
        return mesh, [str(message) for message in facts["warnings"]]

    def _digest_of(self, name: str) -> str | None:
        if self.source.folder is None:
            return None
        content = content_of(self.source.folder, name, self.options.allow_outside)
        return None if content is None else digest_of(content)

    def store(
        self, name: str, mesh: Mesh, referred: Mapping[str, bytes | None], warnings: Sequence[str]
    ) -> None:
        """Decode the maps and write the mesh to the cache in a thread. The process does not end
        before this thread.

        Parameters
        ----------
        name : result of :meth:`digest` before the files were read
        referred : contents of the files that the mesh file refers to, keyed by the name in the
            mesh file; None for a missing file
        """
        if not cache.limit():
            return
        if None in referred.values() and "albedo_map" not in self.maps:
            return  # the warning of a missing image depends on other files in the mesh's folder
        maps = (getattr(material, name) for material in mesh.materials for name in MAPS)
        if any(texture and math.prod(texture.size) > LARGE for texture in maps):
            return  # storing the mesh would decode large maps at full resolution
        files = {file: None if data is None else digest_of(data) for file, data in referred.items()}
        chains = _start(mesh)

        def write() -> None:
            try:
                pieces = _pieces(mesh, chains, {"files": files, "warnings": warnings})
            except FacerenderError:  # a damaged map: drawing it reports the error
                return
            if self.digest() == name:
                cache.write(_KIND, name, pieces)

        threading.Thread(target=write, name="facerender-cache").start()


def _code() -> list[tuple[str, int, int]]:
    """Return path, size and modification time of each module, of this package or of a library, that
    reads meshes or decodes images."""
    specs = (importlib.util.find_spec(name) for name in _LIBRARIES)
    paths = [Path(spec.origin) for spec in specs if spec and spec.origin]
    for folder in ("images", "loading", "scenes"):
        paths += sorted((_PACKAGE / folder).glob("*.py"))
    facts = ((path, path.stat()) for path in (*paths, _PACKAGE / "system/files.py"))
    return [(str(path), status.st_size, status.st_mtime_ns) for path, status in facts]


def _start(mesh: Mesh) -> Chains:
    """Start to decode every map, and return the futures of the mip chains."""
    chains: Chains = {}
    for material in mesh.materials:
        for name in (*MAPS, "property_map"):
            if (texture := getattr(material, name)) is not None:
                futures = chains.setdefault(texture, {})
                apart = name in PROPERTY_MAPS and not material.packs
                if (kind := "data" if apart else _CHAINS.get(name)) is not None:
                    futures[kind] = texture.levels(kind)
    return chains


def _pieces(mesh: Mesh, chains: Chains, facts: dict[str, Any]) -> list[bytes | memoryview]:
    """Return the pieces of a cache entry: length of the facts, facts as JSON, arrays."""
    materials = {id(material): material for material in mesh.materials}.values()  # as objects
    writer = _Writer({texture: i for i, texture in enumerate(chains)})
    textures = []
    for texture, futures in chains.items():
        levels = {kind: future.result() for kind, future in futures.items()}
        texels = None if levels else texture.texels()
        if texels is not None and texels.ndim == 3 and (texels == texels[..., :1]).all():
            texels = texels[..., 0]  # grey
        textures.append((texture.name, texture.wrap, texture.nearest, levels, texels))
    facts |= {
        "textures": writer.packed(textures),
        "mesh": writer.packed(mesh),
        "property_maps": writer.packed([material.property_map for material in materials]),
        "objects": writer.objects,
        "arrays": [(array.dtype.str, array.shape) for array in writer.arrays],
    }
    head = json.dumps(facts, default=float).encode()
    pieces: list[bytes | memoryview] = [_LENGTH.pack(len(head)), head]
    size = _LENGTH.size + len(head)
    for array in writer.arrays:
        pieces += [bytes(-size % _ALIGNMENT), array.data]
        size += -size % _ALIGNMENT + array.nbytes
    return pieces


class _Writer:
    """Converts values to plain data. Parts share materials and most objects and arrays of their
    rigs, so an object is stored once and referred to by its index, before the objects that refer to
    it."""

    def __init__(self, textures: Mapping[Texture, int]) -> None:
        self.textures = textures
        self.arrays: list[NDArray[Any]] = []
        self.objects: list[tuple[str, dict[str, Any]]] = []
        # Keyed by id: the reference, and the value, which must live as long as its id is a key.
        self.known: dict[int, tuple[dict[str, int], Any]] = {}

    def packed(self, value: Any) -> Any:
        if isinstance(value, tuple | list):
            return [self.packed(element) for element in value]
        if isinstance(value, Mapping):
            return {"table": {key: self.packed(element) for key, element in value.items()}}
        if isinstance(value, Texture):
            return {"texture": self.textures[value]}
        if not isinstance(value, np.ndarray) and not is_dataclass(value):
            return value
        if id(value) not in self.known:
            if isinstance(value, np.ndarray):
                reference = {"array": len(self.arrays)}
                self.arrays.append(np.ascontiguousarray(value))
            else:
                names = [field.name for field in fields(value)]
                attributes = {name: self.packed(getattr(value, name)) for name in names}
                reference = {"object": len(self.objects)}
                self.objects.append((type(value).__name__, attributes))
            self.known[id(value)] = reference, value
        return self.known[id(value)][0]


def _arrays(
    content: memoryview, start: int, described: Sequence[tuple[str, Sequence[int]]]
) -> list[NDArray[Any]]:
    arrays = []
    for name, shape in described:
        start += -start % _ALIGNMENT
        arrays.append(np.frombuffer(content, name, math.prod(shape), start).reshape(shape))
        start += arrays[-1].nbytes
    return arrays


def _mesh(facts: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> Mesh:
    lists: dict[str, list[Any]] = {"array": [*arrays], "texture": [], "object": []}

    def unpacked(value: Any) -> Any:
        if isinstance(value, list):
            return tuple(map(unpacked, value))
        if not isinstance(value, dict):
            return value
        ((kind, content),) = value.items()
        if kind == "table":
            return {key: unpacked(element) for key, element in content.items()}
        return lists[kind][content]

    lists["texture"] += [_texture(*unpacked(texture)) for texture in facts["textures"]]
    property_maps = iter(unpacked(facts["property_maps"]))
    for name, attributes in facts["objects"]:
        value = _type_of(name)(**unpacked({"table": attributes}))
        if name == "Material" and (packed := next(property_maps)) is not None:
            # Sets the cached property before Mesh reads it, which would pack the maps again.
            red, green, blue = value.properties
            vars(value)["property_map"] = pack(red, green, blue, packed)
        lists["object"].append(value)
    mesh: Mesh = unpacked(facts["mesh"])
    return mesh


def _type_of(name: str) -> Any:
    if name in _RIG:
        from facerender.scenes import rig  # most meshes have none: this saves 5 ms

        return getattr(rig, name)
    return {"Mesh": Mesh, "Part": Part, "Material": Material, "Region": Region}[name]


def _texture(
    name: str,
    wrap: tuple[Wrap, Wrap],
    nearest: bool,
    chains: Mapping[Kind, Sequence[NDArray[Any]]],
    texels: NDArray[np.uint8] | None,
) -> Texture:
    levels: dict[Kind, Levels] = {kind: [*chain] for kind, chain in chains.items()}
    base = next(iter(levels.values()))[0][..., :3] if texels is None else texels
    texture = Texture.known(base, name, levels)
    texture.wrap, texture.nearest = wrap, nearest
    return texture
