"""The cache of loaded meshes with the mip chains of their maps.

The name of an entry is a digest of the mesh file, of its maps, and of the code that reads them. An
entry is a description of the mesh as JSON, and the arrays to which it refers, which are mapped from
the file. It also has digests of the files that the mesh file refers to. Reading an entry imports
neither trimesh nor Pillow."""

from __future__ import annotations

import importlib.util
import json
import math
import struct
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender import __version__
from facerender.errors import FacerenderError, warn
from facerender.loading.source import Source, content_of
from facerender.material import MAPS, PROPERTY_MAPS, Material
from facerender.mesh.mesh import Mesh
from facerender.system import cache
from facerender.system.files import data_dir, digest_of
from facerender.texture.texture import LARGE, Kind, Levels, Texture, pack

_FOLDER = "meshes"
_ALIGNMENT = 64
_LENGTH = struct.Struct("<Q")
_PACKAGE = Path(__file__).parents[1]
# Keyed by map: the kind of mip chain with which the map is drawn.
_CHAINS: dict[str, Kind] = {
    **dict.fromkeys(("albedo_map", "emissive_map"), "color"),
    "normal_map": "normal",
    **dict.fromkeys(("property_map", "lobe_map", "opacity_map"), "data"),
}
# Keyed by class of a stored value: its module. Most meshes have no rig: its import takes
# 5 ms.
_MODULES = {
    **{"Geometry": "mesh.geometry", "Material": "material", "Mesh": "mesh.mesh"},
    **dict.fromkeys(("Face", "Framing", "Part", "Region"), "mesh.part"),
    **dict.fromkeys(("Clip", "Node", "Rig", "Shape", "Skeleton", "Skin", "Track"), "mesh.rig"),
}


def entry_name(
    source: Source, maps: Mapping[str, tuple[str, bytes]], options: Sequence[Any]
) -> str:
    """Return the name of the cache entry of a mesh, from name and content of the image files that
    replace maps, keyed by the field of Material, and from the MeshFile's values."""
    names = [source.path.name, *((field, name) for field, (name, _) in maps.items())]
    inputs = __version__, _code(), names, source.suffix, options
    return digest_of(repr(inputs), source.content, *(content for _, content in maps.values()))


def find(name: str, source: Source, allow_outside: bool) -> Mesh | None:
    """Return the mesh of a cache entry, and repeat the warnings of its original load. Return None
    if the entry is missing or damaged, or a file that the mesh file refers to has changed."""
    if (content := cache.read(_FOLDER, name)) is None:
        return None
    try:
        (length,) = _LENGTH.unpack_from(content)
        head = bytes(content[_LENGTH.size : _LENGTH.size + length])
        entry, folder = _decoded(head, content, _LENGTH.size + length), source.folder
        for file, digest in entry["files"].items():
            current = None if folder is None else content_of(folder, file, allow_outside)
            if digest != (None if current is None else digest_of(current)):
                return None
        mesh, warnings = entry["mesh"], [str(message) for message in entry["warnings"]]
    except Exception:  # another program may have damaged the entry
        return None
    for message in warnings:
        warn(message)
    return mesh if isinstance(mesh, Mesh) else None


def store(
    name: str,
    mesh: Mesh,
    files: Mapping[str, bytes | None],
    has_albedo: bool,
    warnings: Sequence[str],
) -> None:
    """Decode the maps and write the mesh to the cache in a thread. The process does not end before
    this thread. For ``files`` see :class:`References`; ``has_albedo`` is true if the caller
    replaced the albedo map."""
    maps = (getattr(material, field) for material in mesh.materials for field in MAPS)
    # The warning of a missing image depends on other files in the mesh's folder. Storing large maps
    # would decode them at full resolution.
    if (
        not cache.limit()
        or (None in files.values() and not has_albedo)
        or any(texture and math.prod(texture.size) > LARGE for texture in maps)
    ):
        return
    digests = {file: None if data is None else digest_of(data) for file, data in files.items()}
    chains: dict[Texture, dict[Kind, Future[Levels]]] = {}
    for material in mesh.materials:  # start to decode every map
        for field in (*MAPS, "property_map"):
            if (texture := getattr(material, field)) is not None:
                futures = chains.setdefault(texture, {})
                apart = field in PROPERTY_MAPS and not material.packs
                if (mip_kind := "data" if apart else _CHAINS.get(field)) is not None:
                    futures[mip_kind] = texture.levels(mip_kind)

    def write() -> None:
        with suppress(FacerenderError):  # a damaged map: drawing it reports the error
            cache.write(_FOLDER, name, _encoded(mesh, chains, digests, warnings))

    threading.Thread(target=write, name="facerender-cache").start()


def _code() -> list[tuple[str, int, int]]:
    """Return path, size and time of change of all modules that read meshes or decode images."""
    libraries = ("numpy", "trimesh", "PIL", "DracoPy", "meshoptimizer")
    specs = map(importlib.util.find_spec, libraries)
    paths = [Path(spec.origin) for spec in specs if spec and spec.origin]
    for folder in ("images", "loading", "mesh", "texture", "values"):
        paths += sorted((_PACKAGE / folder).glob("*.py"))
    paths += [_PACKAGE / "material.py", _PACKAGE / "system/files.py"]
    paths.append(data_dir("assets") / "relief.npy")
    files = ((path, path.stat()) for path in paths)
    return [(str(path), status.st_size, status.st_mtime_ns) for path, status in files]


def _encoded(
    mesh: Mesh,
    chains: Mapping[Texture, Mapping[Kind, Future[Levels]]],
    files: Mapping[str, str | None],
    warnings: Sequence[str],
) -> list[bytes | memoryview]:
    """Return the pieces of a cache entry: length of the description, description, arrays. It
    describes values that several parts share once, with a number, and afterwards as the number."""
    arrays: list[NDArray[Any]] = []
    # Keyed by id: the number, and the value, which must live as long as its id is a key.
    known: dict[int, tuple[int, Any]] = {}

    def described(value: Any) -> Any:
        """Describe a value that JSON lacks; json.dumps() calls this function for the results."""
        if isinstance(value, np.number):
            return value.item()
        if id(value) in known:
            return {"number": known[id(value)][0]}
        number = len(known)
        known[id(value)] = number, value
        if isinstance(value, np.ndarray):
            arrays.append(np.ascontiguousarray(value))
            fields_ = {"dtype": value.dtype.str, "shape": value.shape}
        elif isinstance(value, Texture):
            levels = {kind: chain.result() for kind, chain in chains[value].items()}
            fields_ = {"name": value.name, "wrap": value.wrap, "nearest": value.nearest}
            fields_ |= {"levels": levels, "texels": None if levels else value.texels()}
        else:
            fields_ = {field.name: getattr(value, field.name) for field in fields(value)}
            if isinstance(value, Material):
                fields_["property_map"] = value.property_map
        return {"type": type(value).__name__, "as": number, "fields": fields_}

    entry = {"files": files, "warnings": warnings, "mesh": mesh}
    head = json.dumps(entry, default=described).encode()
    pieces: list[bytes | memoryview] = [_LENGTH.pack(len(head)), head]
    size = _LENGTH.size + len(head)
    for array in arrays:
        pieces += [bytes(-size % _ALIGNMENT), array.data]
        size += -size % _ALIGNMENT + array.nbytes
    return pieces


def _decoded(head: bytes, content: memoryview, start: int) -> dict[str, Any]:
    """Return a cache entry from its description and the arrays that begin at ``start``."""
    values: dict[int, Any] = {}

    def made(table: dict[str, Any]) -> Any:
        """Make a value from its description. A value comes before the values that contain it."""
        nonlocal start
        if table.keys() == {"number"}:
            return values[table["number"]]
        if table.keys() != {"type", "as", "fields"}:
            return table
        name: str = table["type"]
        value: Any
        attributes = {key: _as_tuple(value) for key, value in table["fields"].items()}
        if name == "ndarray":
            start += -start % _ALIGNMENT
            value = np.ndarray(attributes["shape"], attributes["dtype"], content, start)
            start += value.nbytes
        elif name == "Texture":
            chains, texels = attributes["levels"], attributes["texels"]
            base = next(iter(chains.values()))[0][..., :3] if texels is None else texels
            texture = Texture.known(base, attributes["name"], chains)
            value = texture.sampled(attributes["wrap"], attributes["nearest"])
        else:
            packed = attributes.pop("property_map", None)
            module = import_module(f"facerender.{_MODULES[name]}")
            value = getattr(module, name)(**attributes)
            if packed is not None:  # the material finds it instead of packing the maps again
                red, green, blue = value.properties
                pack(red, green, blue, packed)
        values[table["as"]] = value
        return value

    entry: dict[str, Any] = json.loads(head, object_hook=made)
    return entry


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list) else value
