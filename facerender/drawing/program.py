"""Programs, draws, passes and render targets as values. They depend on the appearance of a scene
and on the settings of a frame, but not on camera and pose: ``compiled`` draws them for each view.

The program of a part follows from its features: macros that enable code of the shaders in
``shaders/host``. The renderer draws with it, and ``pricing`` measures its cost. No OpenGL here."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from facerender.drawing.prepare import Appearance, LightGroup, Lighting, ResolvedPart
from facerender.glsl.library import call, environment_call, prelude, resolve_includes
from facerender.material import PROPERTY_MAPS
from facerender.mesh.part import Area, Part
from facerender.scene.scene import Only
from facerender.scene.shading import Shading, Term
from facerender.values.vectors import Integers, Size

ENVIRONMENT_MAP = "environment_map"
IN_ROW = 256  # vertices or triangles in a row of a texture
TABLE_TEXELS = 5  # of a triangle in a table: plane, normal and tangent plane; attributes follow

# Bounds in the image of a view: of the draw's part, of all blended parts, or of all other parts.
Bounds = Literal["part", "blended", "opaque"]
# Triangles of a view: all that can face the camera; or all triangles, back to front.
Order = Literal["facing", "sorted"]

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

    def sources(self, version: str) -> dict[str, str]:
        """Return the GLSL of the stages "vert" and "frag" with the line ``#version VERSION``."""
        head = "".join(f"#define {name}\n" for name in self.features)
        head += f"#define ENVIRONMENT_RADIANCE {self.environment}\n" * bool(self.environment)
        light = ""
        if self.lights is not None:
            lobes = "float second_m, float lobe_weight, " * ("TWO_LOBES" in self.features)
            term = (
                f"{self.prelude}#define SPECULAR\n"
                f"float specular_term(vec3 n, vec3 l, vec3 v, float m, {lobes}float f0) {{\n"
                f"    return {self.call};\n}}\n"
            )
            light = term * bool(self.call) + _lights(self.lights)
        stages = {}
        for stage, code, file in (("vert", "", self.vertex), ("frag", light, self.fragment)):
            text = resolve_includes(f'#version {version}\n{head}{code}#include "host/{file}"\n')
            stages[stage] = _COMMENT.sub("", text)  # comments are half of the text to compile
        return stages


def _lights(groups: Sequence[LightGroup]) -> str:
    """Return the includes of kinds of lights, and the loops over groups of lights."""
    counts: Counter[str] = Counter()
    doubts, added, weighed = "", "", ""
    for group in groups:
        name, first = group.kind, counts[group.kind]
        counts[name] += group.count
        loop = f"for (int i = {first}; i < {counts[name]}; ++i) "
        light = f"{name}_light(i, s.position)"
        if group.shadows is not None:
            index = f"i + {group.shadows - first}"
            doubts += f" {loop}if (in_doubt({light}, {index}, s, p)) doubts |= 1 << {index};"
            light = f"shadowed({light}, seen[{index}])"
        added += f" {loop}add_light(s, v, {light}, {str(group.specular).lower()});"
        if group.environment:
            light = f"{name}_light(i, s.position)"
            weighed += f" {loop}add_fractions(s, {light}, i - {first}, seen[{index}]);"
    includes = "".join(
        f'#define {name.upper()}_LIGHTS {count}\n#include "host/light/{name}.glsl"\n'
        for name, count in counts.items()
    )
    loops = {"SHADOW": doubts, "LIGHT": added, "FRACTION": weighed}
    return includes + "".join(f"#define EVERY_{name}{loop}\n" for name, loop in loops.items())


@dataclass(frozen=True)
class Target:
    """The render target of a pass: a framebuffer with float32 images.

    channels : number of channels of each colour image
    samples : samples per pixel
    size : width and height in pixels; None for the size of the frame
    sampled : whether later passes read the images as textures
    number : number that distinguishes targets with otherwise equal attributes
    resolved : whether later passes read one value per pixel of colours with several samples
    depth_of : target whose depth buffer this target shares and does not clear; None for none
    """

    channels: tuple[int, ...] = (4,)
    samples: int = 1
    size: Size | None = None
    sampled: bool = False
    number: int = 0
    resolved: bool = True
    depth_of: Target | None = None


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw call: a part with its program. Without a part, one triangle covers the target.

    area : rectangle to draw; None for the whole target
    depth : the depth test, and the buffers that the draw writes:

        - "test": fragments that are not behind the stored depth write colour and depth
        - "hide": fragments that are not behind the stored depth write depth only
        - "blend": fragments that are not behind the stored depth are blended over the image
        - "mark": one triangle over the area writes depth only, without a test
        - "marked": one triangle over the area writes colour where the previous "mark" draw wrote
          the same depth. The draw's program reads the triangle table of the part
        - "visible": like "marked" without marks, for cheap programs, which discard other pixels
    order : indices (F,) of the part's triangles in drawing order, or the name of the order; None
        for the order of the part. Consecutive "sorted" draws are drawn back to front
    double_sided : false to draw only front faces
    """

    program: Program
    uniforms: Uniforms
    part: ResolvedPart | None = None
    area: Area | Bounds | None = None
    depth: Literal["test", "hide", "blend", "mark", "marked", "visible"] = "test"
    order: Integers | Order | None = None
    double_sided: bool | None = True

    @classmethod
    def of_part(cls, program: Program, part: ResolvedPart, /, **uniforms: Any) -> Draw:
        """Return the draw of a part, with the uniforms of the part and further uniforms."""
        values = {**part_uniforms(part), **uniforms}
        return cls(program, values, part, double_sided=part.material.double_sided)

    def having(self, *features: str, **uniforms: Any) -> Draw:
        """Return the draw with further features of its program, and with further uniforms."""
        program = replace(self.program, features=self.program.features + features)
        return replace(self, program=program, uniforms={**self.uniforms, **uniforms})

    def depth_only(self) -> Draw:
        """Return a draw that writes only the depth of the part."""
        program = Program("depth.frag", features=_of_alpha_mask(self.program.features))
        return replace(self, program=program, depth="hide")


@dataclass(frozen=True, eq=False)
class Pass:
    """A list of draws into one target.

    name : uniform name under which later passes read the first image of the target
    others : uniform names of the further images of the target
    results : indices of the images that the frame returns
    area : rectangle to clear, as in :class:`Draw`; None for the whole target
    clear : initial linear RGB and coverage of all pixels. None: the pass draws over the target
    uniforms : uniforms of all draws. The compiled frame adds the camera's
    added : whether draws add their colours to the image
    key : value of everything except the pose that the image depends on. The pass is skipped if the
        target already holds an image of this pose with an equal key. None: it is always drawn
    """

    name: str
    target: Target
    draws: tuple[Draw, ...]
    clear: tuple[float, float, float, float] | None = (0.0, 0.0, 0.0, 0.0)
    uniforms: Uniforms = field(default_factory=dict)
    added: bool = False
    key: Hashable = None
    others: tuple[str, ...] = ()
    results: tuple[int, ...] = ()
    area: Area | Bounds | None = None


def surface_features(resolved: ResolvedPart, shading: Shading) -> tuple[str, ...]:
    """Return the feature macros for a part's geometry and material, without macros for lights."""
    part, material, alpha = resolved.part, resolved.material, resolved.alpha
    names = [name for name, _, _ in resolved.maps if name != "opacity_map" or alpha != "opaque"]
    second = [name for name in names if name in resolved.second]
    packed = [name for name in PROPERTY_MAPS if getattr(material, name) is not None]
    packed = packed if "property_map" in names else []
    occlusion = "occlusion_map" in (*names, *packed)
    features = {
        "slope_filter": any(mip_kind == "normal" for *_, mip_kind in resolved.maps),
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
        "unlit": material.unlit,
        "uv2": bool(second),
    }
    names += [name for name, is_used in features.items() if is_used]
    return (*map(str.upper, names), *(f"{name.upper()}_UV uv2" for name in second))


def mask_features(part: ResolvedPart) -> tuple[str, ...]:
    """Return only the features that a part's alpha mask needs; () without a mask."""
    return _of_alpha_mask(surface_features(part, Shading()))


def _of_alpha_mask(features: Sequence[str]) -> tuple[str, ...]:
    prefixes = "UV", "OPACITY", "ALPHA", "TO_COVERAGE"
    masked = "ALPHA_MASK" in features
    return tuple(name for name in features if name.startswith(prefixes)) if masked else ()


def shade_draw(
    look: Appearance,
    part: ResolvedPart,
    term: Term | None,
    smallest_m: float,
    only: Only | None = None,
    further: tuple[str, ...] = (),
    /,
    **uniforms: Any,
) -> Draw:
    """Return the draw that shades a part of an appearance.

    term : specular term of the lights; None to leave it out
    smallest_m : lowest m of the part's lobes; a term with a constant m ignores this value
    only : term to draw, "specular" or "diffuse"; None for the whole image
    further : further features of the program
    uniforms : further uniforms
    """
    material, shading, lighting = part.material, look.shading, look.lighting
    groups = () if material.unlit else lighting.groups
    features = surface_features(part, shading) + shadow_features(lighting) * bool(groups)
    features += ("AMBIENT",) * any(look.ambient)  # type: ignore[arg-type]
    if only != "specular" and material.diffuse_weight > 0.0:
        features += "DIFFUSE", *("COUPLED",) * (shading.diffuse == "coupled" and material.ks > 0.0)
    features += ("EMISSIVE",) * (only is None and any(material.emission))
    two_lobes, environment = "TWO_LOBES" in features, ""
    second = material.second_slope if two_lobes else None
    if look.environment is not None and not material.unlit:
        count = len(lighting.environment)
        features += ("ENVIRONMENT", *(f"ENVIRONMENT_LIGHTS {count}",) * bool(count))
        if shading.environment_samples and material.ks > 0.0 and only != "diffuse":
            features += (f"ENVIRONMENT_SAMPLES {shading.environment_samples}",)
            environment = environment_call(shading.term, second)
    head = expression = ""
    if term is not None and groups and material.ks:
        head, expression = prelude(term, smallest_m, two_lobes), call(term, second)
    code = head, expression, environment
    program = Program("shade.frag", "surface.vert", features + further, groups, *code)
    return Draw.of_part(program, part, **uniforms)


def shadow_features(lighting: Lighting) -> tuple[str, ...]:
    """Return the feature macros for lights that cast shadows."""
    shadowed = [light for light in lighting.lights if light.shadow]
    if not shadowed:
        return ()
    discs = ("SHADOW_DISCS",) * any(light.radius for light in shadowed)
    points = ("SHADOW_POINTS",) * any(light.position is not None for light in shadowed)
    return (f"SHADOWS {len(shadowed)}", *discs, *points)


def part_uniforms(resolved: ResolvedPart) -> Uniforms:
    """Return the uniforms of a part."""
    material = resolved.material
    factors = (
        *("second_slope", "lobe_weight", "f0", "normal_strength", "occlusion_strength"),
        *("transmission", "refraction", "alpha_cutoff"),
    )
    return {
        **{name: getattr(material, name) for name in factors},
        "albedo_factor": np.asarray(material.albedo),
        "slope": resolved.slope,
        "specular_weight": material.ks,
        "diffuse_brdf": material.diffuse_weight / np.pi,
        "opacity": 1.0 if material.alpha == "opaque" else material.opacity,
        "emissive": np.asarray(material.emission),
    }


def fixed_attributes(part: Part, uv2: bool = True) -> dict[str, NDArray[np.floating[Any]]]:
    """Return the vertex attributes that all poses of a part share, (N, width) each, keyed by
    name; without the second texture coordinates if `uv2` is false."""
    occlusion = None if part.occlusion is None else part.occlusion[:, None]
    columns = {"in_uv": part.uv, "in_occlusion": occlusion, "in_color": part.colors}
    columns["in_uv2"] = part.uv2 if uv2 else None
    return {name: column for name, column in columns.items() if column is not None}


def table_features(part: Part) -> tuple[str, ...]:
    """Return the macros that describe the triangle table of a part; see
    ``shaders/host/triangle_table.frag``."""
    widths = (column.shape[1] for column in fixed_attributes(part, uv2=False).values())
    return f"TRIANGLES_IN_ROW {IN_ROW}", f"TRIANGLE_TEXELS {TABLE_TEXELS + sum(widths)}"
