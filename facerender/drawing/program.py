"""The host's program of a part, told once: what its GLSL depends on, the GLSL, its attributes and
its uniforms. The renderer draws with it and ``pricing`` prices it. No OpenGL here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from facerender.drawing.prepare import part_maps
from facerender.glsl.code import call, prelude
from facerender.glsl.library import resolve_includes
from facerender.scenes.light import LIGHT_KINDS, Light
from facerender.scenes.material import Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.scene import Scene
from facerender.scenes.view import View
from facerender.shading import Shading, Term

ATTRIBUTES = {"in_position": 3, "in_normal": 3, "in_uv": 2, "in_color": 3}
PROPERTY_MAPS = ("occlusion_map", "roughness_map", "specular_map")

Uniforms = Mapping[str, Any]


@dataclass(frozen=True)
class LightGroup:
    """Lights of one kind that have one term.

    Attributes
    ----------
    kind : see ``scenes.light.LIGHT_KINDS``
    term : number of their specular term, -1 for none
    count : how many there are, at least one
    """

    kind: str
    term: int
    count: int


@dataclass(frozen=True)
class Lighting:
    """The lights of a scene in the order of programs: by kind and then by term, those without one
    last.

    Attributes
    ----------
    lights, groups : in that order
    terms : that the groups number
    """

    lights: tuple[Light, ...]
    groups: tuple[LightGroup, ...]
    terms: tuple[Term, ...]

    @classmethod
    def of(cls, scene: Scene, shading: Shading) -> Lighting:
        """Sort the lights of a scene. If a light has the shading's own term, that is number 0."""
        own = [shading.of(light) for light in range(len(scene.lights))]
        first = [shading.term] if shading.term in own else []
        terms = tuple(dict.fromkeys([*first, *(term for term in own if term is not None)]))
        sorted_: dict[tuple[str, int], list[Light]] = {
            (kind, number): []
            for kind in sorted(LIGHT_KINDS)
            for number in (*range(len(terms)), -1)
        }
        for light, term in zip(scene.lights, own, strict=True):
            number = -1 if term is None else terms.index(term)
            sorted_[light.kind.name, number].append(light)
        groups = [LightGroup(*key, len(lights)) for key, lights in sorted_.items() if lights]
        lights = tuple(light for group in sorted_.values() for light in group)
        return cls(lights, tuple(groups), terms)

    def uniforms(self, mesh: Mesh) -> dict[str, Any]:
        """Return the arrays of every kind of light there is."""
        arrays: dict[str, Any] = {}
        for name in dict.fromkeys(group.kind for group in self.groups):
            kind = LIGHT_KINDS[name]
            lights = [light for light in self.lights if light.kind is kind]
            arrays |= kind.uniforms(lights, mesh)
        return arrays


@dataclass(frozen=True)
class Program:
    """A vertex and a fragment program of the host.

    Attributes
    ----------
    fragment, vertex : names of their files in ``shaders/host``
    features : macros that say what there is, such as "UV", "NORMAL_MAP", "DIFFUSE"
    lights : see :class:`Lighting`; None for a program that knows no light
    prelude, calls : GLSL that stands before the specular terms, and that of each term; without
        calls nothing is specular
    """

    fragment: str
    vertex: str = "surface.vert"
    features: tuple[str, ...] = ()
    lights: tuple[LightGroup, ...] | None = None
    prelude: str = ""
    calls: tuple[str, ...] = ()

    def sources(self, version: str) -> dict[str, str]:
        """Return the GLSL of both stages, "vert" and "frag", for a ``#version``."""
        head = "".join(f"#define {name}\n" for name in self.features)
        light = "" if self.lights is None else self._terms() + self._lights()
        return {
            stage: resolve_includes(f'#version {version}\n{head}{own}#include "host/{file}"\n')
            for stage, own, file in (("vert", "", self.vertex), ("frag", light, self.fragment))
        }

    def _terms(self) -> str:
        if not self.calls:
            return ""
        *branches, last = self.calls
        slopes = "float m, float f0"
        if "TWO_LOBES" in self.features:
            slopes = "float m, float second_m, float lobe_weight, float f0"
        lines = [f"    if (term == {i}) return {each};" for i, each in enumerate(branches)]
        return "\n".join(
            [
                f"{self.prelude}#define SPECULAR",
                f"float specular_term(int term, vec3 n, vec3 l, vec3 v, {slopes}) {{",
                *lines,
                f"    return {last};",
                "}\n",
            ]
        )

    def _lights(self) -> str:
        counts: dict[str, int] = {}
        loops = []
        for group in self.lights or ():
            first = counts.get(group.kind, 0)
            counts[group.kind] = first + group.count
            loops.append(
                f"for (int i = {first}; i < {counts[group.kind]}; ++i) "
                f"add_light(s, v, {group.kind}_light(i, s.position), {group.term});"
            )
        kinds = [
            f'#define {kind.upper()}_LIGHTS {count}\n#include "host/light/{kind}.glsl"'
            for kind, count in counts.items()
        ]
        return "\n".join([*kinds, f"#define ADD_EVERY_LIGHT {' '.join(loops)}\n"])


def surface_features(part: Part, material: Material) -> tuple[str, ...]:
    """Return what a part has without light."""
    names = [name.upper() for name, _, _ in part_maps(part, material, "color")]
    if part.uv is not None:
        names.append("UV")
        names += [name.upper() for name in PROPERTY_MAPS if getattr(material, name) is not None]
    if part.colors is not None:
        names.append("VERTEX_COLORS")
    if material.albedo != (1.0, 1.0, 1.0):
        names.append("ALBEDO_FACTOR")
    if material.two_lobes:
        names.append("TWO_LOBES")
    return tuple(names)


def shade_program(
    part: Part,
    material: Material,
    scene: Scene,
    lighting: Lighting,
    terms: Sequence[Term],
    smallest_m: float,
    diffuse: bool = True,
    coupled: bool = False,
) -> Program:
    """Return the program that shades a part of a simplified scene.

    Parameters
    ----------
    terms : of the lighting, as this part's slopes let them be; none for a program without
    smallest_m : of the part
    diffuse : whether diffuse light counts
    coupled : whether it is what the specular term leaves
    """
    features = surface_features(part, material)
    features += ("AMBIENT",) * any(scene.ambient)  # type: ignore[arg-type]
    features += ("DIFFUSE",) * (diffuse and material.kd > 0.0)
    features += ("COUPLED",) * (coupled and "DIFFUSE" in features and material.ks > 0.0)
    shines = bool(terms) and material.ks > 0.0
    second = material.second_slope if material.two_lobes else None
    return Program(
        "shade.frag",
        features=features,
        lights=lighting.groups,
        prelude=prelude(terms, smallest_m, material.two_lobes) if shines else "",
        calls=tuple(call(term, second) for term in terms) if shines else (),
    )


def scene_uniforms(scene: Scene, view: View, lighting: Lighting | None = None) -> Uniforms:
    """Return the uniforms that all parts of a scene share."""
    return {
        "view_projection": view.matrix,
        "eye": view.eye,
        "ambient": np.asarray(scene.ambient),
        **({} if lighting is None else lighting.uniforms(scene.mesh)),
    }


def part_uniforms(part: Part, material: Material) -> Uniforms:
    """Return the uniforms of a part."""
    mapped = part.uv is not None and material.roughness_map is not None
    return {
        "albedo_factor": np.asarray(material.albedo),
        "slope": material.roughness_factor**2 if mapped else material.m,
        "specular_weight": material.ks,
        "second_slope": material.second_slope,
        "lobe_weight": material.lobe_weight,
        "diffuse_weight": material.kd,
        "f0": material.f0,
    }


def part_columns(part: Part, mesh: Mesh) -> dict[str, np.ndarray[Any, Any]]:
    """Return the attributes of a part that there are, (N, width) each, in the renderer's space."""
    columns = {
        "in_position": mesh.normalised(part.positions),
        "in_normal": part.normals,
        "in_uv": part.uv,
        "in_color": part.colors,
    }
    return {name: values for name, values in columns.items() if values is not None}
