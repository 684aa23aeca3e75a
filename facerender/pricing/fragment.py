"""What the parts of the host's fragment program cost, apart from specular terms, in the units in
which ``amd.statistics`` and ``cost.by_slope`` price those.

    python -m facerender.pricing.fragment

Needs what ``amd`` needs, and OpenGL; what is missing is not measured.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import moderngl
import numpy as np
from numpy.typing import ArrayLike

from facerender.drawing.context import Backend, create_context
from facerender.errors import FacerenderError
from facerender.glsl.library import resolve_includes
from facerender.pricing import amd
from facerender.pricing.cost import clock_of, slopes
from facerender.pricing.interval import Interval

SIZE = (512, 256)
# In place of a specular term: what ``amd`` takes off a term's cost, so that both add up. It keeps
# alive what only a specular term reads.
STUB = "".join(
    f"#define {name}_BRDF(n, l, v, m, f0) ({amd.EMPTY})\n" for name in ("SPECULAR", "FRONTAL")
)


@dataclass(frozen=True)
class Program:
    """A fragment program of the host, as far as its cost depends on it. It has diffuse light and
    texture coordinates.

    Parameters
    ----------
    property_map : all three of its channels
    ambient : the ambient term
    directional_lights, point_lights : how many there are
    directional_specular, point_specular : how many of them have a specular term
    directional_frontal : how many have that of frontal light; no part prices it
    """

    albedo_map: bool = True
    normal_map: bool = False
    property_map: bool = False
    ambient: bool = False
    directional_lights: int = 1
    point_lights: int = 0
    directional_specular: int = 0
    point_specular: int = 0
    directional_frontal: int = 0

    @property
    def parts(self) -> dict[str, int]:
        """How many of each part it has. Terms after the first share with it what depends on the
        fragment alone."""
        specular = self.directional_specular + self.point_specular
        return {
            "base program": 1,
            "albedo map": int(self.albedo_map),
            "normal map": int(self.normal_map),
            "property map": int(self.property_map),
            "ambient term": int(self.ambient),
            "directional light": self.directional_lights,
            "point light": self.point_lights,
            "first specular term": min(specular, 1),
            "further specular term": max(specular - 1, 0),
        }

    def defines(self, brdf: str = STUB) -> str:
        """Return what stands before host/shade.frag.

        Parameters
        ----------
        brdf : GLSL that defines SPECULAR_BRDF, as :meth:`Shading.glsl` returns it
        """
        names = ["UV", "DIFFUSE"]
        names += ["ALBEDO_MAP"] * self.albedo_map + ["NORMAL_MAP"] * self.normal_map
        names += ["AMBIENT"] * self.ambient
        if self.property_map:
            names += ["PROPERTY_MAP", "OCCLUSION_MAP", "ROUGHNESS_MAP", "SPECULAR_MAP"]
        names += [
            f"DIRECTIONAL_LIGHTS {self.directional_lights}",
            f"POINT_LIGHTS {self.point_lights}",
            f"DIRECTIONAL_SPECULAR {self.directional_specular}",
            f"POINT_SPECULAR {self.point_specular}",
            f"DIRECTIONAL_FRONTAL {self.directional_frontal}",
            "POINT_FRONTAL 0",
        ]
        specular = self.directional_specular + self.point_specular + self.directional_frontal
        return "".join(f"#define {name}\n" for name in names) + (brdf if specular else "")


PARTS = tuple(Program().parts)
# As many programs as parts, so that the costs of these give the costs of those. A part is measured
# where it counts: the property map under a specular and an ambient term, which read it; other maps
# beside an albedo map, which has paid for the interpolation of the texture coordinates.
PROGRAMS = (
    Program(),
    Program(directional_lights=2),
    Program(point_lights=1),
    Program(directional_specular=1),
    Program(directional_lights=2, directional_specular=2),
    Program(albedo_map=False, directional_specular=1),
    Program(normal_map=True, directional_specular=1),
    Program(ambient=True, directional_specular=1),
    Program(ambient=True, property_map=True, directional_specular=1),
)
_TO_PARTS = np.linalg.inv([list(program.parts.values()) for program in PROGRAMS])

_EMPTY = "#version 330 core\nout vec4 radiance;\nvoid main() { radiance = vec4(0.5); }\n"
_SRGB8_ALPHA8 = 0x8C43
_ATTRIBUTES = {"in_position": 3, "in_normal": 3, "in_uv": 2}
# A triangle that fills the target with a patch of a curved surface, clockwise, as the host draws
# its front; a texel and a half to a pixel.
_VERTICES = np.array(
    [
        [-1, -1, 0.1, -0.5, -0.4, 1, 0, 0],
        [-1, 3, -0.2, -0.4, 0.6, 1, 0, 3 * SIZE[1] / 1024],
        [3, -1, 0.2, 0.7, -0.3, 1, 3 * SIZE[0] / 1024, 0],
    ],
    dtype=np.float32,
)
_UNIFORMS: dict[str, ArrayLike] = {
    "view_projection": np.eye(4),
    "eye": (0.2, 0.1, 3.0),
    "slope": 0.4,
    "specular_weight": 0.3,
    "diffuse_weight": 0.7,
    "f0": 0.028,
    "ambient": (0.2, 0.3, 0.4),
    "light_direction": (0.48, 0.6, 0.64),
    "light_irradiance": (2.0, 1.9, 1.8),
    "light_position": (1.0, 2.0, 3.0),
    "light_intensity": (5.0, 4.9, 4.8),
}


def estimate(program: Program, parts: Mapping[str, float]) -> float:
    """Return a program's cost from the costs of the parts; where those are of STUB, each specular
    term's own cost comes on top."""
    return sum(number * parts[name] for name, number in program.parts.items())


def by_compiler(family: str, brdf: str = STUB) -> dict[str, float]:
    """Return the cost of each part on a family of AMD's GPUs, as RADV estimates it.

    A map costs what the vector ALU does for it: the compiler knows neither the filter's rate nor
    the cache.

    Parameters
    ----------
    family : "navi21" (RDNA2) or "vega10" (GCN5)
    brdf : GLSL that defines SPECULAR_BRDF. With STUB, the cost of a specular part is what the
        program spends besides the term, whose own cost comes on top; that overrates several terms
        by what they share. With a term, its cost is in the part.

    Returns
    -------
    cycles of a wave, as ``inverse_throughput`` of :class:`amd.Statistics`

    Raises
    ------
    InputError : an unknown family, or a BRDF that is not GLSL
    NotMeasured : a tool is missing; the message says which, and how to get it
    """
    found = cycles([(program, brdf) for program in PROGRAMS], family)
    return dict(zip(PARTS, map(float, _TO_PARTS @ found), strict=True))


def cycles(programs: Sequence[tuple[Program, str]], family: str) -> list[int]:
    """Return RADV's estimate of whole programs, each with the GLSL of its BRDF; unit and errors as
    in :func:`by_compiler`."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        modules = list(pool.map(lambda program: amd.spirv(**_sources("450", *program)), programs))
    rows = amd.compile_programs(modules, family)[1]
    return [row["Inverse Throughput"] for row in rows]


def by_slope(
    backend: Backend = "auto",
    repeats: int = 15,
    progress: Callable[[float], object] = lambda done: None,
    brdf: str = STUB,
) -> dict[str, Interval]:
    """Measure the parts here, by the slope of time over the number of fragments.

    Every program fills the target n times, for three n; clocks as in ``cost.by_slope``. The colours
    are added up, so that no driver may leave out what a later triangle covers. An empty program
    tells what that and the rasteriser take, which is taken off.

    Parameters
    ----------
    repeats : of every measurement
    progress : called with the share that is done, in [0, 1]
    brdf : as in :func:`by_compiler`

    Returns
    -------
    nanoseconds a fragment, of all fragments together

    Raises
    ------
    ContextError : no OpenGL context
    moderngl.Error : a BRDF that is not GLSL
    """
    sources = [_sources("330 core", program, brdf) for program in PROGRAMS]
    sources.append({**sources[0], "frag": _EMPTY})
    net = np.column_stack([_TO_PARTS, -_TO_PARTS.sum(axis=1)])
    context = create_context(backend)
    try:
        with context.drawing() as gl:
            target = gl.framebuffer([gl.renderbuffer(SIZE, 4, dtype="f4")])
            vertices = gl.buffer(_VERTICES)
            textures = _textures(gl)
            clock = clock_of(context)

            def run(source: Mapping[str, str]) -> Callable[[int], float]:
                program = gl.program(source["vert"], source["frag"])
                _set_uniforms(program)
                for unit, name in enumerate(textures):
                    if name in program:
                        program[name] = unit
                layout = " ".join(
                    f"{width}f" if name in program else f"{width}x4"
                    for name, width in _ATTRIBUTES.items()
                )
                used = [name for name in _ATTRIBUTES if name in program]
                array = gl.vertex_array(program, [(vertices, layout, *used)])

                def seconds(count: int) -> float:
                    with clock(gl) as elapsed:
                        array.render(instances=count)
                    return elapsed[0]

                return seconds

            units = tuple((texture, unit) for unit, texture in enumerate(textures.values()))
            with gl.scope(target, enable_only=moderngl.BLEND, textures=units):
                gl.blend_func = moderngl.ONE, moderngl.ONE
                runs = [run(source) for source in sources]
                intervals = slopes(runs, 2, 1e9 / (SIZE[0] * SIZE[1]) * net, repeats, progress)
    finally:
        context.release()
    return dict(zip(PARTS, intervals, strict=True))


def _sources(version: str, program: Program, brdf: str) -> dict[str, str]:
    """Return the host's GLSL by stage."""
    head = f"#version {version}\n{program.defines(brdf)}"
    files = {"vert": "host/surface.vert", "frag": "host/shade.frag"}
    return {s: resolve_includes(f'{head}#include "{file}"\n') for s, file in files.items()}


def _set_uniforms(program: moderngl.Program) -> None:
    for name, value in _UNIFORMS.items():
        if name in program:
            uniform = program[name]
            size = uniform.array_length * uniform.dimension  # type: ignore[union-attr]
            uniform.write(np.resize(value, size).astype(np.float32))  # type: ignore[union-attr]


def _textures(gl: moderngl.Context) -> dict[str, moderngl.Texture]:
    """Upload maps of 1024 x 1024 texels in the formats, and with the filters, of the renderer."""
    random = np.random.default_rng(0)
    result = {}
    for name, components, internal, smaller in (
        ("albedo_map", 4, _SRGB8_ALPHA8, moderngl.LINEAR_MIPMAP_LINEAR),
        ("normal_map", 3, None, moderngl.LINEAR_MIPMAP_LINEAR),
        ("property_map", 3, None, moderngl.LINEAR_MIPMAP_NEAREST),
    ):
        texels = random.integers(100, 156, (1024, 1024, components), dtype=np.uint8)
        texture = gl.texture((1024, 1024), components, texels, internal_format=internal)
        texture.build_mipmaps()
        texture.filter = smaller, moderngl.LINEAR
        result[name] = texture
    return result


def main() -> None:
    """Print what can be measured, and what cannot."""
    measures: dict[str, Callable[[], Mapping[str, float]]] = {
        **{f"{family}, cycles": partial(by_compiler, family) for family in amd.FAMILIES},
        "here, ns": lambda: {name: each.value for name, each in by_slope().items()},
    }
    for title, measure in measures.items():
        print(title)
        try:
            for name, value in measure().items():
                print(f"  {name:<24}{value:8.2f}")
        except FacerenderError as error:
            print(f"  not measured: {error}")


if __name__ == "__main__":
    main()
