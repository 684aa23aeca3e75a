"""Writes docs/accuracy.md: what every lobe loses, where it may be used, and what float32 does.

python -m tools.docs.accuracy        from the repository's root; needs an OpenGL context
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from facerender import brdf, lobes, resolve_includes
from facerender.drawing.context import create_context
from facerender.drawing.evaluate import Evaluator
from facerender.lobes import AnyLobe
from facerender.measure import error
from facerender.measure.tables import markdown_table
from facerender.terms.fitting import G_POWERS, fit_g_power
from tests.verification.cases import true_directions
from tools.docs.template import missing

OUTPUT = Path(__file__).parents[2] / "docs/accuracy.md"
MODELS = {4: "Cook-Torrance", 0: "Ward"}
SLOPES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 1.0)
COUNT = 200_000
GPU_HEAD = (
    "m",
    *("Cook-Torrance", "FR_SMALL_SLOPE 0", "of true directions"),
    *("Ward", "FR_SMALL_SLOPE 0", "of true directions"),
)
EXTREMES_HEAD = ("input", "as printed", "facerender")


def lobe_error(name: AnyLobe, m: float, k: int) -> float:
    """Largest difference from the exact lobe in % of its peak, over 0 to 90 degrees."""
    degrees = np.concatenate(
        [np.linspace(0.0, 90.0, 20001), np.degrees(np.linspace(0, 8 * m, 20001))]
    )
    return 100.0 * float(np.abs(error.lobe_error(name, m, k, degrees[degrees <= 90.0])).max())


def lobe_tables() -> str:
    """Errors over m, for both models, and the domains."""
    names = [name for name in lobes.NAMES if name != "exact"]
    parts = []
    for k, model in MODELS.items():
        rows = []
        for m in SLOPES:
            inside = {name: bool(lobes.in_domain(m, name, k)) for name in names}
            errors = [f"{lobe_error(name, m, k):.3g}" if inside[name] else "-" for name in names]
            if any(inside.values()):
                rows.append([f"{m:g}", *errors])
        parts.append(f"### {model}\n\n" + markdown_table(["m", *names], rows))
    domains = [
        [name, *(f"{lobes.MIN_SLOPE:g} to {lobes.max_slope(name, k):.4g}" for k in MODELS)]
        for name in lobes.NAMES
    ]
    parts.append("### Domains of m\n\n" + markdown_table(["lobe", *MODELS.values()], domains))
    return "\n\n".join(parts)


def fitted_g_powers() -> str:
    """The best of all g for single slopes, beside the paper's three."""
    rows = []
    for m in SLOPES:
        row = [f"{m:g}"]
        for k in MODELS:
            fits = [fit_g_power(k, g, m, m) for g in G_POWERS]
            errors = {lobe.g: lobe_error(lobe, m, k) for lobe in fits if lobe is not None}
            g = min(errors, key=errors.__getitem__)
            paper = [
                lobe_error(name, m, k)
                for name in ("d4", "d8", "d16")
                if lobes.in_domain(m, name, k)
            ]
            row += [str(g), f"{errors[g]:.2g}", f"{min(paper):.2g}" if paper else "-"]
        rows.append(row)
    head = [f"{model}{what}" for model in MODELS.values() for what in (", g", "", ", d4 to d16")]
    return markdown_table(["m", *head], rows)


def include(name: str, *defines: str) -> str:
    lines = [*(f"#define {text}" for text in defines), f'#include "{name}.glsl"', ""]
    return resolve_includes("\n".join(lines))


def gpu_table(evaluate: Evaluator) -> str:
    """Largest relative error of whole exact terms where the lobe is above 1e-3 of its peak."""
    rows = []
    for m in (1e-4, 1e-3, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0):
        slopes = np.full(COUNT, m, np.float32)
        true = true_directions(slopes, lowest=0.02)
        inputs = {axis: values.astype(np.float32) for axis, values in true.items()}
        given = [values.astype(np.float64) for values in inputs.values()]
        n, l, v = given
        c = (n * (l + v)).sum(axis=-1) / np.linalg.norm(l + v, axis=-1)
        cells = [f"{m:g}"]
        for name, call, model, k in (
            ("cook_torrance", COOK_TORRANCE, partial(brdf.cook_torrance, f0=0.028), 4),
            ("ward", "fr_ward(n, l, v, m)", brdf.ward, 0),
        ):
            shown = lobes.exact(c.clip(0.0, 1.0), m, k) > 1e-3
            for vectors, small in ((given, 1), (given, 0), (true.values(), 1)):
                expected = model(*vectors, m=float(slopes[0]))[shown]
                prelude = include(f"facerender/{name}", f"FR_SMALL_SLOPE {small}")
                result = evaluate(prelude, call, inputs | {"m": slopes})[shown]
                cells.append(f"{(np.abs(result - expected) / expected).max():.1e}")
        rows.append(cells)
    return markdown_table(GPU_HEAD, rows)


UP, LEFT, RIGHT = [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]
TILTED = [0.36, 0.48, 0.8]
ABOVE_1 = 1.0 + 2.0**-23
COOK_TORRANCE = "fr_cook_torrance(n, l, v, m, 0.028)"

# naive expression, its file; ours, its file
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
EXTREMES = (
    ("lobe, c = 0", LOBE, {"c": 0.0}),
    ("lobe, c one ulp above 1, m = 1e-4", LOBE, {"c": ABOVE_1, "m": 1e-4}),
    ("angle of c one ulp above 1, for the lobe", ANGLE, {"c": ABOVE_1}),
    ("D16, 90 degrees, m = 0.2", D16, {"c": 0.0, "m": 0.2}),
    ("D16, 90 degrees, m = 0.02", D16, {"c": 0.0, "m": 0.02}),
    ("cosine power, c = 1e-6, m = 1.5", COSINE, {"c": 1e-6, "m": 1.5}),
    ("Cook-Torrance, N = L = V = (0.36, 0.48, 0.8)", TERM, {"n": TILTED, "l": TILTED, "v": TILTED}),
    ("Cook-Torrance, N.L = 0", TERM, {"n": UP, "l": RIGHT, "v": UP}),
    ("Cook-Torrance, V = -L", TERM, {"n": UP, "l": RIGHT, "v": LEFT}),
    ("Cook-Torrance, light and eye behind", TERM, {"n": UP, "l": [0.6, 0, -0.8], "v": [0, 0, -1]}),
    (
        "Ward as printed, light and eye behind",
        WARD,
        {"n": UP, "l": [0.6, 0, -0.8], "v": [0, 0, -1]},
    ),
    ("Ward as printed, V = -L", WARD, {"n": UP, "l": RIGHT, "v": LEFT}),
)


def extremes_table(evaluate: Evaluator) -> str:
    rows = []
    for what, (naive, naive_file, ours, file), values in EXTREMES:
        inputs = {name: np.float32([value]) for name, value in ({"m": 0.3} | values).items()}
        results = (
            evaluate(include(naive_file), naive, inputs),
            evaluate(include(file), ours, inputs),
        )
        rows.append([what, *(f"{result[0]:.4g}" for result in results)])
    return markdown_table(EXTREMES_HEAD, rows)


TEXT = """# Accuracy

Written by `python -m tools.docs.accuracy`. `python -m tools.docs --check` holds the tables of the lobes to the
code; the suite holds every bound that a shader's header states.

## What an approximation loses

Largest difference from the exact lobe E/c^k, E = exp(-tan^2(gamma)/m^2), over 0 to 90 degrees, in
percent of the lobe's peak. `cosine`, `d4`, `d8` and `d16` are those of Romanyuk et al. (2020),
clamped; `fitted` is a cubic to the power 5, `fitted-fine` a quartic to the power 8. Their
coefficients are polynomials in m^2 (`facerender/terms/fitting.py`): a slope from a map loses no
more than one for the whole mesh. "-" is outside the lobe's domain: there the package refuses, or
takes the exact lobe with `--outside exact`.

{lobes}

The end of the domain belongs to it, but for `cosine`, `d4`, `d8` and `d16` in Cook-Torrance, whose
exponent 2/m^2 - 4 is 0 there. In the shaders a larger m gives a finite number without meaning.

## One slope for all

Where m is one constant, a g-power may have the g and the steepness that suit it
(`facerender.terms.fitting.fit_g_power`, `lobes.GPower`, `facerender plan`), at the cost of D4 to
D16 and a small share of their error: the best g of {powers}, with its error in percent
of the peak, and the best of `d4`, `d8` and `d16`.

{fitted}

## What float32 adds to the exact terms

Largest relative error of a whole term, from float32 vectors N, L and V to 1/sr, against float64 of
the same vectors, wherever the lobe is above a thousandth of its peak and N.L and N.V above 0.02;
{count:,} random directions for each m. `FR_SMALL_SLOPE 0` is the cheaper form for m above 0.2.
Under "of true directions" float64 has the directions from before they were rounded to float32: what
a narrow lobe loses is then the inputs', not the shader's. A host that computes them in float32,
with some roundings more, loses some times as much.

{gpu}

## Extremes

What the formulas as printed give in float32, and what the library gives; m = 0.3 where nothing else
is said.

{extremes}

The last two tables: {renderer}, OpenGL {version}.
"""


def stale() -> Iterator[str]:
    """Tell what the document has otherwise, as far as it needs no OpenGL."""
    yield from missing(OUTPUT, TEXT, (GPU_HEAD, EXTREMES_HEAD))
    text = OUTPUT.read_text(encoding="utf-8")
    if lobe_tables() not in text:
        yield "other tables of the lobes"
    if fitted_g_powers() not in text:
        yield "another table of one slope for all"


def main() -> None:
    evaluate = Evaluator(create_context().gl)
    text = TEXT.format(
        lobes=lobe_tables(),
        fitted=fitted_g_powers(),
        powers=", ".join(map(str, G_POWERS)),
        gpu=gpu_table(evaluate),
        extremes=extremes_table(evaluate),
        count=COUNT,
        renderer=evaluate.renderer,
        version=evaluate.version,
    )
    OUTPUT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
