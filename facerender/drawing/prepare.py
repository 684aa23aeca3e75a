"""Preparation of a scene for drawing: removal of unused features, reduction of large maps, decoding
of maps ahead of drawing, and the memory estimate. No OpenGL here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

from facerender.errors import InputError
from facerender.scenes.material import MAPS, PROPERTY_MAPS, Material
from facerender.scenes.mesh import Mesh, Part, blends_only, coordinates
from facerender.scenes.mips import Kind
from facerender.scenes.scene import Scene
from facerender.scenes.texture import LARGE, Texture
from facerender.scenes.view import View, levels_to_spare
from facerender.shading import Shading
from facerender.system.memory import MIB, limit

_MOST_SIMPLIFIED = 64  # largest number of cached variants of one mesh
# Bytes of memory, measured on llvmpipe: package and context, all programs; then per triangle, per
# pixel and per sample.
_ALWAYS, _PROGRAMS = 110 * MIB, 90 * MIB
_OF_TRIANGLE, _OF_PIXEL, _OF_SAMPLE = 500, 48, 20
_simplified: WeakKeyDictionary[Mesh, dict[tuple[Any, ...], Mesh]] = WeakKeyDictionary()


def simplify(scene: Scene, shading: Shading) -> Scene:
    """Return the scene without the maps, shadows, scattering, environment and ambient light that a
    shading leaves out.

    The simplified mesh is cached: the same changes of one mesh return the same object, so that a
    renderer reuses the uploaded maps. Raises InputError if m or ks is outside its domain, or if the
    shading names a light that the scene lacks.
    """
    shading.check_lights(len(scene.lights))
    changes: dict[str, Any] = {}
    if shading.term.m is not None:
        changes["m"] = shading.term.m
    if shading.ks is not None:
        changes |= {"ks": shading.ks, "specular_map": None}
    if not shading.two_lobes and any(material.two_lobes for material in scene.mesh.materials):
        changes["lobe_weight"] = 1.0
    if not shading.normal_map:
        changes["normal_map"] = None
    if not shading.scatter_samples and any(
        material.scattering for material in scene.mesh.materials
    ):
        changes["scattering"] = None
    if shading.shadow_lights is not None:
        cast = [light.shadow and i in shading.shadow_lights for i, light in enumerate(scene.lights)]
        lights = zip(scene.lights, cast, strict=True)
        scene = replace(scene, lights=tuple(replace(light, shadow=on) for light, on in lights))
    if scene.environment is not None and not shading.environment:
        scene = replace(scene, environment=None)
    if not shading.ambient:
        scene = replace(scene, ambient=0.0)
        if scene.environment is None:
            changes["occlusion_map"] = None
    if not changes:
        return scene
    return _changed(scene, tuple(changes.items()), lambda mesh: mesh.with_material(**changes))


def _changed(scene: Scene, key: tuple[Any, ...], change: Callable[[Mesh], Mesh]) -> Scene:
    """Return a scene with a changed mesh, from a cache keyed by the original mesh and `key`."""
    variants = _simplified.setdefault(scene.mesh, {})
    if (mesh := variants.get(key)) is None:
        if len(variants) >= _MOST_SIMPLIFIED:
            variants.pop(next(iter(variants)), None)  # another thread may have removed it
        mesh = variants[key] = change(scene.mesh)
    return replace(scene, mesh=mesh)


def cut_out(scene: Scene, threshold: float) -> Scene:
    """Return the scene of data images: blended parts that do not transmit light become parts with
    an alpha mask, which have a surface where their opacity is at least `threshold`. Many exporters
    mark a whole face as blended. The mesh is cached."""
    if not any(blends_only(material) for material in scene.mesh.materials):
        return scene

    def masked(mesh: Mesh) -> Mesh:
        changes: dict[str, Any] = {"alpha": "mask", "alpha_cutoff": threshold}
        materials = (
            material.with_values(**changes) if blends_only(material) else material
            for material in mesh.materials
        )
        return replace(mesh, materials=tuple(materials))

    return _changed(scene, ("cut_out", threshold), masked)


def reduced(scene: Scene, view: View, size: tuple[int, int], anisotropy: float) -> Scene:
    """Return a scene whose large maps (more than LARGE texels) begin with the finest mip level that
    the image reads. The mesh with these maps is cached.

    scene : a simplified scene
    view : camera of the image
    size : width and height of the image in pixels
    anisotropy : maximum anisotropy of texture filtering
    """
    spared: dict[Texture, int] = {}
    levels: dict[tuple[Part, int, tuple[int, int]], int] = {}  # maps of one part share coordinates
    for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
        for name, texture in _large(part, material):
            uv = coordinates(part, material, name)
            assert uv is not None
            key = part, id(uv), texture.size
            if key not in levels:
                # The reference pose decides, so that the maps stay while the mesh moves.
                arguments = scene.mesh, part.root, uv, texture.size
                levels[key] = levels_to_spare(*arguments, view, size, anisotropy)
            spared[texture] = min(levels[key], spared.get(texture, levels[key]))
    if not any(spared.values()):
        return scene

    def coarser(mesh: Mesh) -> Mesh:
        materials = []
        for part, original in zip(mesh.parts, mesh.materials, strict=True):
            maps: dict[str, Any]
            maps = {name: map.coarser(spared[map]) for name, map in _large(part, original)}
            materials.append(replace(original, **maps))
        return replace(mesh, materials=tuple(materials))

    return _changed(scene, tuple(spared.items()), coarser)


def _large(part: Part, material: Material) -> Iterator[tuple[str, Texture]]:
    """Yield the :class:`Material` field and the texture of each large map of a part."""
    for name in MAPS:
        texture = getattr(material, name)
        if texture is None or coordinates(part, material, name) is None:
            continue
        if math.prod(texture.size) > LARGE:
            yield name, texture


def part_maps(
    part: Part, material: Material, albedo: Kind, slope_filter: bool
) -> list[tuple[str, Texture, Kind]]:
    """Return the uniform name, the texture and the kind of mip chain for each map of a part.

    albedo : kind of mip chain of colour maps: "color" or "linear-color"
    slope_filter : whether the normal map's mip chain stores the standard deviation of the slopes
    """
    if part.uv is None:
        return []
    emissive = material.emissive_map if any(material.emissive) else None
    candidates: list[tuple[str, Texture | None, Kind]] = [
        ("albedo_map", material.albedo_map, albedo),
        ("normal_map", material.normal_map, "normal" if slope_filter else "data"),
        ("property_map", material.property_map, "data"),
        ("lobe_map", material.lobe_map if material.two_lobes else None, "data"),
        ("opacity_map", None if material.alpha == "opaque" else material.opacity_map, "data"),
        ("emissive_map", emissive, albedo),
    ]
    if not material.packs:
        apart = zip(PROPERTY_MAPS, material.properties, strict=True)
        candidates += [(name, texture, "data") for name, texture in apart]
    return [
        (name, texture, kind)
        for name, texture, kind in candidates
        if texture is not None and coordinates(part, material, name) is not None
    ]


def start_maps(mesh: Mesh, albedo: Kind = "color", slope_filter: bool = True) -> None:
    """Start to decode the maps of a mesh in threads, before the renderer needs them. Large maps are
    skipped, since the renderer may reduce them."""
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        for _, texture, kind in part_maps(part, material, albedo, slope_filter):
            if not texture.coarse and math.prod(texture.size) <= LARGE:
                texture.levels(kind)


def check_memory(
    scene: Scene, size: tuple[int, int], samples: int, albedo: Kind, most: float | None
) -> None:
    """Raise InputError if the estimated memory for drawing a scene exceeds a limit.

    scene : simplified scene, with reduced maps
    size : width and height of the image in pixels
    samples : samples per pixel that the driver draws at once
    albedo : kind of mip chain of albedo maps: "color" or "linear-color"
    most : limit of the process's memory in MiB; None for the free memory of the system
    """
    mesh = scene.mesh
    maps: set[tuple[Texture, Kind]] = set()
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        maps |= {map_[1:] for map_ in part_maps(part, material, albedo, slope_filter=True)}
    resident = _ALWAYS + _OF_TRIANGLE * float(sum(len(part.faces) for part in mesh.parts))
    decoding = 0.0
    for texture, kind in maps:
        chain = math.prod(texture.size) * (8 if kind == "linear-color" else 4) * 4.0 / 3.0
        image = 4.0 * math.prod(texture.decoded_size)
        resident += chain if texture.coarse else 2.0 * chain
        decoding = max(decoding, image if texture.coarse else 2.0 * image + 0.25 * chain)
    drawing = _PROGRAMS + math.prod(size) * (_OF_PIXEL + samples * _OF_SAMPLE)
    needed = (resident + max(decoding, drawing)) / MIB
    if needed > (free := limit(most)):
        raise InputError(
            f"{mesh.name} at {size[0]} x {size[1]} with {samples} samples needs about "
            f"{needed:.0f} MiB of {free:.0f}: give a smaller size, fewer samples or smaller maps"
        )
