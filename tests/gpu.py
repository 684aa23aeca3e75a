"""Evaluates a GLSL expression on arrays, into an unclamped float target, where a NaN shows; and
directions to evaluate it at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.glsl.library import resolve_includes

Inputs = Mapping[str, NDArray[np.float32]]
Glsl = Literal["330 core", "450 core", "300 es"]

WIDTH = 1024  # of the target, one pixel for each sample
CORNERS = np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32)  # of a triangle that covers it


class Evaluate(Protocol):
    """Evaluates a float expression of the inputs, each (N,) or (N, 3), to (N,) float32."""

    renderer: str
    version: str

    def __call__(self, prelude: str, expression: str, inputs: Inputs) -> NDArray[np.float32]: ...

    def release(self) -> None: ...


def vertex_shader(glsl: Glsl) -> str:
    return f"""#version {glsl}
in vec2 corner;
void main() {{ gl_Position = vec4(corner, 0.0, 1.0); }}
"""


def fragment_shader(glsl: Glsl, prelude: str, expression: str, inputs: Inputs) -> str:
    """Return the shader that evaluates an expression, for texels of the inputs in ``NAME_texels``.

    The host's own precision is low, and everything of the host's that must not be says so: what the
    library needs is the library's to declare. Without ES the words mean nothing.
    """
    samplers, fetches = [], []
    for name, values in inputs.items():
        kind, fields = ("vec3", "xyz") if values.ndim == 2 else ("float", "x")
        samplers.append(f"uniform highp sampler2D {name}_texels;")
        fetches.append(f"highp {kind} {name} = texelFetch({name}_texels, at, 0).{fields};")
    lines = [
        f"#version {glsl}",
        "precision mediump float;",
        prelude,
        *samplers,
        "out highp vec4 result;",
        "void main() { ivec2 at = ivec2(gl_FragCoord.xy);",
        *fetches,
        f"result = vec4({expression}); }}",
    ]
    return resolve_includes("\n".join(lines))


def texels(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values as an image of WIDTH, filled up with 0: (height, WIDTH, 1 or 3)."""
    count = len(values)
    padded = np.zeros((-(-count // WIDTH) * WIDTH, values.size // count), dtype=np.float32)
    padded[:count] = values.reshape(count, -1)
    return padded.reshape(-1, WIDTH, padded.shape[1])


class Evaluator:
    """A context that stays open between evaluations."""

    def __init__(self, gl: moderngl.Context, glsl: Glsl = "330 core") -> None:
        self.gl, self.glsl = gl, glsl
        with gl:
            self.renderer, self.version = gl.info["GL_RENDERER"], gl.info["GL_VERSION"]

    def release(self) -> None:
        self.gl.release()

    def __call__(self, prelude: str, expression: str, inputs: Inputs) -> NDArray[np.float32]:
        """See :class:`Evaluate`."""
        fragment = fragment_shader(self.glsl, prelude, expression, inputs)
        with self.gl as gl:
            program = gl.program(vertex_shader(self.glsl), fragment)
            for unit, (name, values) in enumerate(inputs.items()):
                image = texels(values)
                height, width, components = image.shape
                texture = gl.texture((width, height), components, image, dtype="f4")
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
                texture.use(unit)
                if f"{name}_texels" in program:
                    program[f"{name}_texels"] = unit
            target, triangle = _canvas(gl, program, (width, height))
            triangle.render()
            data = target.read(components=4, dtype="f4")
        return np.frombuffer(data, np.float32)[: 4 * len(values) : 4]

    def draws(
        self, fragment: str, size: tuple[int, int], seeds: Iterable[int]
    ) -> Iterator[NDArray[np.float32]]:
        """Yield what a fragment shader draws, flat, for each value of its ``uniform uint seed``."""
        with self.gl as gl:
            gl.gc()  # the target of the call before
            program = gl.program(vertex_shader(self.glsl), resolve_includes(fragment))
            target, triangle = _canvas(gl, program, size)
            for seed in seeds:
                program["seed"] = seed
                triangle.render()
                yield np.frombuffer(target.read(components=4, dtype="f4"), np.float32)


def _canvas(
    gl: moderngl.Context, program: moderngl.Program, size: tuple[int, int]
) -> tuple[moderngl.Framebuffer, moderngl.VertexArray]:
    """Return an unclamped float target, in use, and a triangle that covers it."""
    target = gl.framebuffer([gl.renderbuffer(size, 4, dtype="f4")])
    target.use()
    return target, gl.vertex_array(program, [(gl.buffer(CORNERS), "2f", "corner")])


def directions(m: NDArray[np.float32], lowest: float = 1e-5) -> dict[str, NDArray[np.float32]]:
    """Draw a normal, a light and an eye for each slope, as float32 rounds them: N.L and N.V above
    ``lowest``, half of them log-uniform; half of the half vectors anywhere, half with tangents from
    0 to 3 m, dense near 0."""
    random = np.random.default_rng(7)
    count = len(m)

    def unit(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))

    n = unit(random.normal(size=(count, 3)))
    even, logarithmic = random.uniform(lowest, 1.0, (2, count, 1)), random.random((2, count, 1))
    z = np.where(random.random((2, count, 1)) < 0.5, even, lowest**logarithmic)
    l, v = np.sqrt(1.0 - z**2) * unit(np.cross(n, random.normal(size=(2, count, 3)))) + z * n
    across = unit(np.cross(n, random.normal(size=(count, 3))))
    h = unit(n + across * 3.0 * random.random((count, 1)) ** 3 * m[:, None])
    mirrored = 2.0 * (h * l).sum(axis=-1, keepdims=True) * h - l
    v[: count // 2] = mirrored[: count // 2]
    below = (n * v).sum(axis=-1) <= lowest
    v[below] = n[below]
    vectors = {"n": n, "l": l, "v": v}
    return {name: x.astype(np.float32) for name, x in vectors.items()} | {"m": m}
