"""Cases of every public function of the shader library: an expression, its inputs, what float64
makes of them, and how far a target may be from it.

The bounds come from the precision that OpenGL and Vulkan ask of drivers, in units of the last place
(2^-23): division 2.5, inversesqrt 2, exp2(x) 3 + 2|x|, log2 3 and 2^-21 absolute in [0.5, 2]; sums
and products 0.5.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender import brdf, lobes, resolve_includes
from facerender.drawing.evaluate import Inputs
from facerender.glsl.code import defines, lobe_macros
from facerender.lobes import GPower
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS, AnyLobe, Fresnel, Masking, lobe_entry
from facerender.terms.entry import ULP
from facerender.terms.lobe import TINY, TITLES, power_error

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

DIRECTIONS = 20_000  # for each BRDF


def singles(values: ArrayLike) -> Singles:
    return np.asarray(values, dtype=np.float32)


COSINES = singles(
    [*np.cos(np.linspace(0.0, np.pi / 2, 500)).clip(0), 1.0 - 2.0**-24, 1e-3, 1e-10, 1e-30]
)


class Each(Protocol):
    """Evaluates expressions of the same inputs, such as an Evaluator."""

    def each(self, prelude: str, expressions: list[str], inputs: Inputs, /) -> Singles: ...


@dataclass(frozen=True, eq=False)
class Case:
    """An expression of inputs, what float64 makes of them, and how far the GPU may be from it."""

    prelude: str
    expression: str
    inputs: Inputs
    expected: Floats
    relative: Floats | float = 0.0
    absolute: Floats | float = 0.0

    def share(self, result: Singles) -> Floats:
        """How much of its bound each result uses: up to 1."""
        error = np.abs(result - self.expected)
        bound = self.relative * self.expected + self.absolute
        return np.divide(error, bound, out=np.where(error > 0.0, np.inf, 0.0), where=bound > 0.0)

    def fault(self, result: Singles) -> str:
        """Tell the worst of the results that are not finite, negative or beyond their bound; ""
        where none is."""
        share = np.where(np.isfinite(result) & (result >= 0.0), self.share(result), np.inf)
        worst = int(share.argmax())
        at = {name: values[worst].tolist() for name, values in self.inputs.items()}
        return (
            f"{result[worst]} in place of {self.expected[worst]} at {at}: "
            f"{share[worst]:.2f} times the bound"
            if share[worst] > 1.0
            else ""
        )


CASES: dict[str, Callable[[], Case]] = {}


def case(*parameters: object) -> Callable[[Callable[..., Case]], Callable[..., Case]]:
    """Register a maker of cases, once for each parameter."""

    def register(make: Callable[..., Case]) -> Callable[..., Case]:
        for parameter in parameters or ((),):
            values = parameter if isinstance(parameter, tuple) else (parameter,)
            name = " ".join(["fr_" + make.__name__, *map(str, values)])
            CASES[name] = partial(make, *values)
        return make

    return register


@cache
def cases_of(function: str) -> dict[str, Case]:
    """Return the cases of one of FUNCTIONS by name."""
    return {name: make() for name, make in CASES.items() if name.split()[0] == function}


def evaluated(cases: Mapping[str, Case], target: Each) -> dict[str, Singles]:
    """Return what a target makes of cases; those of one prelude and the same inputs are drawn
    together."""
    together: dict[tuple[str, int], dict[str, Case]] = {}
    for name, each in cases.items():
        together.setdefault((each.prelude, id(each.inputs)), {})[name] = each
    results: dict[str, Singles] = {}
    for (prelude, _), group in together.items():
        inputs = next(iter(group.values())).inputs
        values = target.each(prelude, [each.expression for each in group.values()], inputs)
        results |= zip(group, values, strict=True)
    return results


@cache
def include(name: str) -> str:
    """Return a file of the library as flat text."""
    return resolve_includes(f'#include "facerender/{name}.glsl"\n')


def chosen(name: str, lobe: AnyLobe, **macros: str) -> str:
    """Return a file with a lobe, and further macros."""
    return defines(lobe_macros(lobe) | macros) + include(name)


def every(name: str, **macros: str) -> str:
    """Return a file with every lobe, and further macros."""
    return defines({"FR_LOBE": "FR_LOBE_EVERY"} | macros) + include(name)


def grid(*axes: ArrayLike) -> list[Singles]:
    return [axis.ravel() for axis in np.meshgrid(*map(singles, axes), indexing="ij")]


@cache
def slopes(end: float) -> Singles:
    """From end to end of a lobe's domain."""
    return singles([1e-4, 1e-3, 0.01, 0.05, *np.linspace(0.1, 0.99, 8) * end, 0.9999 * end])


@cache
def cosines_and_slopes(end: float) -> dict[str, Singles]:
    return dict(zip("cm", grid(COSINES, slopes(end)), strict=True))


def of_the_cosine(name: AnyLobe, k: int) -> tuple[dict[str, Singles], Floats, Floats]:
    """The inputs c and m, and both in float64."""
    inputs = cosines_and_slopes(lobes.max_slope(name, k))
    return inputs, inputs["c"].astype(float), inputs["m"].astype(float)


@case()
def slope_factor() -> Case:
    x = singles([0.0, *np.logspace(-8, 8, 400), 1e20])
    relative = ULP * (4.0 + 5.0 * np.minimum(x, 100.0))
    expected = np.exp(-x.astype(float))
    return Case(include("lobe/exact"), "fr_slope_factor(x)", {"x": x}, expected, relative, TINY)


@cache
def tangents_and_slopes() -> dict[str, Singles]:
    m = [*slopes(lobes.MAX_SLOPE), 2.0]
    tan2 = [0.0, *np.logspace(-12, 6, 300), 1e20, np.inf]
    return dict(zip(("tan2", "m"), grid(tan2, m), strict=True))


@case(0, 4)
def lobe_exact_tan2(k: int) -> Case:
    inputs = tangents_and_slopes()
    tan2, m = inputs.values()
    exponent = np.minimum(tan2 / m.astype(float) ** 2, 100.0)
    # m^2 and the division: 3 ulp of the exponent; exp2: 3 + 2 x; 1/c^4: 2
    smallest = TINY * (1.0 + np.minimum(tan2, 1e3)) ** 2  # E flushed to zero, times 1/c^4
    expected = lobes.exact_tan2(tan2, m, k)
    relative = ULP * (5.0 + 6.0 * exponent)
    call = f"fr_lobe_exact_tan2(tan2, m, {k})"
    return Case(include("lobe/exact"), call, inputs, expected, relative, smallest)


def lobe_function(k: int, name: str) -> Case:
    """The function of a lobe of the registry, over its whole domain."""
    entry = LOBES[name]
    inputs, c, m = of_the_cosine(name, k)
    call = re.sub(r"\bk\b", str(k), entry.call)
    expected = entry.evaluate(c, m, k)
    return Case(include(entry.file), call, inputs, expected, *entry.rounding(c, m, k))


for _entry in LOBES.values():
    for _k in TITLES:
        _name = f"{_entry.call.split('(')[0]} {_k} {_entry.name}"
        CASES[_name] = partial(lobe_function, _k, _entry.name)


@cache
def cosines_and_steepness() -> dict[str, Singles]:
    axes = grid(COSINES, [0.0, 0.1, 1.0, 3.0, 30.0, 1e3, 1e8])
    return dict(zip(("c", "steepness"), axes, strict=True))


@case(*range(1, 32))
def lobe_clamped_power(g: int) -> Case:
    inputs = cosines_and_steepness()
    c, steepness = (values.astype(float) for values in inputs.values())
    # the base 1 - s u: the product by 0.5 ulp, the differences by 0.5 each
    error = ULP * steepness * (1.0 - c) + ULP
    absolute = power_error(1.0 - steepness * (1.0 - c), error, g) + TINY
    expected = lobes.clamped_power(c, steepness, g)
    call = f"fr_lobe_clamped_power(c, steepness, {g})"
    return Case(include("lobe/g_power"), call, inputs, expected, ULP * g, absolute)


@cache
def slopes_alone(end: float) -> dict[str, Singles]:
    return {"m": slopes(end)}


COEFFICIENTS = [(k, "fitted", i) for k in (0, 4) for i in range(3)]
COEFFICIENTS += [(k, "fitted-fine", i) for k in (0, 4) for i in range(4)]


@case(*COEFFICIENTS)
def lobe_fitted_coefficients(k: int, name: str, i: int) -> Case:
    lobe = lobes.FITTED[name, k]
    inputs = slopes_alone(lobe.max_slope)
    m = inputs["m"].astype(float)
    expected = lobe.coefficients(m)[:, i] * m ** (2 * (i + 1))
    function = f"fr_lobe_{name.replace('-', '_')}_coefficients"
    # scaled back by the same powers of m^2, in an order that cannot overflow
    call = f"3.0 + {function}(m, {k})[{i}]" + " * (m * m)" * (i + 1)
    absolute = 16.0 * ULP * (3.0 + lobe.magnitudes(m)[:, i])
    return Case(include("lobe/fitted"), call, inputs, 3.0 + expected, 0.0, absolute)


@cache
def reflectances_and_cosines() -> dict[str, Singles]:
    f0 = [0.0, 1e-8, 1e-4, 0.028, 0.1, 0.5, 0.9]
    return dict(zip(("f0", "c"), grid(f0, [*np.linspace(0, 1, 501), 1e-9, 1e-20]), strict=True))


def fresnel_function(entry: Fresnel) -> Case:
    """The function of a Fresnel term of the registry."""
    inputs = reflectances_and_cosines()
    f0, c = (values.astype(float) for values in inputs.values())
    call = entry.call.replace("v_dot_h", "c")
    return Case(include("fresnel"), call, inputs, entry.evaluate(f0, c), *entry.rounding(f0, c))


def masking_ratio(entry: Masking, call: str) -> Case:
    """G/((N.L)(N.V)) of a masking term of the registry."""
    axes = grid([1e-6, 1e-3, *np.linspace(0.01, 1.0, 20)], [1e-6, *np.linspace(0.01, 1.0, 20)],
                [1.0, 1.001, 1.1, 2.0])  # fmt: skip
    n_dot_l, n_dot_v, longer = axes
    h_dot_h = singles((n_dot_l + n_dot_v) ** 2 * longer)
    inputs = {"n_dot_l": n_dot_l, "n_dot_v": n_dot_v, "h_dot_h": h_dot_h}
    nl, nv, hh = (values.astype(float) for values in inputs.values())
    expected = entry.evaluate((nl + nv) / np.sqrt(hh), 0.5 * np.sqrt(hh), nl, nv) / (nl * nv)
    ratio = call.replace("n_dot_h", "n_dot_l + n_dot_v")
    expression = f"{ratio}.x / ({ratio}.y * h_dot_h)"
    return Case(include("masking"), expression, inputs, expected, 12 * ULP)


for _fresnel in FRESNEL.values():
    if _fresnel.call.startswith("fr_"):
        CASES[_fresnel.call.split("(")[0]] = partial(fresnel_function, _fresnel)
for _masking in MASKING.values():
    _of = f"fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, {_masking.macro})"
    CASES[f"fr_masking_of {_masking.name}"] = partial(masking_ratio, _masking, _of)
    if _masking.call.startswith("fr_"):
        CASES[_masking.call.split("(")[0]] = partial(masking_ratio, _masking, _masking.call)


@case()
def masking_v_cavity() -> Case:
    axis = [1e-6, 1e-3, *np.linspace(0.01, 1.0, 10)]
    names = ("n_dot_h", "v_dot_h", "n_dot_l", "n_dot_v")
    inputs = dict(zip(names, grid(axis, axis, axis, axis), strict=True))
    expected = brdf.masking_v_cavity(*inputs.values())
    call = f"fr_masking_v_cavity({', '.join(names)})"
    return Case(include("masking"), call, inputs, expected, 4 * ULP)


@case()
def masking_kelemen() -> Case:
    axis = [1e-6, 1e-3, *np.linspace(0.01, 1.0, 20)]
    names = ("v_dot_h", "n_dot_l", "n_dot_v")
    inputs = dict(zip(names, grid(axis, axis, axis), strict=True))
    expected = brdf.masking_kelemen(*inputs.values())
    call = f"fr_masking_kelemen({', '.join(names)})"
    return Case(include("masking"), call, inputs, expected, 8 * ULP)


OWN = GPower(11, 0.2, 0.5)
STEEP = GPower(5, 1.2, 0.8)


@case(*((k, name) for k in (0, 4) for name in (*LOBES, OWN, STEEP)))
def lobe(k: int, name: AnyLobe) -> Case:
    """The choice at compile time; what was chosen is tested above."""
    return lobe_case(k, name, chosen("lobe", name))


@case(*((k, g) for k in (0, 4) for g in (None, 5)))
def lobe_default_g_power(k: int, g: int | None) -> Case:
    """Of the macros of a g-power, one or none: D8, or its steepness with another power."""
    said = f"#define FR_G {g}\n" if g else ""
    prelude = f"{said}#define FR_LOBE FR_LOBE_G_POWER\n" + include("lobe")
    return lobe_case(k, GPower(g, 2.0 / g, k / g) if g else "d8", prelude)


@case(*((k, name) for k in (0, 4) for name in (*LOBES, OWN)))
def lobe_of(k: int, name: AnyLobe) -> Case:
    """The choice by a constant, where every lobe is there."""
    entry = lobe_entry(name)
    call = f"fr_lobe_of(c, m, {k}, {entry.macro})"
    return lobe_case(k, name, every("lobe", **entry.macros), call)


@case(*((k, lobe) for k in (0, 4) for lobe in ("", "FR_LOBE_OWN", "FR_LOBE_EVERY")))
def lobe_of_the_host(k: int, lobe: str) -> Case:
    """A function that the host names; with every lobe there it is called by its constant."""
    said = f"#define FR_LOBE {lobe}\n" if lobe else ""
    prelude = (
        "highp float own(highp float c, highp float m, int k) { return c * m + float(k); }\n"
        f"#define FR_LOBE_FUNCTION own\n{said}{include('lobe')}"
    )
    inputs = cosines_at_one_slope()
    expected = inputs["c"].astype(float) * inputs["m"] + k
    call = f"fr_lobe_of(c, m, {k}, FR_LOBE_OWN)" if "EVERY" in lobe else f"fr_lobe(c, m, {k})"
    return Case(prelude, call, inputs, expected, 4 * ULP)


@cache
def cosines_at_one_slope() -> dict[str, Singles]:
    c = singles(np.linspace(0.5, 1.0, 200))
    return {"c": c, "m": np.full_like(c, 0.3)}


def lobe_case(k: int, name: AnyLobe, prelude: str, call: str = "") -> Case:
    inputs = cosines_at_one_slope()
    expected = lobes.lobe(name, inputs["c"], inputs["m"], k)
    return Case(prelude, call or f"fr_lobe(c, m, {k})", inputs, expected, 1e-4, 1e-5)


KINDS = tuple(FRESNEL)


@case(*KINDS)
def fresnel(kind: str) -> Case:
    prelude = f"#define FR_FRESNEL {FRESNEL[kind].macro}\n" + include("fresnel")
    return fresnel_case(kind, "fr_fresnel(0.1, c)", prelude)


@case(*KINDS)
def fresnel_of(kind: str) -> Case:
    """Whatever the host chose for fr_fresnel."""
    other = KINDS[KINDS.index(kind) - 1]
    prelude = f"#define FR_FRESNEL {FRESNEL[other].macro}\n" + include("fresnel")
    return fresnel_case(kind, f"fr_fresnel_of(0.1, c, {FRESNEL[kind].macro})", prelude)


def fresnel_case(kind: str, call: str, prelude: str) -> Case:
    c = singles(np.linspace(0.0, 1.0, 101))
    return Case(prelude, call, {"c": c}, brdf.fresnel(0.1, c, kind), 1e-5, 1e-6)


def directions(m: Singles, lowest: float = 1e-5) -> dict[str, Singles]:
    """Draw a normal, a light and an eye for each slope, as float32 rounds them: N.L and N.V above
    ``lowest``, half of them log-uniform; half of the half vectors anywhere, half with tangents from
    0 to 3 m, dense near 0."""
    random = np.random.default_rng(7)
    count = len(m)

    def unit(x: Floats) -> Floats:
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


@cache
def directions_at_five_slopes() -> dict[str, Singles]:
    return directions(np.resize(singles([1e-4, 1e-3, 0.01, 0.1, 1.0]), DIRECTIONS))


@case(*((axis, small_slope) for axis in "xy" for small_slope in (0, 1)))
def half_vector(axis: str, small_slope: int) -> Case:
    """The header's bound is of the sine of the angle, or of its square."""
    inputs = directions_at_five_slopes()
    n, l, v = (inputs[name].astype(float) for name in "nlv")
    h = l + v
    length2 = (h * h).sum(axis=-1)
    sine2 = (np.cross(n, h) ** 2).sum(axis=-1) / (n * n).sum(axis=-1) / length2
    error = 3e-7 * (1.0 + 1.0 / (n * h).sum(axis=-1))
    expected, absolute = {
        "x": (length2, 2.0 * error * length2),
        "y": (length2 * sine2, length2 * error),
    }[axis]
    if axis == "y" and small_slope:
        absolute *= 2.0 * np.sqrt(sine2) + error
    prelude = f"#define FR_SMALL_SLOPE {small_slope}\n" + include("half_vector")
    call = f"fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).{axis}"
    return Case(prelude, call, inputs, expected, 0.0, absolute)


@dataclass(frozen=True)
class Brdf:
    """A function of a model.

    Attributes
    ----------
    model, fresnel, masking : names of the registry
    by_call : the terms are arguments, with every lobe there; they are macros elsewhere
    """

    model: str
    fresnel: str = "schlick"
    masking: str = "v-cavity"
    by_call: bool = False

    def __str__(self) -> str:
        terms = f" {self.fresnel} {self.masking}" if MODELS[self.model].factors else ""
        return f"fr_{MODELS[self.model].file}{'_terms' * self.by_call}{terms}"

    def glsl(self, lobe: AnyLobe, small_slope: int) -> tuple[str, str]:
        """Return prelude and call, of n, l, v, m; a model without a Fresnel term has f0 = 1."""
        model, macros = MODELS[self.model], {"FR_SMALL_SLOPE": str(small_slope)}
        fresnel, masking = FRESNEL[self.fresnel].macro, MASKING[self.masking].macro
        entry = lobe_entry(lobe)
        if self.by_call:
            call = model.call.format(m="m", lobe=entry.macro, fresnel=fresnel, masking=masking)
            call = call.replace("f0 * ", "").replace("f0", "0.028")
            return every(model.file, **(entry.macros | macros)), call
        if model.factors:
            macros |= {"FR_FRESNEL": fresnel, "FR_MASKING": masking}
        arguments = "n, l, v, m, 0.028" if model.factors else "n, l, v, m"
        return chosen(model.file, lobe, **macros), f"fr_{model.file}({arguments})"


BRDFS = (
    Brdf("cook-torrance"),
    *(Brdf("cook-torrance", fresnel) for fresnel in FRESNEL if fresnel != "schlick"),
    *(Brdf("cook-torrance", masking=masking) for masking in MASKING if masking != "v-cavity"),
    *(Brdf(model.name) for model in MODELS.values() if not model.factors),
    Brdf("cook-torrance", "constant", "none", by_call=True),
    Brdf("cook-torrance", "dielectric", "kelemen", by_call=True),
    *(Brdf(model.name, by_call=True) for model in MODELS.values()),
)


def brdf_case(of: Brdf, lobe: AnyLobe, small_slope: int, inputs: Inputs) -> Case:
    """A BRDF at directions; the bounds are those of its header, relative to what the lobe's peak
    gives in the same directions, and none where it is exactly 0."""
    model, entry = MODELS[of.model], lobe_entry(lobe)
    n, l, v, m = (inputs[axis].astype(float) for axis in "nlvm")
    n_dot_l, n_dot_v = ((n * x).sum(axis=-1) for x in (l, v))
    above = (n_dot_l > brdf.MIN_COSINE) & (n_dot_v > brdf.MIN_COSINE)
    n_dot_l, n_dot_v = (cosine.clip(brdf.MIN_COSINE) for cosine in (n_dot_l, n_dot_v))
    v_dot_h = 0.5 * np.linalg.norm(l + v, axis=-1).clip(1e-30)
    f0 = 0.028 if model.factors else 1.0
    expected = model.evaluate(
        *(n, l, v, m, f0), lobe=lobe, fresnel_term=of.fresnel, masking_term=of.masking
    )
    if model.factors:
        n_dot_h = (n_dot_l + n_dot_v) / (2.0 * v_dot_h)
        masked = MASKING[of.masking].evaluate(n_dot_h, v_dot_h, n_dot_l, n_dot_v)
        peak = masked / (n_dot_l * n_dot_v) * FRESNEL[of.fresnel].evaluate(f0, v_dot_h)
    else:
        peak = (n_dot_v + v_dot_h if "printed" in of.model else n_dot_l * n_dot_v) ** -0.5
    peak /= 4.0 * np.pi * m**2
    if entry.highest is not None:
        peak *= np.vectorize(entry.highest)(m, model.k)
    accurate = entry.of_tan2 is not None and small_slope
    e = entry.amplified(4e-7 * (1.0 + 1.0 / (n_dot_l + n_dot_v)))
    bound = 1e-5 + 2e-7 / n_dot_l + 2e-7 / n_dot_v + e / (m if accurate else m**2)
    absolute = np.where(above, peak * bound, 0.0)
    return Case(*of.glsl(lobe, small_slope), inputs, expected, 0.0, absolute)


EXTREMES = {
    "light below": ([0.6, 0, -0.8], [0, 0, 1]),
    "eye below": ([0, 0, 1], [0.6, 0, -0.8]),
    "light on the horizon": ([1, 0, 0], [0, 0, 1]),
    "V = -L": ([0.6, 0, 0.8], [-0.6, 0, -0.8]),
    "V = -L on the horizon": ([1, 0, 0], [-1, 0, 0]),
    "both on the horizon": ([1, 0, 0], [0, 1, 0]),
    "nearly on the horizon": ([1, 0, 1e-20], [-1, 0, 1e-20]),
    "light 5e-7 above the horizon": ([1, 0, 5e-7], [0, 0, 1]),
    "eye 5e-7 above the horizon": ([0, 0, 1], [1, 0, 5e-7]),
    "N = H, 1e-5 above the horizon": ([1, 0, 1e-5], [-1, 0, 1e-5]),
    "light 1e-5 above the horizon": ([1, 0, 1e-5], [0.6, 0, 0.8]),
    "longer by 1e-6": ([0, 0, 1.000001], [0, 0, 1.000001]),
    "L = V, at 1e-4": ([1e-4, 0, 1], [1e-4, 0, 1]),
}


def extremes(m: list[float]) -> dict[str, Singles]:
    """Each of them at each slope."""
    light, eye = (singles(vectors) for vectors in zip(*EXTREMES.values(), strict=True))
    n = np.tile(singles([0, 0, 1]), (len(light) * len(m), 1))
    l, v = (np.tile(vectors, (len(m), 1)) for vectors in (light, eye))
    return {"n": n, "l": l, "v": v, "m": np.repeat(singles(m), len(light))}


@cache
def directions_and_extremes(end: float) -> dict[str, Singles]:
    """At slopes of a whole domain."""
    m = singles([1e-4, 1e-3, 0.01, *np.geomspace(0.05, 0.999, 12) * end])
    parts = directions(np.resize(m, DIRECTIONS + 1)), extremes([1e-4, 1e-2, 0.3, 0.99 * end])
    return {axis: np.concatenate([part[axis] for part in parts]) for axis in "nlvm"}


def brdf_in_domain(of: Brdf, lobe: AnyLobe, small_slope: int) -> Case:
    end = lobe_entry(lobe).end(MODELS[of.model].k)
    return brdf_case(of, lobe, small_slope, directions_and_extremes(end))


for _brdf in BRDFS:
    for _lobe, _small in [*((lobe, 1) for lobe in (*LOBES, OWN, STEEP)), ("exact", 0)]:
        CASES[f"{_brdf} {_lobe} {_small}"] = partial(brdf_in_domain, _brdf, _lobe, _small)

FUNCTIONS = tuple(dict.fromkeys(name.split()[0] for name in CASES))
