"""Costs of all parts of the renderer's fragment program except the specular terms.

``by_slope`` measures these parts on this machine, in the programs that ``samples`` returns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import moderngl
import numpy as np
from PIL import Image

from facerender.drawing.context import Backend, Context, create_context
from facerender.drawing.passes import Draw, Pass, Target
from facerender.drawing.passes.shadow import with_shadows
from facerender.drawing.program import (
    ENVIRONMENT_MAP,
    Program,
    part_uniforms,
    scene_uniforms,
    shade_program,
)
from facerender.drawing.resolve import Lighting, ResolvedScene
from facerender.drawing.resources import Resources, set_uniforms
from facerender.pricing.cost import clock_of, slopes
from facerender.pricing.interval import Interval
from facerender.pricing.variants import INPUTS, SLOPE
from facerender.scenes.environment import Environment, studio
from facerender.scenes.light import LIGHT_KINDS
from facerender.scenes.material import PROPERTY_MAPS, Material
from facerender.scenes.mesh import Mesh, Part
from facerender.scenes.scene import Scene
from facerender.scenes.texture import Texture
from facerender.scenes.view import View
from facerender.shading import Shading

SIZE = (512, 256)
FEW = 2  # environment samples; compilers unroll a loop over two samples
SHADOWS = tuple(sorted({kind.shadow_price for kind in LIGHT_KINDS.values()}))
Timed = Callable[[int], float]  # draws N times and returns the seconds

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

    lights : number of lights, keyed by kind; default: one directional light
    """
    textures: dict[str, Any] = {name: _texture(name) for name in maps}
    material = Material((1.0, 1.0, 1.0), 0.4, ks=0.3, kd=0.7, **textures)
    corners = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    mesh = Mesh("patch", (_PATCH,), (material,), corners, 1.0, np.ones((1, 2)))
    counts = lights or {"directional": 1}
    examples = [LIGHT_KINDS[kind].example for kind, n in counts.items() for _ in range(n)]
    sources = [replace(light, shadow=shadow) for light in examples]
    around = Environment(studio()) if environment else None
    irradiance = (0.2, 0.3, 0.4) if ambient else 0.0
    return Scene(mesh, lights=tuple(sources), ambient=irradiance, environment=around)


def program_of(
    scene: Scene,
    shading: Shading | None = None,
    stub: str = "",
    coupled: bool = False,
    environment_samples: int = 0,
) -> Program:
    """Return the renderer's program for the first mesh part of a scene, valid for m >= SLOPE.

    Parameters
    ----------
    shading : shading of the scene; None: ``stub`` replaces the specular terms of the lights
    stub : GLSL that replaces the specular terms if ``shading`` is None; "": no specular terms
    """
    chosen = shading or Shading()
    lighting = Lighting.of(scene, chosen)
    (part, *_), (material, *_) = scene.mesh.parts, scene.mesh.materials
    if coupled:
        chosen = chosen.replace(diffuse="coupled")
    chosen = chosen.replace(environment_samples=environment_samples)
    resolved, term = ResolvedScene(scene, chosen, lighting), shading.term if shading else None
    program = shade_program(resolved, part, material, term, SLOPE)
    return replace(program, call=stub) if stub else program


@cache
def _texture(name: str) -> Texture:
    def noise() -> Image.Image:
        random = np.random.default_rng(len(name))
        return Image.fromarray(random.integers(100, 156, (1024, 1024, 3), dtype=np.uint8))

    return Texture(noise, name)


def parts_of(program: Program) -> dict[str, int]:
    """Return how many times a program contains each priced part.

    Further specular terms are a separate part: they share values with the first specular term.
    """
    groups = program.lights or ()
    specular = sum(group.count for group in groups if group.specular) if program.call else 0
    counts: Counter[str] = Counter()
    dark: Counter[str] = Counter()
    for group in groups:
        counts[group.kind] += group.count
        dark[LIGHT_KINDS[group.kind].shadow_price] += group.count * (group.shadows is not None)
    maps = ("albedo map", "normal map", "property map")
    return {
        "base program": 1,
        **{name: int(name.upper().replace(" ", "_") in program.features) for name in maps},
        "ambient term": int("AMBIENT" in program.features),
        **{kind.price: counts[name] for name, kind in sorted(LIGHT_KINDS.items())},
        **{price: dark[price] for price in SHADOWS},
        "coupled diffuse": int("COUPLED" in program.features),
        "light of coupled diffuse": counts.total() * ("COUPLED" in program.features),
        "environment": int("ENVIRONMENT" in program.features),
        "environment sample": environment_samples(program),
        "first specular term": min(specular, 1),
        "further specular term": max(specular - 1, 0),
    }


def environment_samples(program: Program) -> int:
    """Return the number of environment samples of all lobes of a program."""
    prefix = "ENVIRONMENT_SAMPLES "
    counts = [int(f.removeprefix(prefix)) for f in program.features if f.startswith(prefix)]
    return program.environment.count("environment_map") * sum(counts)


def samples(shading: Shading | None = None) -> list[tuple[Scene, Program]]:
    """Return one scene and program per part; the programs' costs determine the parts' costs.

    Each part is measured in a program that uses it. Property maps need a specular and an ambient
    term, which read them. Other maps need an albedo map, whose cost includes the interpolation of
    the texture coordinates.

    Parameters
    ----------
    shading : shading with the programs' specular terms. With None, programs evaluate ``INPUTS``
        instead, which keeps the inputs of a specular term alive. Then the cost of a specular part
        excludes the term, whose net cost must be added. For several terms, this overestimates
        the cost by the work that the terms share
    """
    albedo = ("albedo_map",)
    lights: list[dict[str, Any]] = [{kind: 1} for kind in LIGHT_KINDS if kind != "directional"]
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
    stub = "" if shading else INPUTS
    return [
        *((scene, program_of(scene)) for scene in dull),
        *((scene, program_of(scene, coupled=True)) for scene in dull[:2]),
        *((around, program_of(around, environment_samples=count)) for count in (0, FEW)),
        *((scene, program_of(scene, shading, stub)) for scene in specular),
    ]


# The names of the parts, and the matrix that converts costs of sample programs to part costs.
PARTS = tuple(parts_of(program_of(scene_with())))
TO_PARTS = np.linalg.inv([list(parts_of(program).values()) for _, program in samples()])


def estimate(program: Program, parts: Mapping[str, float]) -> float:
    """Return a program's cost from the costs of the parts.

    If the parts were measured without a shading, the caller adds the cost of each specular term.
    """
    return sum(count * parts[name] for name, count in parts_of(program).items())


def by_slope(
    backend: Backend = "auto",
    repeats: int = 15,
    progress: Callable[[float], object] = lambda done: None,
    shading: Shading | None = None,
) -> dict[str, Interval]:
    """Measure the nanoseconds per fragment of each part on this machine.

    Every program fills the target n times, for three values of n; ``cost.by_slope`` describes the
    method. Additive blending prevents drivers from skipping fragments that later fragments cover.
    The cost of blending and of the rasteriser is measured with an empty program and subtracted.

    shading : see :func:`samples`

    Raises
    ------
    ContextError : no OpenGL context
    """
    net = np.column_stack([TO_PARTS, -TO_PARTS.sum(axis=1)])
    context = create_context(backend)
    try:
        with context.drawing() as gl:
            resources = Resources(context, SIZE)
            with gl.scope(resources.target(Target()), enable_only=moderngl.BLEND):
                gl.blend_func = moderngl.ONE, moderngl.ONE
                pairs = samples(shading)
                runs = [
                    _timed(context, resources, scene, source, resources.program(source))
                    for scene, source in pairs
                ]
                empty = gl.program(pairs[0][1].sources("330 core")["vert"], _EMPTY)
                runs.append(_timed(context, resources, *pairs[0], empty))
                intervals = slopes(runs, 2, 1e9 / (SIZE[0] * SIZE[1]) * net, repeats, progress)
            resources.release()
    finally:
        context.release()
    return dict(zip(PARTS, intervals, strict=True))


def _timed(
    context: Context, resources: Resources, scene: Scene, source: Program, program: moderngl.Program
) -> Timed:
    """Return a function that draws a scene of one mesh part N times and returns the seconds."""
    (part,), (material,) = scene.mesh.parts, scene.mesh.materials
    lighting = Lighting.of(scene, Shading())
    drawn = Pass("", Target(), (), uniforms=scene_uniforms(scene, _VIEW, lighting))
    *maps, drawn = with_shadows(
        ResolvedScene(scene, Shading(), lighting), _VIEW, (1024, 1024), [drawn]
    )
    set_uniforms(program, drawn.uniforms)
    set_uniforms(program, part_uniforms(part, material))
    draw = Draw(source, {}, part, material)
    textures: Any = {}
    for step in maps:
        textures[step.name] = resources.draw(step, scene.mesh, textures).color_attachments[0]
    if scene.environment is not None:
        textures[ENVIRONMENT_MAP] = resources.panorama(scene.environment.panorama)
    array = resources.geometry(part, scene.mesh).array(context.gl, program)
    clock = clock_of(context)

    def seconds(count: int) -> float:
        resources.bind(program, draw, textures)
        with clock(context.gl) as elapsed:
            array.render(instances=count)
        return elapsed[0]

    return seconds
