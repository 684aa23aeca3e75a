"""Costs measured on this machine: nanoseconds per evaluation of a term, milliseconds per frame,
with bootstrap intervals.

The measured GLSL has the forms as published by Romanyuk et al. (2020), and the library's forms.
``benchmarks/prices`` estimates costs on other GPUs with the compilers of these GPUs."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender.drawing.context import Backend, Context, create_context
from facerender.drawing.renderer import Renderer
from facerender.glsl.library import defines, lobe_macros, resolve_includes
from facerender.material import Material
from facerender.mesh.geometry import Geometry
from facerender.mesh.mesh import Mesh
from facerender.mesh.part import Part
from facerender.scene.camera import Camera
from facerender.scene.scene import Scene
from facerender.scene.shading import SMALL_SLOPE, Shading
from facerender.terms.lobe import LOBES
from facerender.terms.model import MODELS

Float = NDArray[np.float64]
Glsl = tuple[str, str]  # prelude and float expression
Draw = Callable[[], object]
Run = Callable[[int], float]  # draws a number of times and returns the seconds
Report = Callable[[float], object]  # receives the completed fraction


def silent(done: float) -> None:
    """Report no progress."""


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95 % interval, by bootstrap over the repeats of a measurement. The
    interval of :func:`facerender.pricing.cost.relative` contains 80 % of the repeats instead."""

    value: float
    low: float
    high: float


def bootstrap(estimate: Callable[[NDArray[np.int64]], Float], repeats: int) -> list[Interval]:
    """Return estimates (N,) with 95 % intervals; ``estimate`` takes indices of repeats."""
    # The seed is constant: equal times have equal intervals, in tests and in documents.
    draws = np.random.default_rng(0).integers(repeats, size=(500, repeats))
    low, high = np.percentile([estimate(turns) for turns in draws], [2.5, 97.5], axis=0)
    value = estimate(np.arange(repeats))
    return [Interval(*map(float, row)) for row in zip(value, low, high, strict=True)]


_FEWEST = 11  # smallest number of rounds before a time limit ends a measurement


def seconds(
    draws: Sequence[Draw], repeats: int, progress: Report = silent, limit: float = math.inf
) -> Float:
    """Return the duration of each draw, (rounds, draws) in seconds. The draws alternate. After
    ``limit`` seconds no further round begins, once there are _FEWEST rounds."""
    for draw in draws:  # compiles and uploads
        draw()
    times = np.empty((repeats, len(draws)))
    for turn in range(repeats):
        if turn >= _FEWEST and times[:turn].sum() > limit:
            return times[:turn]
        for index, draw in enumerate(draws):
            start = time.perf_counter()
            draw()
            times[turn, index] = time.perf_counter() - start
        progress((turn + 1) / repeats)
    return times


def relative(draw: Draw, full: Draw, repeats: int, limit: float) -> Interval:
    """Divide the time of ``draw`` by the time of ``full`` per round; return the median and the 10 %
    and 90 % quantiles of the ratios. ``limit`` is as in :func:`seconds`."""
    # The load of a machine changes within seconds, and more rounds of one load do not show that.
    # These quantiles contain the median of a later measurement more often than a bootstrap does.
    times, baseline = seconds([draw, full], repeats, limit=limit).T
    return Interval(*np.quantile(times / baseline, [0.5, 0.1, 0.9]).tolist())


@dataclass(frozen=True)
class Line:
    """Milliseconds of a frame as a linear function of its fragment price."""

    fixed: float  # milliseconds of geometry, coverage, maps and readback, with any shading
    slope: float  # milliseconds per unit of the fragment price

    @classmethod
    def through(cls, full: tuple[float, float], cheap: tuple[float, float]) -> Line:
        """Return the line through two frames, each given by its fragment price and milliseconds.
        The slope is 0 if the cheaper frame was not faster."""
        (price, time), (low_price, low_time) = full, cheap
        slope = (time - low_time) / (price - low_price) if price > low_price else 0.0
        # Noise may make the line steep. No shading saves more than the whole frame.
        slope = min(max(slope, 0.0), time / price)
        return cls(time - slope * price, slope)

    def cost(self, total: float, specular: float) -> tuple[float, float]:
        """Return milliseconds of a frame and of its specular terms, from their fragment prices."""
        return self.fixed + self.slope * total, self.slope * specular


@dataclass(frozen=True)
class Frames:
    """Frame times of a plan."""

    full: Line  # time as a function of the fragment price, with the full level of detail
    planned: Line  # the same with the chosen level of detail
    # Milliseconds of frames with the full shading, keyed by the last choice in effect: "full",
    # "cull_back_faces", "samples", "shading_rate" or "triangles".
    taken: Mapping[str, float]
    source: str  # origin of the times, as text


SLOPE = 0.3  # slope m of the priced terms
# A sum of the inputs of a term; the cost of this sum is subtracted from the cost of the term.
INPUTS = "dot(l, v) + n.x + m * f0"

# Titles of the models in Romanyuk et al. (2020), keyed by the model's name.
PRINTED = {model.name: model.title for model in MODELS.values() if model.printed}
# Exact lobes as published by Romanyuk et al. (2020), with E = exp(-tan² γ / m²) and c = cos γ:
# E/c^4 computed from c, and E computed from γ.
_PRINTED_EXACT = {
    "cook-torrance": "exp((c * c - 1.0) / (m * m * c * c)) / (c * c * c * c)",
    "ward": "exp(-tan(acos(c)) * tan(acos(c)) / (m * m))",
}


def printed_lobe(c: ArrayLike, m: ArrayLike, k: int, g: int) -> Float:
    """Return D4, D8 or D16 (g = 4, 8, 16) as published by Romanyuk et al. (2020), in float64:
    ((n/g)(c - 1) + 1)^g with n = 2/m² - k, without a clamp. The peak is 1."""
    n = 2.0 / np.asarray(m, np.float64) ** 2 - k
    return np.asarray((n / g * (np.asarray(c) - 1.0) + 1.0) ** g)


PRINTED_D16 = replace(
    LOBES["d16"],
    name="d16 as published",
    evaluate=lambda c, m, k: printed_lobe(c, LOBES["d16"].check(m, k), k, 16),
)


@dataclass(frozen=True)
class Variant:
    """A form of a model's specular term, by the names of model and lobe."""

    model: str
    lobe: str
    printed: bool = False  # whether the form is as published by Romanyuk et al.
    # Whether the exact lobe omits the precision at small angles that m < SMALL_SLOPE needs.
    plain: bool = False

    @property
    def name(self) -> str:
        """The label of the variant, unique among the variants of the model."""
        if self.printed:
            return f"printed, {self.lobe}"
        return f"{self.lobe}, m >= {SMALL_SLOPE:g}" if self.plain else self.lobe

    @property
    def unclamped(self) -> bool:
        """Whether the lobe is a power without a clamp, as published by Romanyuk et al."""
        return self.printed and self.lobe != "exact"

    @property
    def k(self) -> int:
        """The power k of 1/cos γ in the model's lobe."""
        return MODELS[self.model].k

    @property
    def shading(self) -> Shading:
        """A shading with this model and lobe. OpenGL cannot draw it if the lobe is unclamped."""
        return Shading(self.model, PRINTED_D16 if self.unclamped else self.lobe)

    @property
    def term(self) -> Glsl:
        """GLSL prelude and expression of the whole term, in 1/sr."""
        model = MODELS[self.model]
        call = model.printed if self.printed else model.printed.replace("printed_", "")
        folder = "printed" if self.printed else "facerender"
        macros = defines(lobe_macros(self.lobe)) + "#define FR_SMALL_SLOPE 0\n" * self.plain
        return f'{macros}#include "{folder}/{model.file}.glsl"', call

    @property
    def lobe_term(self) -> Glsl:
        """GLSL prelude and expression of the lobe as a function of float c and m; no unit."""
        if self.unclamped:
            power = f"fr_printed_g_power(c, 2.0 / (m * m) - {self.k}.0, 16)"
            return '#include "printed/g_power.glsl"', power
        if self.printed:
            return "", _PRINTED_EXACT[self.model]
        prelude = f'{defines(lobe_macros(self.lobe))}#include "facerender/lobe.glsl"'
        return prelude, f"fr_lobe(c, m, {self.k})"


def of_model(model: str) -> tuple[Variant, ...]:
    """Return the variants of a model, the published variants first."""
    printed = (Variant(model, lobe, printed=True) for lobe in ("exact", "d16"))
    library = (Variant(model, lobe, plain=p) for lobe in LOBES for p in (False, lobe == "exact"))
    return *printed, *dict.fromkeys(library)


def terms(model: str) -> dict[str, Glsl]:
    """Return GLSL prelude and expression of each whole term, keyed by the variant's name."""
    return {variant.name: variant.term for variant in of_model(model)}


def lobe_terms(model: str) -> dict[str, Glsl]:
    """Return GLSL prelude and expression of each lobe, keyed by the variant's name."""
    return {variant.name: variant.lobe_term for variant in of_model(model) if not variant.plain}


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
    terms: Mapping[str, Glsl],
    empty: str = OF_VECTORS,
    repeats: int = 15,
    backend: Backend = "auto",
    progress: Report = silent,
) -> dict[str, Interval]:
    """Measure the nanoseconds per evaluation of each term, minus those per turn of an empty loop.

    A fragment evaluates the term n times, for three values of n. The gradient of a line through the
    three times, divided by the number of pixels, is the time per evaluation. The terms are measured
    alternately, so that a slow phase of the machine affects all of them.

    terms : GLSL prelude (may include library files) and float expression, keyed by name; variables:
        vec3 n, l, v and float c (cosine of the angle between normal and half vector), m, f0
    empty : expression whose cost is subtracted: OF_VECTORS for whole terms, OF_COSINE for lobes
    """
    context = create_context(backend)
    try:
        with context.gl as gl:
            target = gl.framebuffer([gl.renderbuffer(SIZE, 1, dtype="f4")])
            corners = gl.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32))
            target.use()

            def run(prelude: str, expression: str) -> Run:
                program = gl.program(_VERTEX, resolve_includes(_FRAGMENT % (prelude, expression)))
                kernel = gl.vertex_array(program, [(corners, "2f", "corner")])

                def seconds(count: int) -> float:
                    program["count"] = count
                    program["step"] = 0.05 / count  # keeps c and m in their domains
                    with clock(context) as elapsed:
                        kernel.render()
                    return elapsed[0]

                return seconds

            runs = [run(*term) for term in (("", empty), *terms.values())]
            net = np.column_stack([np.full(len(terms), -1.0), np.eye(len(terms))])
            intervals = slopes(runs, 8, 1e9 / (SIZE[0] * SIZE[1]) * net, repeats, progress)
    finally:
        context.release()
    return dict(zip(terms, intervals, strict=True))


def slopes(
    runs: Sequence[Run], first: int, weights: Float, repeats: int, progress: Report = silent
) -> list[Interval]:
    """Measure the seconds per count of alternating runs, and return weighted sums over the runs.

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
    progress: Report = silent,
) -> list[Interval]:
    """Measure milliseconds per frame with readback, one sample per pixel, in turns."""
    with Renderer(size, samples=1, backend=backend) as renderer:
        draws = [partial(renderer.render, scene, shading) for shading in shadings]
        times = seconds(draws, repeats, progress)
    return bootstrap(lambda turns: 1e3 * np.quantile(times[turns], QUANTILE, axis=0), repeats)


@contextmanager
def clock(context: Context) -> Iterator[list[float]]:
    """Yield an empty list, and append the seconds that the block draws."""
    elapsed: list[float] = []
    if not context.software:
        query = context.gl.query(time=True)
        with query:
            yield elapsed
        elapsed.append(1e-9 * query.elapsed)
        return
    # Processor time divided by the number of threads is close to the wall time of an idle machine,
    # and other processes hardly change it.
    threads = 1
    if "softpipe" not in context.renderer.lower():
        threads = len(os.sched_getaffinity(0))
        limit = os.environ.get("LP_NUM_THREADS", "")  # read by llvmpipe; 0: only one thread
        threads = max(1, min(threads, int(limit))) if limit.isdecimal() else threads
    context.gl.finish()
    start = time.process_time()
    yield elapsed
    context.gl.finish()
    elapsed.append((time.process_time() - start) / threads)


PARTS = ("scattering", "sample of scattering")
_MEASURED = (8, 64)  # subsurface samples per pixel of the two measured frames
_SIZE = 512


def scene() -> Scene:
    """Return a scene of a skin wall that fills a square image at four pixels per millimetre."""
    corners = 80.0 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)], dtype=np.uint32)
    wall = Part(corners, np.tile((0.0, 0.0, 1.0), (4, 1)), faces)
    skin = Material(scattering="skin", ks=0.0)
    bounds = np.array([(-80.0, -80.0, -80.0), (80.0, 80.0, 80.0)])
    geometry = Geometry("wall", (wall,), bounds, 139.0, np.array([(0.5, 0.5)]), 1.0)
    camera = Camera(position=(0.0, 0.0, 288.7), target=(0.0, 0.0, 0.0), fov=25.0)
    return Scene(Mesh(geometry, (skin,)), camera)


def by_frames(repeats: int = 9) -> dict[str, float]:
    """Measure the cost of PARTS on this machine, in nanoseconds per pixel."""
    shadings = [Shading(scatter_samples=count) for count in (0, *_MEASURED)]
    none, *scattered = frames(scene(), shadings, (_SIZE, _SIZE), repeats)
    return parts(_MEASURED, [1e6 * (time.value - none.value) / _SIZE**2 for time in scattered])


def parts(samples: tuple[int, int], costs: list[float]) -> dict[str, float]:
    """Return the costs of PARTS, given the costs of scattering with two numbers of samples."""
    price = (costs[1] - costs[0]) / (samples[1] - samples[0])
    return dict(zip(PARTS, (max(costs[0] - samples[0] * price, 0.0), price), strict=True))
