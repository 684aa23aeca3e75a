"""Measure the float32 error of the exact terms, and their values at extreme inputs.

    python -m benchmarks.accuracy

Writes docs/measurements/accuracy.json. Needs an OpenGL context.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from benchmarks.data import save
from facerender import brdf, lobes, resolve_includes
from facerender.drawing.context import create_context
from tests.verification.cases import true_directions
from tests.verification.evaluate import Evaluator

SLOPES = (1e-4, 1e-3, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
COUNT = 200_000  # random directions per slope
UP, LEFT, RIGHT = [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]
TILTED = [0.36, 0.48, 0.8]
ABOVE_1 = 1.0 + 2.0**-23
COOK_TORRANCE = "fr_cook_torrance(n, l, v, m, 0.028)"

# naive expression and its file, then the library's expression and its file
LOBE = (
    *("exp((c * c - 1.0) / (m * m * c * c)) / (c * c * c * c)", "facerender/constants"),
    *("fr_lobe_exact(c, m, 4)", "facerender/lobe/exact"),
)
ANGLE = ("acos(c)", "facerender/constants", *LOBE[2:])
COSINE = (
    *("pow(c, 2.0 / (m * m) - 4.0)", "facerender/constants"),
    *("fr_lobe_cosine(c, m, 4)", "facerender/lobe/cosine"),
)
D16 = (
    *("fr_printed_g_power(c, 2.0 / (m * m) - 4.0, 16)", "printed/g_power"),
    *("fr_lobe_g_power(c, m, 4, 16)", "facerender/lobe/g_power"),
)
TERM = (
    *(COOK_TORRANCE.replace("fr_", "fr_printed_"), "printed/cook_torrance"),
    *(COOK_TORRANCE, "facerender/cook_torrance"),
)
WARD = (
    *("fr_printed_ward(n, l, v, m)", "printed/ward"),
    *("fr_ward_printed(n, l, v, m)", "facerender/ward_printed"),
)
EXTREMES: tuple[tuple[str, tuple[str, ...], Mapping[str, object]], ...] = (
    ("lobe, c = 0", LOBE, {"c": 0.0}),
    ("lobe, c one ulp above 1, m = 1e-4", LOBE, {"c": ABOVE_1, "m": 1e-4}),
    ("angle of c one ulp above 1, for the lobe", ANGLE, {"c": ABOVE_1}),
    ("D16, 90 degrees, m = 0.2", D16, {"c": 0.0, "m": 0.2}),
    ("D16, 90 degrees, m = 0.02", D16, {"c": 0.0, "m": 0.02}),
    ("cosine power, c = 1e-6, m = 1.5", COSINE, {"c": 1e-6, "m": 1.5}),
    ("Cook-Torrance, N = L = V = (0.36, 0.48, 0.8)", TERM, {"n": TILTED, "l": TILTED, "v": TILTED}),
    ("Cook-Torrance, N.L = 0", TERM, {"n": UP, "l": RIGHT, "v": UP}),
    ("Cook-Torrance, V = -L", TERM, {"n": UP, "l": RIGHT, "v": LEFT}),
    (
        "Cook-Torrance, light and camera below",
        TERM,
        {"n": UP, "l": [0.6, 0, -0.8], "v": [0, 0, -1]},
    ),
    (
        "Ward as printed, light and camera below",
        WARD,
        {"n": UP, "l": [0.6, 0, -0.8], "v": [0, 0, -1]},
    ),
    ("Ward as printed, V = -L", WARD, {"n": UP, "l": RIGHT, "v": LEFT}),
)


def include(name: str, *defines: str) -> str:
    """Return a file of the library with its includes resolved, after ``#define`` lines."""
    lines = [*(f"#define {text}" for text in defines), f'#include "{name}.glsl"', ""]
    return resolve_includes("\n".join(lines))


MODELS: tuple[tuple[str, str, Callable[..., Any], int], ...] = (
    ("cook_torrance", COOK_TORRANCE, partial(brdf.cook_torrance, f0=0.028), 4),
    ("ward", "fr_ward(n, l, v, m)", brdf.ward, 0),
)


def float32(evaluate: Evaluator) -> list[dict[str, float]]:
    """Return the largest relative errors of the exact models, where the lobe is above 1e-3 of its
    peak.

    Each row has three errors per model: against float64 of the same float32 vectors, the same with
    FR_SMALL_SLOPE 0 (``_plain``), and against float64 of the unrounded directions (``_true``).
    """
    rows = []
    for m in SLOPES:
        slopes = np.full(COUNT, m, np.float32)
        true = true_directions(slopes, lowest=0.02)
        inputs = {axis: values.astype(np.float32) for axis, values in true.items()}
        same = [values.astype(np.float64) for values in inputs.values()]
        n, l, v = same
        c = (n * (l + v)).sum(axis=-1) / np.linalg.norm(l + v, axis=-1)
        row = {"m": m}
        for name, call, model, k in MODELS:
            shown = lobes.exact(c.clip(0.0, 1.0), m, k) > 1e-3
            for suffix, vectors, small in (
                ("", same, 1),
                ("_plain", same, 0),
                ("_true", true.values(), 1),
            ):
                expected = model(*vectors, m=float(slopes[0]))[shown]
                prelude = include(f"facerender/{name}", f"FR_SMALL_SLOPE {small}")
                result = evaluate(prelude, call, inputs | {"m": slopes})[shown]
                row[name + suffix] = float((np.abs(result - expected) / expected).max())
        rows.append(row)
    return rows


def extremes(evaluate: Evaluator) -> list[dict[str, str]]:
    """Return the values of the published formulas and of the library, as text because of NaN."""
    rows = []
    for label, (naive, naive_file, ours, file), values in EXTREMES:
        inputs = {name: np.array([at], np.float32) for name, at in {"m": 0.3, **values}.items()}
        printed = evaluate(include(naive_file), naive, inputs)[0]
        own = evaluate(include(file), ours, inputs)[0]
        rows.append({"input": label, "printed": f"{printed:.4g}", "facerender": f"{own:.4g}"})
    return rows


def main() -> None:
    evaluate = Evaluator(create_context().gl)
    save("accuracy", float32=float32(evaluate), extremes=extremes(evaluate))


if __name__ == "__main__":
    main()
