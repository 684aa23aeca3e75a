"""The shader program of a part: its features, GLSL, attributes and uniforms. The renderer draws
with this program, and ``pricing`` measures the program's cost. No OpenGL here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import LightGroup, Lighting, ResolvedPart, ResolvedScene
from facerender.glsl.library import call, environment_call, prelude, resolve_includes
from facerender.material import PROPERTY_MAPS
from facerender.mesh.mesh import base_slope
from facerender.mesh.part import Part
from facerender.scene.scene import Only
from facerender.scene.shading import Shading, Term
from facerender.scene.view import View

ENVIRONMENT_MAP = "environment_map"
IN_ROW = 256  # vertices or triangles in a row of a texture

_COMMENT = re.compile(r"^ *//[^\n]*", re.MULTILINE)

Uniforms = Mapping[str, Any]


@dataclass(frozen=True)
class Program:
    """A vertex and a fragment shader of the renderer.

    fragment, vertex : file names of the two shaders in ``shaders/host``
    features : macros that enable features, such as "UV", "NORMAL_MAP", "DIFFUSE"
    lights : groups of lights, see :class:`Lighting`; None for a program without lights
    prelude : GLSL before the call: macros and includes of the specular term
    call : GLSL expression of the specular term; "" if no light has one
    environment : GLSL expression of the specular reflection of the environment; "" for none
    """

    fragment: str
    vertex: str = "surface.vert"
    features: tuple[str, ...] = ()
    lights: tuple[LightGroup, ...] | None = None
    prelude: str = ""
    call: str = ""
    environment: str = ""

    def having(self, *features: str) -> Program:
        """Return the program with further features."""
        return replace(self, features=self.features + features)

    def sources(self, version: str) -> dict[str, str]:
        """Return the GLSL of the stages "vert" and "frag" with the line ``#version VERSION``."""
        head = "".join(f"#define {name}\n" for name in self.features)
        head += f"#define ENVIRONMENT_RADIANCE {self.environment}\n" * bool(self.environment)
        light = "" if self.lights is None else self._term() + self._lights()
        stages = {}
        for stage, code, file in (("vert", "", self.vertex), ("frag", light, self.fragment)):
            text = resolve_includes(f'#version {version}\n{head}{code}#include "host/{file}"\n')
            stages[stage] = _COMMENT.sub("", text)  # comments are half of the text to compile
        return stages

    def _term(self) -> str:
        if not self.call:
            return ""
        slopes = "float m, float f0"
        if "TWO_LOBES" in self.features:
            slopes = "float m, float second_m, float lobe_weight, float f0"
        return (
            f"{self.prelude}#define SPECULAR\n"
            f"float specular_term(vec3 n, vec3 l, vec3 v, {slopes}) {{\n"
            f"    return {self.call};\n}}\n"
        )

    def _lights(self) -> str:
        counts: dict[str, int] = {}
        doubts, added = [], []
        for group in self.lights or ():
            first = counts.get(group.kind, 0)
            counts[group.kind] = first + group.count
            loop = f"for (int i = {first}; i < {counts[group.kind]}; ++i) "
            light = f"{group.kind}_light(i, s.position)"
            if group.shadows is not None:
                number = f"i + {group.shadows - first}"
                doubts.append(
                    f"{loop}if (in_doubt({light}, {number}, s, p)) doubts |= 1 << {number};"
                )
                light = f"shadowed({light}, seen[{number}])"
            added.append(f"{loop}add_light(s, v, {light}, {str(group.specular).lower()});")
        kinds = [
            f'#define {kind.upper()}_LIGHTS {count}\n#include "host/light/{kind}.glsl"'
            for kind, count in counts.items()
        ]
        macros = f"#define EVERY_SHADOW {' '.join(doubts)}\n#define EVERY_LIGHT {' '.join(added)}\n"
        return "\n".join([*kinds, macros])


def surface_features(resolved: ResolvedPart, shading: Shading) -> tuple[str, ...]:
    """Return the feature macros for a part's geometry and material, without macros for lights."""
    part, material, alpha = resolved.part, resolved.material, resolved.alpha
    names = [name for name, _, _ in resolved.maps if name != "opacity_map" or alpha != "opaque"]
    second = [name for name in names if material.by_second(name)]
    packed = [name for name in PROPERTY_MAPS if getattr(material, name) is not None]
    packed = packed if "property_map" in names else []
    occlusion = "occlusion_map" in (*names, *packed)
    features = {
        "slope_filter": any(kind == "normal" for _, _, kind in resolved.maps),
        "constant_slope": shading.term.m is not None,
        "uv": part.uv is not None,
        **dict.fromkeys(packed, True),
        "properties_apart": not {*PROPERTY_MAPS}.isdisjoint(names),
        "vertex_occlusion": part.occlusion is not None,
        "vertex_colors": part.colors is not None,
        "albedo_factor": material.albedo != (1.0, 1.0, 1.0),
        "two_lobes": material.two_lobes,
        "normal_strength": "normal_map" in names and material.normal_strength != 1.0,
        "occlusion_strength": occlusion and material.occlusion_strength != 1.0,
        f"alpha_{alpha}": alpha != "opaque",
        "opacity_cut": alpha == "blend" and material.alpha == "mask",
        "transmission": material.thin,
        "uv2": bool(second),
    }
    names += [name for name, is_used in features.items() if is_used]
    return (*map(str.upper, names), *(f"{name.upper()}_UV uv2" for name in second))


def shade_program(
    resolved: ResolvedScene,
    part: ResolvedPart,
    term: Term | None,
    smallest_m: float,
    only: Only | None = None,
) -> Program:
    """Return the program that shades a part of a scene.

    term : specular term of the lights; None to leave it out
    smallest_m : lowest m of the part's lobes; a term with a constant m ignores this value
    only : term to draw, "specular" or "diffuse"; None for the whole image
    """
    scene, look, material = resolved.scene, resolved.appearance, part.material
    shading, lighting = look.shading, look.lighting
    features = surface_features(part, shading) + shadow_features(lighting)
    features += ("AMBIENT",) * any(scene.ambient)  # type: ignore[arg-type]
    features += ("DIFFUSE",) * (only != "specular" and material.diffuse_weight > 0.0)
    if shading.diffuse == "coupled" and "DIFFUSE" in features and material.ks > 0.0:
        features += ("COUPLED",)
    features += ("EMISSIVE",) * (only is None and any(material.emissive))
    second = material.second_slope if material.two_lobes else None
    environment = ""
    if scene.environment is not None:
        features += ("ENVIRONMENT",)
        if shading.environment_samples and material.ks > 0.0 and only != "diffuse":
            features += (f"ENVIRONMENT_SAMPLES {shading.environment_samples}",)
            environment = environment_call(shading.term, second)
    program = Program(
        "shade.frag", features=features, lights=lighting.groups, environment=environment
    )
    if term is None or not material.ks:
        return program
    head = prelude(term, smallest_m, material.two_lobes)
    return replace(program, prelude=head, call=call(term, second))


def shadow_features(lighting: Lighting) -> tuple[str, ...]:
    """Return the feature macros for lights that cast shadows."""
    shadowed = [light for light in lighting.lights if light.shadow]
    if not shadowed:
        return ()
    discs = ("SHADOW_DISCS",) * any(light.radius for light in shadowed)
    points = ("SHADOW_POINTS",) * any(light.position is not None for light in shadowed)
    return (f"SHADOWS {len(shadowed)}", *discs, *points)


def scene_uniforms(resolved: ResolvedScene, view: View, lights: bool = True) -> Uniforms:
    """Return the uniforms that all parts of a scene share.

    lights : whether to include the uniforms of the lights and the environment
    """
    scene = resolved.scene
    uniforms: dict[str, Any] = {
        "view_projection": view.matrix,
        "camera_position": view.position,
        "ambient": np.asarray(scene.ambient),
    }
    if not lights:
        return uniforms
    if environment := scene.environment:
        uniforms["environment_sh"] = environment.panorama.coefficients
        uniforms["environment_turn"] = environment.turn.T  # OpenGL stores matrices by column
        uniforms["environment_scale"] = environment.scale
        uniforms["environment_size"] = len(environment.panorama.map) - 2
    return uniforms | resolved.appearance.light_uniforms


def part_uniforms(resolved: ResolvedPart) -> Uniforms:
    """Return the uniforms of a part."""
    material = resolved.material
    return {
        "albedo_factor": np.asarray(material.albedo),
        "slope": base_slope(resolved.part, material),
        "specular_weight": material.ks,
        "second_slope": material.second_slope,
        "lobe_weight": material.lobe_weight,
        "diffuse_brdf": material.diffuse_weight / np.pi,
        "f0": material.f0,
        "normal_strength": material.normal_strength,
        "occlusion_strength": material.occlusion_strength,
        "opacity": 1.0 if material.alpha == "opaque" else material.opacity,
        "transmission": material.transmission,
        "refraction": material.refraction,
        "alpha_cutoff": material.alpha_cutoff,
        "emissive": np.asarray(material.emissive),
    }


def fixed_attributes(part: Part, uv2: bool = True) -> dict[str, NDArray[np.floating[Any]]]:
    """Return the vertex attributes that all poses of a part share, (N, width) each, keyed by
    name; without the second texture coordinates if `uv2` is false."""
    columns = {
        "in_uv": part.uv,
        "in_occlusion": None if part.occlusion is None else part.occlusion[:, None],
        "in_color": part.colors,
        "in_uv2": part.uv2 if uv2 else None,
    }
    return {name: column for name, column in columns.items() if column is not None}


def table_attributes(part: Part) -> NDArray[np.float32]:
    """Return the fixed attributes in a part's triangle table as texels of three channels,
    (N, texels, 3). Deferred shading supports one set of texture coordinates."""
    columns = fixed_attributes(part, uv2=False).values()
    values = np.hstack([np.empty((len(part.positions), 0)), *columns])
    texels = max(-(-values.shape[1] // 3), 1)
    padded = np.zeros((len(values), 3 * texels), dtype=np.float32)
    padded[:, : values.shape[1]] = values
    return padded.reshape(-1, texels, 3)


def table_texels(part: Part) -> int:
    """Return the number of texels per triangle in the triangle table of a part: plane, normal,
    fixed attributes and tangent plane."""
    return 5 + sum(int(c.shape[1]) for c in fixed_attributes(part, uv2=False).values())


def table_features(part: Part) -> tuple[str, ...]:
    """Return the macros that describe the triangle table of a part; see
    ``shaders/host/triangle_table.frag``."""
    return f"TRIANGLES_IN_ROW {IN_ROW}", f"TRIANGLE_TEXELS {table_texels(part)}"
