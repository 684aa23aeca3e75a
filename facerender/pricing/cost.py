"""Costs measured on this machine: nanoseconds per evaluation of a term, milliseconds per frame.

``benchmarks/prices`` estimates costs on other GPUs with the compilers of these GPUs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial

import moderngl
import numpy as np
from numpy.typing import NDArray

from facerender.drawing.context import Backend, Context, create_context
from facerender.drawing.renderer import Renderer
from facerender.glsl.library import resolve_includes
from facerender.pricing.frame import seconds
from facerender.pricing.interval import Interval, bootstrap
from facerender.scenes.scene import Scene
from facerender.shading import Shading

SIZE = (512, 256)
# Other processes can lengthen a time but never shorten it. So the lower quartile of the repeats is
# steadier than the median, and it depends less on chance than the minimum.
QUANTILE = 0.25

_VERTEX = """#version 330 core
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }
"""
# Directions, c and m change in every iteration, so that a compiler can hoist nothing out of the
# loop. The rotation keeps the vectors' lengths.
_FRAGMENT = """#version 330 core
%s
uniform int count;
uniform float step;
out float total;
void main() {
    vec2 p = gl_FragCoord.xy / 512.0;
    vec3 n = normalize(vec3(0.2 * p - 0.1, 1.0));
    vec3 l = normalize(vec3(p.x - 0.5, 0.4, 1.0));
    vec3 v = normalize(vec3(-0.3, p.y - 0.5, 1.0));
    float m = 0.3 + 0.01 * p.x;
    float f0 = 0.028 + 0.01 * p.y;
    float c = 0.7 + 0.2 * p.x;
    mat2 turn = mat2(cos(step), sin(step), -sin(step), cos(step));
    total = 0.0;
    for (int i = 0; i < count; ++i) {
        l.xy = turn * l.xy;
        v.xy = v.xy * turn;
        m += step;
        c += step;
        total += %s;
    }
}
"""
# Expressions with the same inputs as a term. Their cost is subtracted from the term's cost.
OF_VECTORS = "(l.x + v.y) * m + f0"
OF_COSINE = "c + m"


def by_slope(
    terms: Mapping[str, tuple[str, str]],
    empty: str = OF_VECTORS,
    repeats: int = 15,
    backend: Backend = "auto",
    progress: Callable[[float], object] = lambda done: None,
) -> dict[str, Interval]:
    """Measure the nanoseconds per evaluation of each term, minus those per turn of an empty loop.

    A fragment evaluates the term n times, for three values of n. The gradient of a line through the
    three times, divided by the number of pixels, is the time per evaluation. The terms are measured
    alternately, so that a slow phase of the machine affects all of them. On a GPU, timer queries
    measure the time. On a CPU, the processor time of this process up to ``glFinish`` is divided by
    the number of drawing threads; the quotient is close to the wall time of an idle machine.

    Parameters
    ----------
    terms : GLSL prelude (may include library files) and float expression, keyed by name; variables:
        vec3 n, l, v and float c (cosine of the angle between normal and half vector), m, f0
    empty : expression whose cost is subtracted: OF_VECTORS for whole terms, OF_COSINE for lobes

    Raises
    ------
    ContextError : no OpenGL context
    moderngl.Error : a term is not valid GLSL
    """
    context = create_context(backend)
    try:
        with context.gl as gl:
            target = gl.framebuffer([gl.renderbuffer(SIZE, 1, dtype="f4")])
            corners = gl.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32))
            target.use()
            clock = clock_of(context)

            def run(prelude: str, expression: str) -> Callable[[int], float]:
                program = gl.program(_VERTEX, resolve_includes(_FRAGMENT % (prelude, expression)))
                kernel = gl.vertex_array(program, [(corners, "2f", "corner")])

                def seconds(count: int) -> float:
                    program["count"] = count
                    program["step"] = 0.05 / count  # keeps c and m in their domains
                    with clock(gl) as elapsed:
                        kernel.render()
                    return elapsed[0]

                return seconds

            runs = [run(*term) for term in (("", empty), *terms.values())]
            net = np.column_stack([np.full(len(terms), -1.0), np.eye(len(terms))])
            weights = 1e9 / (SIZE[0] * SIZE[1]) * net
            intervals = slopes(runs, 8, weights, repeats, progress)
    finally:
        context.release()
    return dict(zip(terms, intervals, strict=True))


def slopes(
    runs: Sequence[Callable[[int], float]],
    first: int,
    weights: NDArray[np.float64],
    repeats: int,
    progress: Callable[[float], object] = lambda done: None,
) -> list[Interval]:
    """Measure the seconds per count of alternating runs, and return weighted sums over the runs.

    Parameters
    ----------
    runs : functions that draw a given number of times and return the seconds
    first : the smallest count; it is doubled while the times are too short for the clock
    weights : weight of each run in each sum, (N, runs)
    """
    for run in runs:
        run(1)  # compiles
    counts = first * np.array([1, 3, 5])
    while runs[0](int(counts[-1])) < 2e-3 and counts[-1] < 100_000:
        counts *= 2
    times = np.empty((repeats, len(runs), len(counts)))
    for turn in range(repeats):
        for index, run in enumerate(runs):
            times[turn, index] = [run(int(count)) for count in counts]
        progress((turn + 1) / repeats)
    lever = (counts - counts.mean()) / ((counts - counts.mean()) ** 2).sum()
    return bootstrap(
        lambda turns: weights @ (np.quantile(times[turns], QUANTILE, axis=0) @ lever), repeats
    )


def frames(
    scene: Scene,
    shadings: Sequence[Shading],
    size: tuple[int, int],
    repeats: int = 9,
    backend: Backend = "auto",
    progress: Callable[[float], object] = lambda done: None,
) -> list[Interval]:
    """Measure milliseconds per frame with readback, one sample per pixel; the shadings alternate.

    Raises
    ------
    ContextError : no OpenGL context
    InputError : the scene cannot be drawn with a shading
    """
    with Renderer(size, samples=1, backend=backend) as renderer:
        draws = [partial(renderer.render, scene, shading) for shading in shadings]
        times = seconds(draws, repeats, progress)
    return bootstrap(lambda turns: 1e3 * np.quantile(times[turns], QUANTILE, axis=0), repeats)


def clock_of(
    context: Context,
) -> Callable[[moderngl.Context], AbstractContextManager[list[float]]]:
    """Return a function that makes timers: context managers that append their seconds to a list."""
    if context.software:
        return partial(_cpu_clock, threads=_threads(context.renderer))
    return _gpu_clock


def _threads(renderer: str) -> int:
    """Return the number of CPU threads that a software driver draws with."""
    if "softpipe" in renderer.lower():
        return 1
    cores = len(os.sched_getaffinity(0))
    threads = os.environ.get("LP_NUM_THREADS", "")  # read by llvmpipe; 0: only one thread
    return max(1, min(cores, int(threads))) if threads.isdecimal() else cores


@contextmanager
def _cpu_clock(gl: moderngl.Context, threads: int) -> Iterator[list[float]]:
    elapsed: list[float] = []
    gl.finish()
    start = time.process_time()
    yield elapsed
    gl.finish()
    elapsed.append((time.process_time() - start) / threads)


@contextmanager
def _gpu_clock(gl: moderngl.Context) -> Iterator[list[float]]:
    elapsed: list[float] = []
    query = gl.query(time=True)
    with query:
        yield elapsed
    elapsed.append(1e-9 * query.elapsed)
