"""Cost of whole specular terms, from N, L and V: nanoseconds an evaluation, and ratios to the forms
that Romanyuk et al. (2020) print.

    python benchmarks/terms.py [--repeats 25]

Time by slope: a fragment evaluates the term n times, for two n, with directions and m that differ
each time; the difference over n is the cost, and that of a loop without the term is taken off. The
terms take turns; printed are medians over the repeats, and medians and quartiles of the ratios.
"""

from __future__ import annotations

import argparse
import time

import moderngl
import numpy as np

from facerender.context import create_context
from facerender.glsl import resolve_includes
from facerender.measure.variants import CALLS, term, terms

SIZE = (512, 256)
COUNTS = (8, 72)

VERTEX = """#version 330 core
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }
"""
FRAGMENT = """#version 330 core
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
    mat2 turn = mat2(cos(step), sin(step), -sin(step), cos(step));
    total = 0.0;
    for (int i = 0; i < count; ++i) {
        l.xy = turn * l.xy;
        v.xy = v.xy * turn;
        m += step;
        total += %s;
    }
}
"""
EMPTY = ("", "(l.x + v.y) * m + f0")
COEFFICIENTS = {
    "fitted": "#define FR_FITTED_COEFFICIENTS(m, k) coefficients.xyz",
    "fitted-fine": "#define FR_FITTED_FINE_COEFFICIENTS(m, k) coefficients",
}


def with_uniform_m(model: str) -> dict[str, tuple[str, str]]:
    """The terms, and the fitted ones with their coefficients from the host."""
    result = {}
    for name, variant in terms(model).items():
        result[name] = variant
        if name in COEFFICIENTS:
            result[f"{name}, uniform m"] = term(
                CALLS[model], name, "uniform vec4 coefficients;", COEFFICIENTS[name]
            )
    return result


def measure(title: str, variants: dict[str, tuple[str, str]], repeats: int) -> None:
    context = create_context()
    with context.gl as gl:
        target = gl.framebuffer([gl.renderbuffer(SIZE, 1, dtype="f4")])
        corners = gl.buffer(np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32))
        arrays = []
        for prelude, expression in [EMPTY, *variants.values()]:
            program = gl.program(VERTEX, resolve_includes(FRAGMENT % (prelude, expression)))
            program["step"] = 1e-4
            if "coefficients" in program:
                program["coefficients"] = (-4.0, 3.0, -0.5, 0.0)
            arrays.append(gl.vertex_array(program, [(corners, "2f", "corner")]))
        target.use()

        def seconds(array: moderngl.VertexArray, count: int) -> float:
            array.program["count"] = count
            gl.finish()
            start = time.perf_counter()
            array.render()
            gl.finish()
            return time.perf_counter() - start

        for array in arrays:
            seconds(array, COUNTS[0])
        slopes = [
            [seconds(a, COUNTS[1]) - seconds(a, COUNTS[0]) for a in arrays] for _ in range(repeats)
        ]
    print(f"\n{title}: {context.renderer}, {context.version}, {repeats} repeats")
    context.release()
    evaluations = SIZE[0] * SIZE[1] * (COUNTS[1] - COUNTS[0])
    net = np.array(slopes)[:, 1:] - np.array(slopes)[:, :1]
    cost = 1e9 * np.median(net, axis=0) / evaluations
    low, middle, high = np.percentile(net / net[:, :1], [25, 50, 75], axis=0)
    of_d16 = np.median(net / net[:, 1:2], axis=0)
    print(f"  {'':22}      ns   of printed, exact         of printed, d16")
    for i, name in enumerate(variants):
        print(
            f"  {name:22} {cost[i]:7.3f}   {middle[i]:.3f} ({low[i]:.3f} to {high[i]:.3f})"
            f"      {of_d16[i]:.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=25)
    repeats = parser.parse_args().repeats
    measure("Cook-Torrance with Fresnel and masking", with_uniform_m("cook-torrance"), repeats)
    measure("Ward", with_uniform_m("ward"), repeats)


if __name__ == "__main__":
    main()
