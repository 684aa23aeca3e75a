"""The shader program of a part: its features, GLSL, attributes and uniforms. The renderer draws
with this program, and ``pricing`` measures the program's cost. No OpenGL here."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import Appearance, LightGroup, Lighting, ResolvedPart
from facerender.glsl.library import call, environment_call, prelude, resolve_includes
from facerender.material import PROPERTY_MAPS
from facerender.mesh.mesh import base_slope
from facerender.mesh.part import Part
from facerender.scene.scene import Only
from facerender.scene.shading import Shading, Term

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
        light = "" if self.lights is None else self._term() + self._lights(self.lights)
        stages = {}
        for stage, code, file in (("vert", "", self.vertex), ("frag", light, self.fragment)):
            text = resolve_includes(f'#version {version}\n{head}{code}#include "host/{file}"\n')
            stages[stage] = _COMMENT.sub("", text)  # comments are half of the text to compile
        return stages

    def _term(self) -> str:
        if not self.call:
            return ""
        lobes = "float second_m, float lobe_weight, " * ("TWO_LOBES" in self.features)
        return (
            f"{self.prelude}#define SPECULAR\n"
            f"float specular_term(vec3 n, vec3 l, vec3 v, float m, {lobes}float f0) {{\n"
            f"    return {self.call};\n}}\n"
        )

    def _lights(self, groups: Sequence[LightGroup]) -> str:
        counts: Counter[str] = Counter()
        doubts, added = "", ""
        for group in groups:
            kind, first = group.kind, counts[group.kind]
            counts[kind] += group.count
            loop = f"for (int i = {first}; i < {counts[kind]}; ++i) "
            light = f"{kind}_light(i, s.position)"
            if group.shadows is not None:
                number = f"i + {group.shadows - first}"
                doubts += f" {loop}if (in_doubt({light}, {number}, s, p)) doubts |= 1 << {number};"
                light = f"shadowed({light}, seen[{number}])"
            added += f" {loop}add_light(s, v, {light}, {str(group.specular).lower()});"
        kinds = "".join(
            f'#define {kind.upper()}_LIGHTS {count}\n#include "host/light/{kind}.glsl"\n'
            for kind, count in counts.items()
        )
        return f"{kinds}#define EVERY_SHADOW{doubts}\n#define EVERY_LIGHT{added}\n"


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
    look: Appearance,
    part: ResolvedPart,
    term: Term | None,
    smallest_m: float,
    only: Only | None = None,
) -> Program:
    """Return the program that shades a part of an appearance.

    term : specular term of the lights; None to leave it out
    smallest_m : lowest m of the part's lobes; a term with a constant m ignores this value
    only : term to draw, "specular" or "diffuse"; None for the whole image
    """
    material, shading, lighting = part.material, look.shading, look.lighting
    features = surface_features(part, shading) + shadow_features(lighting)
    features += ("AMBIENT",) * any(look.ambient)  # type: ignore[arg-type]
    features += ("DIFFUSE",) * (only != "specular" and material.diffuse_weight > 0.0)
    if shading.diffuse == "coupled" and "DIFFUSE" in features and material.ks > 0.0:
        features += ("COUPLED",)
    features += ("EMISSIVE",) * (only is None and any(material.emissive))
    second = material.second_slope if material.two_lobes else None
    environment = ""
    if look.environment is not None:
        features += ("ENVIRONMENT",)
        if shading.environment_samples and material.ks > 0.0 and only != "diffuse":
            features += (f"ENVIRONMENT_SAMPLES {shading.environment_samples}",)
            environment = environment_call(shading.term, second)
    head = expression = ""
    if term is not None and material.ks:
        head, expression = prelude(term, smallest_m, material.two_lobes), call(term, second)
    lights = lighting.groups
    return Program("shade.frag", "surface.vert", features, lights, head, expression, environment)


def shadow_features(lighting: Lighting) -> tuple[str, ...]:
    """Return the feature macros for lights that cast shadows."""
    shadowed = [light for light in lighting.lights if light.shadow]
    if not shadowed:
        return ()
    discs = ("SHADOW_DISCS",) * any(light.radius for light in shadowed)
    points = ("SHADOW_POINTS",) * any(light.position is not None for light in shadowed)
    return (f"SHADOWS {len(shadowed)}", *discs, *points)


def light_uniforms(look: Appearance) -> Uniforms:
    """Return the uniforms of the lights, the ambient light and the environment."""
    uniforms: dict[str, Any] = {"ambient": np.asarray(look.ambient)}
    lights = look.lighting.lights
    for kind in dict.fromkeys(light.kind for light in lights):
        uniforms |= kind.uniforms([light for light in lights if light.kind is kind], look.space)
    if spaces := look.light_spaces:
        uniforms["shadow_view"] = np.array([space.matrix for space in spaces])
        uniforms["shadow_size"] = np.array([(s.tan_radius, s.top, s.scale) for s in spaces])
    if environment := look.environment:
        uniforms["environment_sh"] = environment.panorama.coefficients
        uniforms["environment_turn"] = environment.turn.T  # OpenGL stores matrices by column
        uniforms["environment_scale"] = environment.scale
        uniforms["environment_size"] = len(environment.panorama.map) - 2
    return uniforms


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
