"""Price of a shading per fragment, as a sum of the prices of its parts.

The parts are the renderer's program, its maps and lights, the specular term of the first light, and
the term of each further light, which shares values with the first. ``by_slope`` measures all parts
except the specular terms on this machine, in the programs that ``samples`` returns."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from PIL import Image

from facerender.drawing.compiled import CompiledFrame, sized
from facerender.drawing.context import Context, create_context
from facerender.drawing.maps import Maps
from facerender.drawing.prepare import Appearance, Lighting, resolve
from facerender.drawing.program import Draw, Pass, Program, Target, shade_draw
from facerender.drawing.resources import CompiledProgram, Resources
from facerender.errors import InputError, check_known
from facerender.glsl.library import call, prelude
from facerender.material import PROPERTY_MAPS, Material
from facerender.mesh.geometry import Geometry
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Area, Part
from facerender.pricing import cost
from facerender.pricing.cost import INPUTS, SIZE, SLOPE, Interval, Run, clock, slopes
from facerender.scene.environment import Environment, studio
from facerender.scene.light import LIGHT_KINDS
from facerender.scene.scene import Scene
from facerender.scene.shading import Shading, Term
from facerender.scene.view import View
from facerender.terms.lobe import lobe_entry
from facerender.texture.texture import Texture

FEW = 2  # environment samples; compilers unroll a loop over two samples
LIGHTS = tuple(LIGHT_KINDS[name].price for name in sorted(LIGHT_KINDS))
SHADOWS = tuple(sorted({light_type.shadow_price for light_type in LIGHT_KINDS.values()}))

# A triangle that fills the target, with normals of a curved surface and 1.5 texels per pixel. It
# is clockwise, since the renderer draws images upside down and culls accordingly.
_PATCH = Part(
    positions=np.array([(-1.0, -1.0, 0.1), (-1.0, 3.0, -0.2), (3.0, -1.0, 0.2)]),
    normals=np.array([(-0.5, -0.4, 1.0), (-0.4, 0.6, 1.0), (0.7, -0.3, 1.0)]),
    faces=np.arange(3, dtype=np.uint32)[None],
    uv=np.array([(0.0, 0.0), (0.0, 3 * SIZE[1] / 1024), (3 * SIZE[0] / 1024, 0.0)]),
)
_EMPTY = "#version 330 core\nout vec4 radiance;\nvoid main() { radiance = vec4(0.5); }\n"
_VIEW = View(np.array([0.2, 0.1, 3.0]), np.array([0.0, 0.0, -1.0]), np.eye(4))


def scene_with(
    maps: Sequence[str] = ("albedo_map",),
    ambient: bool = False,
    shadow: bool = False,
    environment: bool = False,
    **lights: int,
) -> Scene:
    """Return a scene with one triangle that fills the image, and maps of 1024 x 1024 texels.
    ``lights`` are the numbers of lights, keyed by type; default: one directional light."""
    textures: dict[str, Any] = {name: _texture(name) for name in maps}
    material = Material((1.0, 1.0, 1.0), 0.4, ks=0.3, kd=0.7, **textures)
    corners = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    mesh = Mesh(Geometry("patch", (_PATCH,), corners, 1.0, np.ones((1, 2))), (material,))
    counts = lights or {"directional": 1}
    examples = [LIGHT_KINDS[name].example for name, n in counts.items() for _ in range(n)]
    return Scene(
        mesh,
        lights=tuple(replace(light, shadow=shadow) for light in examples),
        ambient=(0.2, 0.3, 0.4) if ambient else 0.0,
        environment=Environment(studio()) if environment else None,
    )


def program_of(
    scene: Scene,
    shading: Shading | None = None,
    stub: str = "",
    coupled: bool = False,
    environment_samples: int = 0,
) -> Program:
    """Return the renderer's program for the first mesh part of a scene, valid for m >= SLOPE.

    shading : shading of the scene; None: ``stub`` replaces the specular terms of the lights
    stub : GLSL that replaces the specular terms if ``shading`` is None; "": no specular terms
    """
    chosen = (shading or Shading()).replace(
        environment_samples=environment_samples, environment_lights=0
    )
    chosen = chosen.replace(diffuse="coupled") if coupled else chosen
    look = Appearance.of(scene, chosen, "color")  # with the features that the shading leaves out
    draw = shade_draw(look, look.parts[0], shading.term if shading else None, SLOPE)
    return replace(draw.program, call=stub) if stub else draw.program


@cache
def _texture(name: str) -> Texture:
    def noise() -> Image.Image:
        random = np.random.default_rng(len(name))
        return Image.fromarray(random.integers(100, 156, (1024, 1024, 3), dtype=np.uint8))

    return Texture(noise, name)


def parts_of(program: Program) -> dict[str, int]:
    """Return how many times a program contains each priced part."""
    groups, has = program.lights or (), {*program.features}
    specular = sum(group.count for group in groups if group.specular) if program.call else 0
    prefix = "ENVIRONMENT_SAMPLES "
    samples_of_lobe = sum(int(f.removeprefix(prefix)) for f in has if f.startswith(prefix))
    counts: Counter[str] = Counter()
    for group in groups:
        light_type = LIGHT_KINDS[group.kind]
        counts[light_type.price] += group.count
        counts[light_type.shadow_price] += group.count * (group.shadows is not None)
    diffuse, coupled = "DIFFUSE" in has, "COUPLED" in has
    ambient = diffuse and "AMBIENT" in has
    shines = bool(specular or program.environment or coupled)
    dims = ambient or (diffuse and "ENVIRONMENT" in has)
    read = {"OCCLUSION_MAP"} if dims else set()
    read |= {"ROUGHNESS_MAP", "SPECULAR_MAP"} if shines else set()
    return {
        "base program": 1,
        "albedo map": int((diffuse or "UNLIT" in has) and "ALBEDO_MAP" in has),
        "normal map": int("NORMAL_MAP" in has),
        "property map": bool(has & read) + (shines and "LOBE_MAP" in has),
        "ambient term": int(ambient),
        **{price: counts[price] for price in (*LIGHTS, *SHADOWS)},
        "coupled diffuse": int(coupled),
        "light of coupled diffuse": sum(group.count for group in groups) * coupled,
        "environment": int("ENVIRONMENT" in has),
        "environment sample": program.environment.count("environment_map") * samples_of_lobe,
        # Further specular terms share values with the first one.
        "first specular term": min(specular, 1),
        "further specular term": max(specular - 1, 0),
    }


def samples(shading: Shading | None = None) -> list[tuple[Scene, Program]]:
    """Return one scene and program per part; the programs' costs determine the parts' costs.

    shading : shading with the programs' specular terms. With None, programs evaluate ``INPUTS``
        instead, which keeps the inputs of a specular term alive. Then the cost of a specular part
        excludes the term, whose net cost must be added. For several terms, this overestimates
        the cost by the work that the terms share
    """
    # Property maps need a specular and an ambient term, which read them. Other maps need an albedo
    # map, whose cost includes the interpolation of the texture coordinates.
    albedo = ("albedo_map",)
    lights: list[dict[str, Any]] = [{name: 1} for name in LIGHT_KINDS if name != "directional"]
    dull = [
        scene_with(),
        scene_with(directional=2),
        *(scene_with(directional=1, **light) for light in lights),
        scene_with(shadow=True),
        scene_with(shadow=True, disc=1),
    ]
    specular = [
        scene_with(),
        scene_with(directional=2),
        scene_with(()),
        scene_with((*albedo, "normal_map")),
        scene_with(ambient=True),
        scene_with((*albedo, *PROPERTY_MAPS), ambient=True),
    ]
    around = scene_with(environment=True)
    return [
        *((scene, program_of(scene)) for scene in dull),
        *((scene, program_of(scene, coupled=True)) for scene in dull[:2]),
        *((around, program_of(around, environment_samples=count)) for count in (0, FEW)),
        *((scene, program_of(scene, shading, "" if shading else INPUTS)) for scene in specular),
    ]


# The names of the parts, and the matrix that converts costs of sample programs to part costs.
PARTS = tuple(parts_of(program_of(scene_with())))
TO_PARTS = np.linalg.inv([list(parts_of(program).values()) for _, program in samples()])


def by_slope(repeats: int = 15) -> dict[str, Interval]:
    """Measure the nanoseconds per fragment of each part on this machine. Every program fills the
    target n times, for three values of n, as in ``cost.by_slope``. The cost of blending and of the
    rasteriser is measured with an empty program and subtracted."""
    net = np.column_stack([TO_PARTS, -TO_PARTS.sum(axis=1)])
    context = create_context()
    try:
        with context.drawing() as gl:
            resources, pairs = Resources(context), samples()
            programs = [resources.program(source) for _, source in pairs]
            empty = gl.program(pairs[0][1].sources("330 core")["vert"], _EMPTY)
            programs.append(CompiledProgram.of(empty))
            runs = [
                _timed(context, resources, scene, source, program)
                for (scene, source), program in zip([*pairs, pairs[0]], programs, strict=True)
            ]
            intervals = slopes(runs, 2, 1e9 / (SIZE[0] * SIZE[1]) * net, repeats)
            resources.release()
    finally:
        context.release()
    return dict(zip(PARTS, intervals, strict=True))


def _timed(
    context: Context, resources: Resources, scene: Scene, source: Program, program: CompiledProgram
) -> Run:
    """Return a function that draws a scene of one mesh part N times and returns the seconds; the
    scene needs the program ``source``, and ``program`` is timed."""
    look, mesh = Appearance.of(scene, Shading(), "color"), scene.mesh
    (part,) = look.parts
    maps = Maps(look, mesh, _VIEW, (1024, 1024))
    inputs: dict[str, Any] = {}
    if passes := maps.passes():
        CompiledFrame(resources, passes, SIZE).draw(_VIEW, mesh)
    for step in passes:
        framebuffer = resources.targets[sized(step.target, SIZE)].framebuffer
        inputs[step.name] = framebuffer.color_attachments[0]
    draw = replace(Draw.of_part(source, part), area=Area(0, 0, 1, 1))
    step = Pass("", Target(), (draw,), uniforms=maps.uniforms)
    panorama = scene.environment.panorama if scene.environment else None
    frame = CompiledFrame(resources, [step], SIZE, panorama, inputs)
    frame.draw(_VIEW, mesh)
    framebuffer = resources.targets[sized(step.target, SIZE)].framebuffer
    array = resources.parts[part.part].array(program)
    if matrix := program.uniforms.get("view_projection"):
        matrix.write(_VIEW.matrix.astype("f4"))
    gl = context.gl

    def seconds(count: int) -> float:
        # The drawing of one pixel sets the target, the uniforms and the textures. The timed draw
        # then repeats its last call, since a whole frame would be timed with its state changes.
        frame.draw(_VIEW, mesh)
        framebuffer.viewport = 0, 0, *SIZE
        gl.enable_only(moderngl.BLEND)  # else drivers skip fragments that later ones cover
        gl.blend_func = moderngl.ONE, moderngl.ONE
        with clock(context) as elapsed:
            array.render(instances=count)
        return elapsed[0]

    return seconds


TABLE = Path(__file__).with_name("prices.json")
FRAME = "frame"  # prices whole frames; see ``planning/search.py``
HERE = "here"

Pair = tuple[float, float]
Terms = Mapping[str, Pair]


class NoPrice(InputError):
    """The prices lack a term, or another part such as a kind of light."""


@dataclass(frozen=True)
class Prices:
    """Prices of one driver or GPU."""

    source: str  # origin of the prices, as text
    unit: str  # of all prices
    # Prices of the fragment program without the specular terms, and of subsurface scattering.
    parts: Mapping[str, float]
    # Two prices of each specular term, keyed by :func:`term_name`: the price for the first light
    # with a specular term, and the price for each further light. The same two prices of each second
    # lobe, keyed by :func:`second_name`.
    terms: Terms

    def cost(self, scene: Scene, shading: Shading) -> tuple[float, float]:
        """Return the cost of a fragment of the scene, and the specular part of this cost: with
        several mesh parts, their means weighted by the parts' numbers of faces."""
        look = resolve(scene, shading).appearance
        total = specular = faces = 0.0
        for part, (smallest, _) in zip(look.parts, look.slopes, strict=True):
            material, count = part.material, len(part.part.faces)
            lights = look.lighting.shining * bool(material.ks and not material.unlit)
            program = shade_draw(look, part, None, smallest).program
            counts = parts_of(replace(program, call=INPUTS * bool(lights)))
            if material.scattering and material.diffuse_weight > 0.0:
                counts |= {"scattering": 1, "sample of scattering": shading.scatter_samples}
            others = without_specular(counts).items()
            costs = {name: n * self._priced(self.parts, name) for name, n in others if n}
            names = [term_name(shading.term, smallest)]
            names += [second_name(shading.term, smallest)] * material.two_lobes
            pairs = [self._priced(self.terms, name) for name in names * bool(lights)]
            shine = sum(sum([first, *[further] * (lights - 1)]) for first, further in pairs)
            faces += count
            total += count * (sum(costs.values()) + shine)
            specular += count * (shine + costs.get("environment sample", 0.0))
        return total / faces, specular / faces

    def _priced(self, prices: Mapping[str, Any], name: str) -> Any:
        if name not in prices:
            update = "update the table in a checkout with python -m benchmarks.prices table"
            problem = f"{name} has no price in {self.source}"
            raise NoPrice(f"{problem}: measure it with --cost here, or {update}")
        return prices[name]


def load_prices(
    name: str, scene: Scene, shadings: Iterable[Shading], software: bool = False
) -> Prices:
    """Return the prices of a driver or GPU that given shadings of a scene need.

    name : "llvmpipe", "navi21" (RDNA2) or "vega10" (GCN5) from the table; "auto" and "frame" choose
        llvmpipe if the CPU draws, otherwise navi21; "here" measures on this machine, which takes
        up to a minute
    """
    table = shipped()
    if name in (FRAME, "auto"):
        name = "llvmpipe" if software else "navi21"
    if name in table:
        return table[name]
    check_known("cost", name, [FRAME, "auto", *table, HERE])
    terms: dict[str, Term] = {}
    seconds: dict[str, Term] = {}
    two_lobes = any(material.two_lobes for material in scene.mesh.materials)
    for shading in shadings:
        if Lighting(scene, shading).shining:
            terms |= variants(shading.term)
            if two_lobes and shading.two_lobes:
                seconds |= second_variants(shading.term)
    terms |= {term_name(second, SLOPE): second for second in seconds.values()}
    return measured(terms, seconds=seconds)


def shipped() -> dict[str, Prices]:
    """Return the prices of the table ``prices.json``, keyed by driver or GPU."""
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    return {driver: Prices(**prices) for driver, prices in table.items()}


def term_name(term: Term, smallest_m: float) -> str:
    """Return the key of a specular term in :attr:`Prices.terms`; terms of equal cost share it."""
    lobe = lobe_entry(term.lobe)
    words = [term.model, lobe.price]
    if term.entry.factors:
        words += [term.fresnel, term.masking]
    if lobe.of_tan2 and not term.keeps_small_slopes(smallest_m):
        words.append("plain")
    if term.m is not None:
        words.append("constant")
    return " ".join(words)


def second_name(term: Term, smallest_m: float) -> str:
    """Return the key of a term's second lobe in :attr:`Prices.terms`."""
    # Both lobes share the Fresnel and masking terms, so the key excludes these.
    return f"second lobe of {term_name(_unfactored(term), smallest_m)}"


def _unfactored(term: Term) -> Term:
    return replace(term, fresnel=Term.fresnel, masking=Term.masking)


def variants(term: Term) -> dict[str, Term]:
    """Return variants of a term with and without a constant m, keyed by :func:`term_name`. Variants
    with the exact lobe also differ in ``small_slope``."""
    options = (True, False) if lobe_entry(term.lobe).of_tan2 else (None,)
    terms = [replace(term, m=m, small_slope=option) for m in (None, term.m) for option in options]
    return {term_name(variant, SLOPE): variant for variant in terms}


def second_variants(term: Term) -> dict[str, Term]:
    """Return terms with the second lobes of a term's variants, keyed by :func:`second_name`."""
    return {second_name(other, SLOPE): _unfactored(other) for other in variants(term).values()}


def second_lobes(two: Terms, one: Terms, seconds: Mapping[str, Term]) -> dict[str, Pair]:
    """Return the cost of each second lobe: a term's cost with two lobes minus its cost with one."""
    pairs = {name: (two[name], one[term_name(term, SLOPE)]) for name, term in seconds.items()}
    return {name: (b[0] - a[0], b[1] - a[1]) for name, (b, a) in pairs.items()}


def without_specular(parts: Mapping[str, float]) -> dict[str, float]:
    """Return the costs of the non-specular parts: the terms' prices include the specular parts."""
    return {name: cost for name, cost in parts.items() if name not in _SPECULAR}


def measured(
    terms: Mapping[str, Term], repeats: int = 7, seconds: Mapping[str, Term] | None = None
) -> Prices:
    """Measure the price of every part and every specular term on this machine.

    terms : keyed by :func:`term_name`
    seconds : terms whose second lobes are priced, keyed by :func:`second_name`; ``terms`` also
        contains each of these
    """
    parts = {name: time.value for name, time in by_slope(repeats=repeats).items()}
    calls = {name: (prelude(term, SLOPE), call(term)) for name, term in terms.items()}
    calls |= {
        name: (_LOBES + prelude(term, SLOPE, two_lobes=True), call(term, 1.5))
        for name, term in (seconds or {}).items()
    }
    prices = {
        name: (parts[_SPECULAR[0]] + time.value, parts[_SPECULAR[1]] + time.value)
        for name, time in cost.by_slope(calls, repeats=repeats).items()
    }
    prices |= second_lobes(prices, prices, seconds or {})
    context = create_context()
    context.release()
    source = f"measured on {context.renderer}, OpenGL {context.version}"
    return Prices(source, "ns", without_specular(parts) | cost.by_frames(repeats), prices)


# Macros that replace the uniforms of a second lobe.
_LOBES = "#define second_m (1.5 * m)\n#define lobe_weight (0.5 + f0)\n"
_SPECULAR = ("first specular term", "further specular term")
