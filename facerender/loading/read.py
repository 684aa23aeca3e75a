"""Mesh files as trimesh reads them, and what it would pass over."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from facerender.errors import InputError, reason, warn

if TYPE_CHECKING:
    import trimesh


SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".tga")
# glTF extensions that may be required: handled, or without effect on what is drawn here.
_GLTF_EXTENSIONS = {
    "KHR_draco_mesh_compression",
    "KHR_mesh_quantization",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_specular",
    "KHR_materials_ior",
    "KHR_materials_unlit",
}


def read(
    path: Path, skip_images: bool
) -> tuple[list[tuple[trimesh.Trimesh, NDArray[np.float64]]], dict[str, bytes | None]]:
    """Return every instance of a geometry with faces and its transform, and by name the files that
    the file refers to; None was not found."""
    suffix = path.suffix.lower()
    if path.is_dir():
        raise InputError(f"{path} is a directory; give a mesh file in it")
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown mesh format {suffix!r}; give {', '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {reason(error)}") from None
    if not data:
        raise InputError(f"{path.name} is an empty file: there is no geometry in it")
    if suffix in (".glb", ".gltf"):
        _check_gltf(data, path.name, skip_images)

    import trimesh
    from trimesh.resolvers import FilePathResolver

    class Resolver(FilePathResolver):  # type: ignore[misc]
        """Remembers what was asked for, and what could not be found or is no image, which trimesh
        passes over."""

        def __init__(self) -> None:
            super().__init__(str(path))
            self.files: dict[str, bytes | None] = {}
            self.broken: list[str] = []

        def get(self, name: str) -> bytes:
            self.files[name] = None
            content = self.files[name] = referred(path.parent, name)
            if name.lower().endswith(_IMAGE_SUFFIXES) and not _is_image(content):
                self.broken.append(name)
            return content

    resolver = Resolver()
    try:
        scene = trimesh.load_scene(
            trimesh.util.wrap_as_stream(data),
            file_type=suffix[1:],
            resolver=resolver,
            process=False,
        )
    except Exception as error:  # each reader of trimesh fails in its own way on a damaged file
        if missing := _missing(resolver.files):
            raise InputError(
                f"{missing[0]} (named by {path.name}) not found in {path.parent}"
            ) from None
        raise InputError(f"{path.name} is damaged ({error}); export it again") from None
    instances = [
        (geometry, np.asarray(transform))
        for transform, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
        if isinstance(geometry := scene.geometry[name], trimesh.Trimesh) and len(geometry.faces)
    ]
    if not instances:
        points = any(len(getattr(g, "vertices", ())) for g in scene.geometry.values())
        what = "are only points and no faces" if points else "is no geometry"
        raise InputError(f"there {what} in {path.name}; give a triangle mesh")
    if not skip_images:
        if resolver.broken:
            raise InputError(
                f"{resolver.broken[0]} (named by {path.name}) is not an image that can "
                "be read; replace it, or pass --albedo FILE"
            )
        _warn_missing(_missing(resolver.files), path)
    return instances, resolver.files


def referred(folder: Path, name: str) -> bytes:
    """Return the content of a file that a mesh file in a folder refers to: by its path, or else
    beside the mesh file.

    Raises
    ------
    OSError : it is not there, or cannot be read
    """
    name = name.replace("\\", "/").strip()
    for each in (name, name.lstrip("/"), os.path.basename(name)):
        if (folder / each).exists():
            return (folder / each).read_bytes()
    raise FileNotFoundError(name)


def _missing(files: Mapping[str, bytes | None]) -> list[str]:
    return [name for name, content in files.items() if content is None]


def _is_image(content: bytes) -> bool:
    from io import BytesIO

    from PIL import Image

    try:
        Image.open(BytesIO(content))
    except (OSError, Image.DecompressionBombError):
        return False
    return True


def _warn_missing(missing: Sequence[str], path: Path) -> None:
    beside = [each.name for each in path.parent.iterdir() if each.suffix in _IMAGE_SUFFIXES]
    for name in missing:
        hint = f"pass --albedo {beside[0] if len(beside) == 1 else 'FILE'}"
        warn(
            f"{name} (named by {path.name}) not found in {path.parent}: "
            f"rendering without it; {hint}"
        )


def _check_gltf(data: bytes, name: str, skip_images: bool) -> None:
    """Find what trimesh would pass over: truncation, no mesh, extensions without a decoder, and
    textures in a GLB that are no images."""
    text, binary = data, len(data)
    if data[:4] == b"glTF":
        if len(data) < 20 or (declared := struct.unpack_from("<I", data, 8)[0]) > len(data):
            said = declared if len(data) >= 20 else "at least 20"
            raise InputError(
                f"{name} is truncated: its header says {said} bytes, the file has {len(data)}"
            )
        text = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]]
        binary = 20 + len(text) + 8
    try:
        document = json.loads(text)
        primitives = [p for mesh in document.get("meshes", ()) for p in mesh["primitives"]]
        embedded = [image for image in document.get("images", ()) if "bufferView" in image]
        views = [document["bufferViews"][image["bufferView"]] for image in embedded]
        required = set(document.get("extensionsRequired", ()))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{name} is not glTF: its JSON cannot be read") from None
    if not primitives:
        raise InputError(f"there is no mesh in {name}; give a file with a triangle mesh")
    for view in [] if skip_images or text is data else views:
        start = binary + view.get("byteOffset", 0)
        if not _is_image(data[start : start + view.get("byteLength", 0)]):
            raise InputError(
                f"a texture in {name} is not an image that can be read; pass --albedo FILE"
            )
    if unknown := sorted(required - _GLTF_EXTENSIONS):
        raise InputError(f"{name} requires the extension {unknown[0]}; export it without")
    if any("KHR_draco_mesh_compression" in p.get("extensions", ()) for p in primitives):
        try:
            import DracoPy  # noqa: F401
        except ImportError:
            raise InputError(f"{name} is compressed with Draco: pip install DracoPy") from None
