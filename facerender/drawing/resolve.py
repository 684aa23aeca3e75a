"""Combination of a scene and a shading: the lights in the order in which programs loop over them,
and the specular term of each part for the part's range of m. The renderer, the reference and
``pricing`` use the same result.

m is the first of these values that exists: the constant m of the shading's term (``Term.m``), then
(roughness factor times roughness map)^2, then ``Material.m``. ``prepare.simplify`` replaces the
material's m if the shading's term has a constant m. ``Term.slope`` resolves m for a term, and
``scenes.mesh.base_slope`` for a part. No OpenGL here."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facerender.drawing.prepare import simplify
from facerender.scenes.light import Light, LightSpace, disc_of, light_space
from facerender.scenes.mesh import Mesh, slope_range
from facerender.scenes.scene import Scene
from facerender.shading import Shading, Term
from facerender.terms.slope_variance import slope_filtered, slope_variance_disc, slope_variance_map


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
