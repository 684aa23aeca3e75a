"""The cache of loaded meshes with the mip chains of their maps. The name of a cache
entry is a digest of the mesh's files and of the code that reads them. Reading an entry imports
neither trimesh nor Pillow."""

from __future__ import annotations

import importlib.util
import json
import math
import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.errors import FacerenderError, InputError, warn
from facerender.loading.references import content_of
from facerender.loading.source import Orientation, Source
from facerender.scenes.framing import find_regions
from facerender.scenes.material import MAPS, PROPERTY_MAPS, Material
from facerender.scenes.mesh import Mesh, Part, Region
from facerender.scenes.mips import Kind, Levels
from facerender.scenes.texture import LARGE, Texture, pack
from facerender.system import cache
from facerender.system.files import digest_of, read_file

if TYPE_CHECKING:
    from facerender.scenes.rig import Rig

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

_PLAIN_FIELDS = ("name", "skin", "source_count", "preset", "ks_ignored")
_ARRAYS = tuple(
    field.name for field in fields(Part) if field.name not in (*_PLAIN_FIELDS, "rest", "rig")
)


@dataclass(frozen=True)
class MeshFiles:
    """The files from which a mesh is loaded.

    Attributes
    ----------
    source : the mesh file
    maps : image files that replace the mesh file's maps, keyed by the field of :class:`Material`
    orientation, allow_outside, as_is, parts, hide : see :func:`facerender.load_mesh`
    """

    source: Source
    maps: Mapping[str, Path]
    orientation: Orientation
    allow_outside: bool
    as_is: bool = False
    parts: tuple[str, ...] = ()
    hide: tuple[str, ...] = ()

    def digest(self) -> str | None:
        """Return the name of the cache entry, or None if a file cannot be read."""
        names = [self.source.path.name, *((field, path.name) for field, path in self.maps.items())]
        options = self.orientation, self.allow_outside, self.as_is, self.parts, self.hide
        facts = __version__, _code(), names, self.source.suffix, options
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
        content = content_of(self.source.folder, name, self.allow_outside)
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
        if any(math.prod(texture.size) > LARGE for texture in _maps(mesh)):
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


def _maps(mesh: Mesh) -> Iterator[Texture]:
    for material in mesh.materials:
        yield from filter(None, (getattr(material, name) for name in MAPS))


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
    """Return the pieces of a cache entry: length of the facts, facts as JSON, arrays. The facts
    refer to an array by its index."""
    arrays: list[NDArray[Any]] = []

    def number(values: NDArray[Any] | None) -> int | None:
        if values is None:
            return None
        arrays.append(np.ascontiguousarray(values))
        return len(arrays) - 1

    textures = []
    for texture, futures in chains.items():
        levels = {kind: [number(level) for level in f.result()] for kind, f in futures.items()}
        texels = None if levels else number(_grey_or_rgb(np.asarray(texture.rgb())))
        facts_of = {"name": texture.name, "wrap": texture.wrap, "nearest": texture.nearest}
        textures.append({**facts_of, "levels": levels, "texels": texels})
    numbers = {texture: i for i, texture in enumerate(chains)}
    rigs = _RigWriter(number)
    facts |= {
        "name": mesh.name,
        "parts": [
            {name: number(getattr(part, name)) for name in _ARRAYS}
            | {name: getattr(part, name) for name in _PLAIN_FIELDS}
            | {"rig": rigs.packed(part.rig)}
            for part in mesh.parts
        ],
        "materials": [
            {field.name: getattr(material, field.name) for field in fields(Material)}
            | {name: numbers.get(getattr(material, name)) for name in (*MAPS, "property_map")}
            for material in mesh.materials
        ],
        "bounds": number(mesh.bounds),
        "radius": mesh.radius,
        "profile": number(mesh.profile),
        "millimetres": mesh.millimetres,
        "regions": {name: region and _plain(region) for name, region in find_regions(mesh).items()},
        "textures": textures,
        "rigs": rigs.objects,
    }
    facts["arrays"] = [(array.dtype.str, array.shape) for array in arrays]
    head = json.dumps(facts, default=float).encode()
    pieces: list[bytes | memoryview] = [_LENGTH.pack(len(head)), head]
    size = _LENGTH.size + len(head)
    for array in arrays:
        pieces += [bytes(-size % _ALIGNMENT), array.data]
        size += -size % _ALIGNMENT + array.nbytes
    return pieces


class _RigWriter:
    """Converts rigs to plain data. Parts share most objects and arrays of their rigs, so an object
    is stored once and referred to by its index, before the objects that refer to it."""

    def __init__(self, number: Callable[[NDArray[Any]], int | None]) -> None:
        self.number = number
        self.objects: list[dict[str, Any]] = []
        self.known: dict[int, dict[str, int | None]] = {}  # keyed by id

    def packed(self, value: Any) -> Any:
        if isinstance(value, tuple | list):
            return [self.packed(element) for element in value]
        if isinstance(value, np.ndarray):
            if id(value) not in self.known:
                self.known[id(value)] = {"array": self.number(value)}
            return self.known[id(value)]
        if not is_dataclass(value):
            return value
        if id(value) not in self.known:
            packed_fields = {
                field.name: self.packed(getattr(value, field.name)) for field in fields(value)
            }
            self.objects.append({"type": type(value).__name__, "fields": packed_fields})
            self.known[id(value)] = {"object": len(self.objects) - 1}
        return self.known[id(value)]


def _rigs(facts: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> list[Rig | None]:
    """Return the rig of each part."""
    if not facts["rigs"]:
        return [None] * len(facts["parts"])
    from facerender.scenes import rig

    kinds = (rig.Clip, rig.Node, rig.Rig, rig.Shape, rig.Skeleton, rig.Skin, rig.Track)
    types = {kind.__name__: kind for kind in kinds}
    objects: list[Any] = []

    def unpacked(value: Any) -> Any:
        if isinstance(value, list):
            return tuple(unpacked(element) for element in value)
        if not isinstance(value, dict):
            return value
        return objects[value["object"]] if "object" in value else arrays[value["array"]]

    for record in facts["rigs"]:
        arguments = {name: unpacked(value) for name, value in record["fields"].items()}
        objects.append(types[record["type"]](**arguments))
    return [unpacked(part["rig"]) for part in facts["parts"]]


def _plain(region: Region) -> dict[str, Any]:
    return {**vars(region), "center": region.center.tolist()}


def _grey_or_rgb(texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    grey = texels[..., 0]
    return grey if (texels == grey[..., None]).all() else texels


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
    textures = [_texture(texture, arrays) for texture in facts["textures"]]
    materials = []
    for record in facts["materials"]:
        maps = {name: textures[record[name]] for name in MAPS if record[name] is not None}
        packed = record.pop("property_map")
        material = Material(**{**record, **dict.fromkeys(MAPS), **maps})
        if packed is not None:
            property_map = pack(*material.properties, textures[packed])
            vars(material)["property_map"] = property_map  # sets the cached property
        materials.append(material)
    columns: list[dict[str, Any]] = [
        {name: None if part[name] is None else arrays[part[name]] for name in _ARRAYS}
        for part in facts["parts"]
    ]
    rigs = _rigs(facts, arrays)
    return Mesh(
        facts["name"],
        tuple(
            Part(**part_arrays, **{name: part[name] for name in _PLAIN_FIELDS}, rig=rig)
            for part_arrays, part, rig in zip(columns, facts["parts"], rigs, strict=True)
        ),
        tuple(materials),
        arrays[facts["bounds"]],
        facts["radius"],
        arrays[facts["profile"]],
        facts["millimetres"],
        {
            name: region and Region(**{**region, "center": np.array(region["center"])})
            for name, region in facts["regions"].items()
        },
    )


def _texture(facts: Mapping[str, Any], arrays: Sequence[NDArray[Any]]) -> Texture:
    levels: dict[Kind, Levels] = {
        kind: [arrays[i] for i in numbers] for kind, numbers in facts["levels"].items()
    }
    base = next(iter(levels.values()))[0][..., :3] if levels else arrays[facts["texels"]]
    texture = Texture.known(base, facts["name"], levels)
    texture.wrap, texture.nearest = tuple(facts["wrap"]), facts["nearest"]
    return texture
