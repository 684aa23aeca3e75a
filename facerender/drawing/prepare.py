"""The scene as it is drawn. No OpenGL here.

Preparation removes unused features, reduces large maps, decodes maps ahead of drawing and estimates
the memory. A scene is then combined with a shading: the lights in the order in which programs loop
over them, and the specular term of each part for the part's range of m. The renderer, the reference
and ``pricing`` use the same result.

m is the first of these values that exists: the constant m of the shading's term (``Term.m``), then
(roughness factor times roughness map)^2, then ``Material.m``. ``simplify`` replaces the material's
m if the shading's term has a constant m. ``Term.slope`` resolves m for a term."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from facerender.errors import InputError
from facerender.material import MAPS, PROPERTY_MAPS, Alpha, Material
from facerender.mesh.mesh import Mesh, coordinates, drawn_alpha, slope_range
from facerender.mesh.part import Part, Space
from facerender.scene.light import Light, LightKind, LightSpace, disc_of, light_space
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading, Term
from facerender.scene.view import View, levels_to_spare
from facerender.system.process import MIB, limit
from facerender.terms.model import slope_filtered, slope_variance_disc, slope_variance_map
from facerender.texture.texture import LARGE, Kind, Texture
from facerender.values.vectors import Float, Size, Vector

if TYPE_CHECKING:
    from facerender.scene.environment import Environment


@dataclass(frozen=True)
class LightGroup:
    """Lights of one kind, all with or all without a specular term and a shadow.

    kind : see ``scene.light.LIGHT_KINDS``
    shadows : index of the shadow map of the group's first light; None for lights without shadows
    environment : whether the lights belong to the environment map
    """

    kind: str
    specular: bool
    count: int
    shadows: int | None = None
    environment: bool = False


class Lighting:
    """The lights of a scene and its environment map in the order in which programs loop over them.

    Lights are sorted by kind, then by term (lights without a term last), then by shadow (lights
    without shadows first); the lights of the environment follow the scene's. They have no term: the
    specular light of an environment is sampled.

    order : for each sorted light, its index in the scene; the environment's are counted from the
        number of the scene's lights
    by_type : the sorted lights by their entry in LIGHT_KINDS
    shining : number of lights with a specular term
    shadowed : indices of the scene's lights that cast shadows, in the order of their shadow maps
    """

    def __init__(self, scene: Scene, shading: Shading) -> None:
        first = len(scene.lights)
        source = scene.environment
        self.environment = source.lights(shading.environment_lights) if source else ()
        lights = scene.lights + self.environment
        keys = []
        for index, light in enumerate(lights):
            around = index >= first
            without_term = around or not shading.shines(index)
            keys.append((light.kind.name, without_term, light.shadow, around))
        groups, maps = [], 0
        for (name, without_term, shadow, around), count in sorted(Counter(keys).items()):
            map_ = maps if shadow else None
            groups.append(LightGroup(name, not without_term, count, map_, around))
            maps += count * shadow
        self.groups, self.order = tuple(groups), sorted(range(len(keys)), key=keys.__getitem__)
        self.lights = [lights[index] for index in self.order]
        self.by_type: dict[LightKind, list[Light]] = {}
        for index in self.order:
            self.by_type.setdefault(lights[index].kind, []).append(lights[index])
        self.shining = sum(group.count for group in groups if group.specular)
        self.shadowed = tuple(index for index in self.order if lights[index].shadow)


@dataclass(frozen=True, eq=False)
class ResolvedPart:
    """A part as it is drawn, in any pose and from any camera.

    part : the part in the reference pose
    material : material without the features that the shading leaves out
    alpha : see :func:`facerender.mesh.mesh.drawn_alpha`
    slope : m of the first lobe, or the factor that maps squared roughness texels to m
    maps : uniform name, texture and kind of mip chain of each map
    second : names of these maps that use the second texture coordinates
    """

    index: int
    part: Part
    material: Material
    alpha: Alpha
    slope: float
    maps: list[tuple[str, Texture, Kind]]
    second: tuple[str, ...]


def resolved_parts(
    mesh: Mesh, albedo: Kind = "color", slope_filter: bool = True
) -> tuple[ResolvedPart, ...]:
    """Return the parts of a mesh as they are drawn.

    albedo : kind of mip chain of colour maps: "color" or "linear-color"
    slope_filter : whether the normal map's mip chain stores the standard deviation of the slopes
    """
    resolved = []
    for index, (part, mat) in enumerate(zip(mesh.geometry.parts, mesh.materials, strict=True)):
        candidates: list[tuple[str, Texture | None, Kind]] = [
            ("albedo_map", mat.albedo_map, albedo),
            ("normal_map", mat.normal_map, "normal" if slope_filter else "data"),
            ("property_map", mat.property_map, "data"),
            ("lobe_map", mat.lobe_map if mat.two_lobes else None, "data"),
            ("opacity_map", None if mat.alpha == "opaque" else mat.opacity_map, "data"),
            ("emissive_map", mat.emissive_map if any(mat.emissive) else None, albedo),
        ]
        if not mat.packs:
            candidates += [(name, getattr(mat, name), "data") for name in PROPERTY_MAPS]
        maps, second = [], []
        for name, texture, mip_kind in candidates if part.uv is not None else ():
            if texture is not None and (uv := coordinates(part, mat, name)) is not None:
                maps.append((name, texture, mip_kind))
                second += [name] if uv is part.uv2 else []
        mapped = mat.roughness_map and coordinates(part, mat, "roughness_map") is not None
        slope = mat.roughness_factor**2 if mapped else mat.m
        alpha = drawn_alpha(part, mat)
        resolved.append(ResolvedPart(index, part, mat, alpha, slope, maps, tuple(second)))
    return tuple(resolved)


@dataclass(frozen=True, eq=False)
class Appearance:
    """All that an image shows except camera, background and the positions of vertices.

    It belongs to one geometry, and stays the same while the camera and the pose change, so that it
    owns what the renderer derives from it.

    materials, lights, ambient, environment, space : of the simplified scene
    changed : names of the fields of the scene that the simplified scene changes
    token : value that no other appearance has
    """

    materials: tuple[Material, ...]
    lights: tuple[Light, ...]
    ambient: float | Vector
    environment: Environment | None
    space: Space
    shading: Shading
    lighting: Lighting
    parts: tuple[ResolvedPart, ...]
    changed: tuple[str, ...]
    token: object = field(default_factory=object)

    @classmethod
    def of(
        cls, scene: Scene, shading: Shading, albedo: Kind, changed: tuple[str, ...] = ()
    ) -> Appearance:
        """Return the appearance of a simplified scene; see also :func:`resolved_parts`."""
        mesh, parts = scene.mesh, resolved_parts(scene.mesh, albedo, shading.slope_filter)
        light = scene.lights, scene.ambient, scene.environment
        lighting = Lighting(scene, shading)
        return cls(mesh.materials, *light, mesh.space, shading, lighting, parts, changed)

    @cached_property
    def slopes(self) -> list[tuple[float, float]]:
        """The smallest and the largest m of each part. A constant m of the term replaces both.

        The largest m includes the largest amounts that slope filter and area lights add. Raises
        InputError if a light is too near to the mesh for its radius.
        """
        discs = [disc for light in self.lights if (disc := disc_of(light, self.space))]
        shared = max((float(slope_variance_disc(*disc, 0.0)) for disc in discs), default=0.0)
        filters, ranges = self.shading.normal_map and self.shading.slope_filter, []
        for resolved in self.parts:
            part, material = resolved.part, resolved.material
            smallest, largest = slope_range(part, material)
            variance = shared
            if part.uv is not None and material.normal_map and filters:
                variance += material.normal_strength**2 * float(slope_variance_map(1.0))
            largest = float(slope_filtered(largest, variance)) if variance else largest
            ranges.append((smallest, largest))
        return ranges

    @cached_property
    def terms(self) -> list[Term]:
        """The term of each part, with the exact lobe if the shading's lobe forbids the part's m.
        Raises InputError instead if ``shading.outside`` is "error"."""
        term, outside = self.shading.term, self.shading.outside
        return [term.for_slopes(*limits, outside) for limits in self.slopes]

    @cached_property
    def light_spaces(self) -> list[LightSpace]:
        """The spaces of the shadow maps in order. Raises the errors of :func:`light_space`."""
        return [light_space(light, self.space) for light in self.lighting.lights if light.shadow]

    @cached_property
    def unblended(self) -> list[ResolvedPart]:
        """The parts that are not blended."""
        return [part for part in self.parts if part.alpha != "blend"]

    @cached_property
    def blended(self) -> list[ResolvedPart]:
        """The blended parts."""
        return [part for part in self.parts if part.alpha == "blend"]

    @cached_property
    def scatters(self) -> bool:
        """Whether light scatters in a part."""
        return any(m.scattering and m.diffuse_weight > 0.0 for m in self.materials)

    @cached_property
    def large_maps(self) -> list[tuple[ResolvedPart, str, Texture, Float]]:
        """The maps of more than LARGE texels, by part: name, map and texture coordinates."""
        return [
            (part, name, texture, uv)
            for part in self.parts
            for name in MAPS
            if (texture := getattr(part.material, name)) is not None
            and _texels(texture) > LARGE
            and (uv := coordinates(part.part, part.material, name)) is not None
        ]


@dataclass(frozen=True, eq=False)
class ResolvedScene:
    """A simplified scene with its appearance."""

    scene: Scene
    appearance: Appearance


def resolve(scene: Scene, shading: Shading, albedo: Kind = "color") -> ResolvedScene:
    """Return a simplified scene and its appearance; see :func:`simplify`, also for errors.

    The geometry owns its recent appearances, because consecutive frames mostly differ in the camera
    or in the pose, and measurements alternate between few shadings.
    """
    mesh = scene.mesh
    light = scene.lights, scene.ambient, scene.environment
    key = mesh.materials, *light, mesh.space, shading, albedo
    recent: list[Any] = mesh.geometry.derived.setdefault("appearances", [])
    look: Appearance | None = next((look for other, look in recent if other == key), None)
    if look is None:
        simple = simplify(scene, shading)
        names = "mesh", "lights", "ambient", "environment"
        changed = tuple(n for n in names if getattr(simple, n) is not getattr(scene, n))
        look = Appearance.of(simple, shading, albedo, changed)
        # Appearances with other images would keep these images in memory.
        images = _images(mesh.materials)
        others = [pair for pair in recent if _images(pair[0][0]) == images]
        recent[:] = [(key, look), *others[: _MAX_RECENT - 1]]
    changes: dict[str, Any] = {name: getattr(look, name) for name in look.changed if name != "mesh"}
    if "mesh" in look.changed:
        changes["mesh"] = replace(mesh, materials=look.materials)
    return ResolvedScene(replace(scene, **changes) if changes else scene, look)


def _images(materials: tuple[Material, ...]) -> set[object]:
    textures = (getattr(material, name) for material in materials for name in MAPS)
    return {texture.image for texture in textures if texture is not None}


_MAX_RECENT = 4
# Bytes of memory, measured on llvmpipe: package and context, all programs; then per triangle, per
# pixel and per sample.
_ALWAYS, _PROGRAMS = 110 * MIB, 90 * MIB
_OF_TRIANGLE, _OF_PIXEL, _OF_SAMPLE = 500, 48, 20


def simplify(scene: Scene, shading: Shading) -> Scene:
    """Return the scene without the features that a shading leaves out.

    Raises InputError if m or ks is outside its domain, or if the scene lacks a chosen light.
    """
    shading.check_lights(len(scene.lights))
    materials = scene.mesh.materials
    changes: dict[str, Any] = {}
    if shading.term.m is not None:
        changes["m"] = shading.term.m
    if shading.ks is not None:
        changes |= {"ks": shading.ks, "specular_map": None}
    if not shading.two_lobes and any(material.two_lobes for material in materials):
        changes["lobe_weight"] = 1.0
    if not shading.normal_map:
        changes["normal_map"] = None
    if not shading.scatter_samples and any(material.scattering for material in materials):
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
    return replace(scene, mesh=scene.mesh.with_material(**changes))


def reduced(resolved: ResolvedScene, view: View, size: Size, anisotropy: float) -> Scene:
    """Return a scene whose maps of more than LARGE texels begin at the finest level that is read.

    anisotropy : maximum anisotropy of texture filtering
    """
    scene, large = resolved.scene, resolved.appearance.large_maps
    levels: dict[Any, int] = {}
    spared: dict[Texture, int] = {}
    for part, _, texture, uv in large:
        key = part.index, uv is part.part.uv, texture.size  # maps of one part share coordinates
        if key not in levels:
            # The reference pose decides, so that the maps stay while the mesh moves.
            arguments = scene.mesh, part.part, uv, texture.size
            levels[key] = levels_to_spare(*arguments, view, size, anisotropy)
        spared[texture] = min(levels[key], spared.get(texture, levels[key]))
    if not any(spared.values()):
        return scene
    materials = [*scene.mesh.materials]
    for part, name, texture, _ in large:
        coarser: dict[str, Any] = {name: texture.coarser(spared[texture])}
        materials[part.index] = replace(materials[part.index], **coarser)
    return replace(scene, mesh=replace(scene.mesh, materials=tuple(materials)))


def start_maps(parts: Iterable[ResolvedPart]) -> None:
    """Start to decode maps of parts in threads, except large maps, which may be reduced."""
    for part in parts:
        for _, texture, mip_kind in part.maps:
            if not texture.coarse and _texels(texture) <= LARGE:
                texture.levels(mip_kind)


def _texels(texture: Texture) -> int:
    return math.prod(texture.size)


def check_memory(resolved: ResolvedScene, size: Size, samples: int, most: float | None) -> None:
    """Raise InputError if the estimated memory for drawing a scene exceeds a limit.

    resolved : scene with reduced maps
    samples : samples per pixel that the driver draws at once
    most : limit of the process's memory in MiB; None for the free memory of the system
    """
    geometry = resolved.scene.mesh.geometry
    maps = {map_[1:] for part in resolved.appearance.parts for map_ in part.maps}
    resident = _ALWAYS + _OF_TRIANGLE * float(sum(len(part.faces) for part in geometry.parts))
    decoding = 0.0
    for texture, mip_kind in maps:
        chain = _texels(texture) * (8 if mip_kind == "linear-color" else 4) * 4.0 / 3.0
        image = 4.0 * math.prod(texture.decoded_size)
        resident += chain if texture.coarse else 2.0 * chain
        decoding = max(decoding, image if texture.coarse else 2.0 * image + 0.25 * chain)
    drawing = _PROGRAMS + math.prod(size) * (_OF_PIXEL + samples * _OF_SAMPLE)
    needed = (resident + max(decoding, drawing)) / MIB
    if needed > (free := limit(most)):
        subject = f"{geometry.name} at {size[0]} x {size[1]} with {samples} samples"
        remedy = "give a smaller size, fewer samples or smaller maps"
        raise InputError(f"{subject} needs about {needed:.0f} MiB of {free:.0f}: {remedy}")
