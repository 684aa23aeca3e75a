"""Metadata of images: the parameters of a scene and a shading as text. No OpenGL."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import fields
from pathlib import PurePath
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from facerender.drawing.prepare import part_maps, simplify
from facerender.drawing.resolve import ResolvedScene
from facerender.errors import clipped
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.mips import Kind
from facerender.scenes.scene import Only, Scene
from facerender.scenes.texture import Texture
from facerender.shading import Shading

_LONGEST = 400  # characters of a value: Exif metadata of a JPEG has at most 64 KiB
_of_meshes: WeakKeyDictionary[Mesh, dict[str, str]] = WeakKeyDictionary()
_checksums: WeakKeyDictionary[Part, int] = WeakKeyDictionary()
_ALWAYS = ("albedo", "m", "f0", "ks", "kd")  # factors that are listed also if they are defaults


def scene_metadata(scene: Scene, shading: Shading, albedo: Kind) -> dict[str, str]:
    """Return the parameters of a scene as text, without paths of files.

    The keys are "mesh", "camera", "light 0" and so on, "ambient", "background", "environment",
    "before"; the factors and maps of materials by the names of :class:`Material`, such as "m",
    unless all parts have the default; and "textures": "float", or "8-bit" if an 8-bit map is used.

    albedo : kind of mip chain of albedo maps: "color" or "linear-color"
    """
    if scene.mesh not in _of_meshes:
        texts = {"mesh": _mesh(scene.mesh), **_materials(scene.mesh)}
        _of_meshes[scene.mesh] = {name: _limited(text) for name, text in texts.items()}
    texts = {"camera": repr(scene.camera)}
    texts |= {f"light {index}": repr(light) for index, light in enumerate(scene.lights)}
    texts |= {name: str(getattr(scene, name)) for name in ("ambient", "background")}
    if scene.environment is not None:
        name = PurePath(scene.environment.panorama.name).name
        rotation, scale = scene.environment.rotation, scene.environment.scale
        texts["environment"] = f"{name}, rotation {rotation}, scale {scale}"
    if scene.before is not None:
        texts["before"] = f"{_mesh(scene.before.mesh)}, {scene.before.camera!r}"
    drawn = simplify(scene, shading).mesh
    parts = zip(drawn.parts, drawn.materials, strict=True)
    maps = (map_ for pair in parts for map_ in part_maps(*pair, albedo, slope_filter=True))
    texts["textures"] = "float" if all(kind == "linear-color" for *_, kind in maps) else "8-bit"
    return _of_meshes[scene.mesh] | {name: _limited(text) for name, text in texts.items()}


def shading_metadata(resolved: ResolvedScene, only: Only | None) -> dict[str, str]:
    """Return the shading of an image as text: model, lobe, Fresnel and masking term, values that
    differ from the defaults, and the lobe of each part if lobes differ from the shading's."""
    shading = resolved.shading
    texts = {key: str(value) for key, value in shading.as_dict().items()}
    for name in ("model", "lobe", "fresnel", "masking"):
        texts[name] = str(getattr(shading.term, name))
    terms = resolved.terms if only != "diffuse" and resolved.lighting.shining else []
    if any(term != shading.term for term in terms):
        texts["lobe of each part"] = ", ".join(str(term.lobe) for term in terms)
    return {name: _limited(text) for name, text in texts.items()}


def _limited(text: str) -> str:
    """Return a text of one line, which is cut and gets a checksum if it is long."""
    if len(text) <= _LONGEST and text.isprintable():
        return text
    return f"{clipped(text, _LONGEST)} (CRC-32 {zlib.crc32(text.encode(errors='replace')):08x})"


def _mesh(mesh: Mesh) -> str:
    vertices = sum(len(part.positions) for part in mesh.parts)
    triangles = sum(len(part.faces) for part in mesh.parts)
    # float32 hides differences between processors in the last bits of float64.
    checksum = zlib.crc32(str([*map(_checksum, mesh.parts)]).encode())
    size = f"{vertices} vertices, {triangles} triangles, radius {mesh.radius:.6g}"
    unit = "" if mesh.millimetres is None else f", 1 unit = {mesh.millimetres} mm"
    return f"{mesh.name}, {size}{unit}, CRC-32 {checksum:08x}"


def _checksum(part: Part) -> int:
    if part not in _checksums:
        with np.errstate(over="ignore"):  # a pose may exceed float32
            _checksums[part] = zlib.crc32(part.positions.astype(np.float32).tobytes())
    return _checksums[part]


def _materials(mesh: Mesh) -> dict[str, str]:
    """Return each factor and map of the materials as one text for all parts."""
    rows = {}
    for field in fields(Material):
        values = [_used(material, field.name) for material in mesh.materials]
        if field.name in _ALWAYS or any(value != field.default for value in values):
            rows[field.name] = _by_part(mesh, values)
    return rows


def _used(material: Material, name: str) -> Any:
    """Return a factor or map of a material; of m and roughness_factor, only the used one."""
    if name == "m" and material.roughness_map is not None:
        return "of the roughness map"
    if name == "roughness_factor" and material.roughness_map is None:
        return Material.roughness_factor
    return getattr(material, name)


def _by_part(mesh: Mesh, values: Iterable[Any]) -> str:
    """Return a value for each part as text, each value once: "0.3" or "0.3 (head); 0.1 (eyes)"."""
    names: dict[str, list[str]] = {}
    for number, (part, value) in enumerate(zip(mesh.parts, values, strict=True), 1):
        text = _map(value) if isinstance(value, Texture) else str(value)
        text = str(float(f"{value:.9g}")) if isinstance(value, float) else text
        names.setdefault(text, []).append(part.name or f"part{number}")
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{text} ({', '.join(part_names)})" for text, part_names in names.items())


def _map(texture: Texture) -> str:
    width, height = texture.decoded_size
    return f"{PurePath(texture.name).name}, {width} x {height}"
