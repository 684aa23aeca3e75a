"""Combination of a scene and a shading: the lights in the order in which programs loop over them,
and each part's specular terms for the part's range of m. The renderer, the reference and
``pricing`` use the same result.

m is the first of these values that exists: the constant m of a light's term (``Term.m``), then
(roughness factor times roughness map)^2, then ``Material.m``. ``prepare.simplify`` replaces the
material's m if the shading's term has a constant m. ``Term.slope`` resolves m for a term, and
``scenes.mesh.base_slope`` for a part. No OpenGL here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from facerender.drawing.prepare import simplify
from facerender.scenes.light import LIGHT_KINDS, Light, LightSpace, disc_of, light_space
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part, slope_range
from facerender.scenes.scene import Scene
from facerender.shading import Shading, Term
from facerender.terms.slope_variance import (
    slope_filtered,
    slope_variance_disc,
    slope_variance_map,
)


@dataclass(frozen=True)
class LightGroup:
    """Lights of one kind that share a specular term.

    Attributes
    ----------
    kind : see ``scenes.light.LIGHT_KINDS``
    term : index of the specular term in ``Lighting.terms``, -1 for none
    count : number of lights, at least one
    shadows : index of the shadow map of the group's first light; None for lights without shadows
    """

    kind: str
    term: int
    count: int
    shadows: int | None = None


@dataclass(frozen=True)
class Lighting:
    """The lights of a scene in the order in which programs loop over them.

    Lights are sorted by kind. Lights of one kind are sorted by term (lights without a term last),
    and lights of one term by shadow (lights without shadows first).

    Attributes
    ----------
    order : for each sorted light, its index in the scene
    lights : the sorted lights
    groups : groups of the sorted lights
    terms : specular terms; ``LightGroup.term`` is an index into them
    """

    order: tuple[int, ...]
    lights: tuple[Light, ...]
    groups: tuple[LightGroup, ...]
    terms: tuple[Term, ...]

    @classmethod
    def of(cls, scene: Scene, shading: Shading) -> Lighting:
        """Sort the lights of a scene. If a light uses ``shading.term``, this term gets index 0."""
        light_terms = [shading.of(light) for light in range(len(scene.lights))]
        first = [shading.term] if shading.term in light_terms else []
        terms = tuple(dict.fromkeys([*first, *(term for term in light_terms if term is not None)]))
        sorted_: dict[tuple[str, int, bool], list[int]] = {
            (kind, number, shadow): []
            for kind in sorted(LIGHT_KINDS)
            for number in (*range(len(terms)), -1)
            for shadow in (False, True)
        }
        for index, (light, term) in enumerate(zip(scene.lights, light_terms, strict=True)):
            number = -1 if term is None else terms.index(term)
            sorted_[light.kind.name, number, light.shadow].append(index)
        groups, maps = [], 0
        for (kind, number, shadow), indices in sorted_.items():
            if indices:
                groups.append(LightGroup(kind, number, len(indices), maps if shadow else None))
                maps += len(indices) * shadow
        order = tuple(index for indices in sorted_.values() for index in indices)
        return cls(order, tuple(scene.lights[index] for index in order), tuple(groups), terms)

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
        for name in dict.fromkeys(group.kind for group in self.groups):
            kind = LIGHT_KINDS[name]
            lights = [light for light in self.lights if light.kind is kind]
            arrays |= kind.uniforms(lights, mesh)
        if spaces := self.spaces(mesh):
            arrays["shadow_view"] = np.array([space.matrix for space in spaces])
            arrays["shadow_size"] = np.array(
                [(space.tan_radius, space.top, space.scale) for space in spaces]
            )
        return arrays


@dataclass(frozen=True, eq=False)
class ResolvedPart:
    """A part of a mesh with its specular terms.

    Attributes
    ----------
    part, material : part of the mesh and its material
    smallest_m : lowest m of the part's lobes; terms with a constant m ignore this value
    terms : specular terms of the lights. If m lies outside the domain of a lobe, the term has the
        exact lobe instead. () if specular terms are left out
    """

    part: Part
    material: Material
    smallest_m: float
    terms: tuple[Term, ...]


@dataclass(frozen=True, eq=False)
class ResolvedScene:
    """A simplified scene with its shading and sorted lights; see :func:`resolve`."""

    scene: Scene
    shading: Shading
    lighting: Lighting

    @cached_property
    def slopes(self) -> list[tuple[float, float]]:
        """The smallest and the largest m of each part. Terms with a constant m ignore both values.

        The largest m includes the largest amounts that slope filter and area lights add.

        Raises
        ------
        InputError : a light is too near to the mesh for its radius
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

    def allowed(self, term: Term) -> list[Term]:
        """Return `term` for each part, with the exact lobe if the term's lobe forbids the part's m.

        Raises
        ------
        InputError : m lies outside the lobe's domain, and ``shading.outside`` is "error"
        """
        return [term.for_slopes(*limits, self.shading.outside) for limits in self.slopes]

    def parts(self, specular: bool = True) -> list[ResolvedPart]:
        """Return the parts with their terms. For errors see :meth:`allowed`.

        specular : false to leave out the specular terms and the check of m
        """
        mesh = self.scene.mesh
        smallest = [low for low, _ in self.slopes] if specular else [0.0] * len(mesh.parts)
        by_term = [self.allowed(term) for term in self.lighting.terms * specular]
        return [
            ResolvedPart(part, material, low, tuple(terms[number] for terms in by_term))
            for number, (part, material, low) in enumerate(
                zip(mesh.parts, mesh.materials, smallest, strict=True)
            )
        ]


def resolve(scene: Scene, shading: Shading) -> ResolvedScene:
    """Remove the features of a scene that the shading leaves out, and sort its lights. For errors
    see :func:`facerender.drawing.prepare.simplify`."""
    simple = simplify(scene, shading)
    return ResolvedScene(simple, shading, Lighting.of(simple, shading))
