"""The scene as it is drawn. No OpenGL here.

Preparation removes unused features, reduces large maps, decodes maps ahead of drawing and estimates
the memory. A scene is then combined with a shading: the lights in the order in which programs loop
over them, and the specular term of each part for the part's range of m. The renderer, the reference
and ``pricing`` use the same result.

m is the first of these values that exists: the constant m of the shading's term (``Term.m``), then
(roughness factor times roughness map)^2, then ``Material.m``. ``simplify`` replaces the material's
m if the shading's term has a constant m. ``Term.slope`` resolves m for a term, and
``scenes.mesh.base_slope`` for a part."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from facerender.errors import InputError
from facerender.scenes.light import Light, LightSpace, disc_of, light_space
from facerender.scenes.material import MAPS, PROPERTY_MAPS, Material
from facerender.scenes.mesh import Mesh, Part, blends_only, coordinates, slope_range
from facerender.scenes.mips import Kind
from facerender.scenes.scene import Scene
from facerender.scenes.texture import LARGE, Texture
from facerender.scenes.view import View, levels_to_spare
from facerender.shading import Shading, Term
from facerender.system.process import MIB, limit
from facerender.terms.model import slope_filtered, slope_variance_disc, slope_variance_map


@dataclass(frozen=True)
class LightGroup:
    """Lights of one kind, all with or all without a specular term and a shadow.

    kind : see ``scenes.light.LIGHT_KINDS``
    specular : whether the lights have a specular term
    count : number of lights, at least one
    shadows : index of the shadow map of the group's first light; None for lights without shadows
    """

    kind: str
    specular: bool
    count: int
    shadows: int | None = None


@dataclass(frozen=True)
class Lighting:
    """The lights of a scene in the order in which programs loop over them.

    Lights are sorted by kind, then by term (lights without a term last), then by shadow (lights
    without shadows first).

    order : for each sorted light, its index in the scene
    lights : the sorted lights
    groups : groups of the sorted lights
    """

    order: tuple[int, ...]
    lights: tuple[Light, ...]
    groups: tuple[LightGroup, ...]

    @classmethod
    def of(cls, scene: Scene, shading: Shading) -> Lighting:
        """Sort the lights of a scene."""
        keys = [
            (light.kind.name, not shading.shines(index), light.shadow)
            for index, light in enumerate(scene.lights)
        ]
        groups, maps = [], 0
        for key, count in sorted(Counter(keys).items()):
            kind, without_term, shadow = key
            groups.append(LightGroup(kind, not without_term, count, maps if shadow else None))
            maps += count * shadow
        order = tuple(sorted(range(len(keys)), key=keys.__getitem__))
        return cls(order, tuple(scene.lights[index] for index in order), tuple(groups))

    @property
    def shining(self) -> int:
        """Number of lights with a specular term."""
        return sum(group.count for group in self.groups if group.specular)

    @property
    def shadowed(self) -> tuple[int, ...]:
        """Indices of the scene's lights that cast shadows, in the order of their shadow maps."""
        lights = zip(self.order, self.lights, strict=True)
        return tuple(index for index, light in lights if light.shadow)

    def spaces(self, mesh: Mesh) -> list[LightSpace]:
        """Return the spaces of the lights that cast shadows, in the order of their shadow maps. For
        errors see :func:`light_space`."""
        return [light_space(light, mesh) for light in self.lights if light.shadow]

    def uniforms(self, mesh: Mesh) -> dict[str, Any]:
        """Return the uniforms of all lights: arrays keyed by name."""
        arrays: dict[str, Any] = {}
        for kind in dict.fromkeys(light.kind for light in self.lights):
            arrays |= kind.uniforms([light for light in self.lights if light.kind is kind], mesh)
        if spaces := self.spaces(mesh):
            arrays["shadow_view"] = np.array([space.matrix for space in spaces])
            arrays["shadow_size"] = np.array(
                [(space.tan_radius, space.top, space.scale) for space in spaces]
            )
        return arrays


@dataclass(frozen=True, eq=False)
class ResolvedScene:
    """A simplified scene with its shading and sorted lights; see :func:`resolve`."""

    scene: Scene
    shading: Shading
    lighting: Lighting

    @cached_property
    def slopes(self) -> list[tuple[float, float]]:
        """The smallest and the largest m of each part. A constant m of the term replaces both.

        The largest m includes the largest amounts that slope filter and area lights add. Raises
        InputError if a light is too near to the mesh for its radius.
        """
        scene, shading = self.scene, self.shading
        discs = [disc for light in scene.lights if (disc := disc_of(light, scene.mesh))]
        shared = max((float(slope_variance_disc(*disc, 0.0)) for disc in discs), default=0.0)
        ranges = []
        for part, material in zip(scene.mesh.parts, scene.mesh.materials, strict=True):
            smallest, largest = slope_range(part, material)
            variance = shared
            if part.uv is not None and material.normal_map and shading.normal_map:
                strength = material.normal_strength**2
                variance += strength * float(slope_variance_map(1.0)) * shading.slope_filter
            if variance:
                largest = float(slope_filtered(largest, variance))
            ranges.append((smallest, largest))
        return ranges

    @cached_property
    def terms(self) -> list[Term]:
        """The term of each part, with the exact lobe if the shading's lobe forbids the part's m.
        Raises InputError instead if ``shading.outside`` is "error"."""
        shading = self.shading
        return [shading.term.for_slopes(*limits, shading.outside) for limits in self.slopes]


def resolve(scene: Scene, shading: Shading) -> ResolvedScene:
    """Remove the features of a scene that the shading leaves out, and sort its lights. For errors
    see :func:`facerender.drawing.prepare.simplify`."""
    simple = simplify(scene, shading)
    return ResolvedScene(simple, shading, Lighting.of(simple, shading))


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
