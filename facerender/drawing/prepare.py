"""What is drawn of a scene: without what a shading leaves out, and with which maps, started ahead.
No OpenGL here."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Kind, Texture
from facerender.shading import Shading

_MOST_SIMPLIFIED = 64  # of one mesh
_simplified: WeakKeyDictionary[Mesh, dict[tuple[Any, ...], Mesh]] = WeakKeyDictionary()


def simplify(scene: Scene, shading: Shading) -> Scene:
    """Return the scene without the maps, the shadows, the scattering, the environment and the
    ambient light that a shading leaves out.

    The same mesh gives the same simplified mesh again, so that a renderer keeps its maps.

    Raises
    ------
    InputError : m or ks outside its domain, a light that the scene does not have
    """
    shading.check_lights(len(scene.lights))
    changes: dict[str, Any] = {}
    if (m := shading.constant_slope) is not None:
        changes["m"] = m
    if shading.ks is not None:
        changes |= {"ks": shading.ks, "specular_map": None}
    if not shading.two_lobes and any(each.two_lobes for each in scene.mesh.materials):
        changes["lobe_weight"] = 1.0
    if not shading.normal_map:
        changes["normal_map"] = None
    if not shading.scatter_samples and any(each.scattering for each in scene.mesh.materials):
        changes["scattering"] = None
    if shading.shadow_lights is not None:
        cast = [light.shadow and i in shading.shadow_lights for i, light in enumerate(scene.lights)]
        lights = zip(scene.lights, cast, strict=True)
        scene = replace(scene, lights=tuple(replace(each, shadow=on) for each, on in lights))
    if scene.environment is not None and not shading.environment:
        scene = replace(scene, environment=None)
    if not shading.ambient:
        scene = replace(scene, ambient=0.0)
        if scene.environment is None:
            changes["occlusion_map"] = None
    if not changes:
        return scene
    known = _simplified.setdefault(scene.mesh, {})
    key = tuple(changes.items())
    if key not in known:
        if len(known) >= _MOST_SIMPLIFIED:
            del known[next(iter(known))]
        known[key] = scene.mesh.with_material(**changes)
    return replace(scene, mesh=known[key])


def part_maps(
    part: Part, material: Material, albedo: Kind, slope_filter: bool
) -> list[tuple[str, Texture, Kind]]:
    """Return the maps that a part is drawn with: name, texture, kind of mip chain.

    albedo is the kind for the albedo map: "color" or "linear-color".
    """
    if part.uv is None:
        return []
    candidates: list[tuple[str, Texture | None, Kind]] = [
        ("albedo_map", material.albedo_map, albedo),
        ("normal_map", material.normal_map, "normal" if slope_filter else "data"),
        ("property_map", material.property_map, "data"),
        ("lobe_map", material.lobe_map if material.two_lobes else None, "data"),
    ]
    return [(name, texture, kind) for name, texture, kind in candidates if texture is not None]


def start_maps(mesh: Mesh, albedo: Kind = "color", slope_filter: bool = True) -> None:
    """Start decoding the maps of a mesh in threads, ahead of the renderer that waits for them."""
    for part, material in zip(mesh.parts, mesh.materials, strict=True):
        for _, texture, kind in part_maps(part, material, albedo, slope_filter):
            texture.levels(kind)
