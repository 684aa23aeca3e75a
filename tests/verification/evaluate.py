"""Evaluates GLSL expressions on arrays, in a float target that keeps NaN and values above 1."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Literal

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.drawing.context import check_process

Inputs = Mapping[str, NDArray[np.float32]]
Glsl = Literal["330 core", "450 core", "300 es"]

WIDTH = 1024  # of the target in pixels; each pixel holds one sample
EACH = 4  # expressions per fragment, one for each component of a pixel
CORNERS = np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32)  # a triangle that covers the target


def vertex_shader(glsl: Glsl) -> str:
    """Return a vertex shader for the triangle that covers the target."""
    return f"""#version {glsl}
in vec2 corner;
void main() {{ gl_Position = vec4(corner, 0.0, 1.0); }}
"""


def fragment_shaders(
    glsl: Glsl, prelude: str, expressions: Sequence[str], inputs: Inputs
) -> Iterator[str]:
    """Yield shaders that each evaluate EACH expressions for the texels of ``NAME_texels``.

    The default precision is mediump, and only the code of this function is declared highp: the
    library must declare the precision that it needs. Only GLSL ES regards these declarations.
    """
    for first in range(0, len(expressions), EACH):
        few = expressions[first : first + EACH]
        yield "\n".join(
            [
                f"#version {glsl}",
                "precision mediump float;",
                prelude,
                *(f"uniform highp sampler2D {name}_texels;" for name in inputs),
                "out highp vec4 result;",
                "void main() { ivec2 at = ivec2(gl_FragCoord.xy);",
                *fetches(inputs),
                f"result = vec4({', '.join([*few, *['0.0'] * (EACH - len(few))])}); }}",
            ]
        )


def fetches(inputs: Inputs) -> Iterator[str]:
    """Yield the declarations of the inputs at the texel ``at``."""
    for name, values in inputs.items():
        type_, fields = ("vec3", "xyz") if values.ndim == 2 else ("float", "x")
        yield f"highp {type_} {name} = texelFetch({name}_texels, at, 0).{fields};"


def texels(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values as an image padded with 0, (height, WIDTH, 1 or 3)."""
    count = len(values)
    padded = np.zeros((-(-count // WIDTH) * WIDTH, values.size // count), dtype=np.float32)
    padded[:count] = values.reshape(count, -1)
    return padded.reshape(-1, WIDTH, padded.shape[1])


class Evaluator:
    """A context that stays open between evaluations.

    Attributes
    ----------
    renderer, version : OpenGL strings that the driver reports
    """

    def __init__(self, gl: moderngl.Context, glsl: Glsl = "330 core") -> None:
        """gl : owned by the evaluator from now on; glsl : version of its shaders"""
        self.gl, self.glsl, self._process = gl, glsl, os.getpid()
        self._programs: dict[str, moderngl.Program] = {}  # of the last call; key: fragment shader
        gl.gc_mode = "context_gc"
        with gl:
            self.renderer, self.version = gl.info["GL_RENDERER"], gl.info["GL_VERSION"]

    def release(self) -> None:
        self.gl.release()

    def __call__(self, prelude: str, expression: str, inputs: Inputs) -> NDArray[np.float32]:
        """Return the values of one expression, (N,); see :meth:`each`."""
        values: NDArray[np.float32] = self.each(prelude, [expression], inputs)[0]
        return values

    def each(self, prelude: str, expressions: Sequence[str], inputs: Inputs) -> NDArray[np.float32]:
        """Return the values of expressions of the same inputs, (len(expressions), N).

        Parameters
        ----------
        prelude : GLSL with the functions that the expressions call, without ``#include``
        expressions : of type float; they use the inputs by name, and the pixel ``at``
        inputs : (N,) becomes a float and (N, 3) a vec3

        Raises
        ------
        moderngl.Error : a shader does not compile; has the compiler's message
        ContextError : the evaluator was made before this process was forked
        """
        check_process(self._process)
        results = []
        with self.gl as gl:
            gl.gc()  # frees the objects of the previous call
            images = {f"{name}_texels": texels(values) for name, values in inputs.items()}
            textures = []
            for unit, image in enumerate(images.values()):
                height, width, components = image.shape
                textures.append(gl.texture((width, height), components, image, dtype="f4"))
                textures[-1].filter = moderngl.NEAREST, moderngl.NEAREST
                textures[-1].use(unit)
            last, self._programs = self._programs, {}
            for fragment in fragment_shaders(self.glsl, prelude, expressions, inputs):
                program = last.get(fragment) or gl.program(vertex_shader(self.glsl), fragment)
                self._programs[fragment] = program
                for unit, name in enumerate(images):
                    if name in program:
                        program[name] = unit
                target, triangle = _canvas(gl, program, (width, height))
                triangle.render()
                results.append(np.frombuffer(target.read(components=EACH, dtype="f4"), np.float32))
        count = len(next(iter(inputs.values())))
        return np.concatenate([flat.reshape(-1, EACH)[:count].T for flat in results])[
            : len(expressions)
        ]

    def draws(
        self, fragment: str, size: tuple[int, int], seeds: Iterable[int]
    ) -> Iterator[NDArray[np.float32]]:
        """Yield the image of a fragment shader, (height, width, 4), for each seed.

        seeds : values of the shader's ``uniform uint seed``
        """
        check_process(self._process)
        with self.gl as gl:
            gl.gc()  # frees the objects of the previous call
            program = gl.program(vertex_shader(self.glsl), fragment)
            target, triangle = _canvas(gl, program, size)
            for seed in seeds:
                program["seed"] = seed
                triangle.render()
                data = np.frombuffer(target.read(components=4, dtype="f4"), np.float32)
                yield data.reshape(*size[::-1], 4)


def _canvas(
    gl: moderngl.Context, program: moderngl.Program, size: tuple[int, int]
) -> tuple[moderngl.Framebuffer, moderngl.VertexArray]:
    """Return a float target, bound for drawing, and a triangle that covers it."""
    target = gl.framebuffer([gl.renderbuffer(size, 4, dtype="f4")])
    target.use()
    return target, gl.vertex_array(program, [(gl.buffer(CORNERS), "2f", "corner")])
