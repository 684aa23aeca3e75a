"""Every public function of the shader library against float64, and the library's conventions.

The bounds come from the precision that OpenGL and Vulkan ask of drivers, in units of the last place
(2^-23): division 2.5, inversesqrt 2, exp2(x) 3 + 2|x|, log2 3 and 2^-21 absolute in [0.5, 2]; sums
and products 0.5.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import moderngl
import numpy as np
import pytest
from numpy.typing import NDArray

from facerender import InputError, brdf, lobes, shader_dir, shader_source
from facerender.drawing.context import Backend, create_context
from facerender.lobes import GPower
from facerender.shading import defines, lobe_macros
from tests.gpu import Evaluator, directions

ULP = 2.0**-23
TINY = 1.2e-38  # where float32's full precision ends; drivers may flush what is smaller to zero
FILES = sorted((shader_dir() / "facerender").rglob("*.glsl"))
COSINES = np.float32(
    [*np.cos(np.linspace(0.0, np.pi / 2, 500)).clip(0), 1.0 - 2.0**-24, 1e-3, 1e-10, 1e-30]
)


@dataclass
class Case:
    """An expression of inputs, what float64 makes of them, and how far the GPU may be from it."""

    include: str
    expression: str
    inputs: dict[str, NDArray[np.float32]]
    expected: NDArray[np.float64]
    relative: NDArray[np.float64] | float = 0.0
    absolute: NDArray[np.float64] | float = 0.0

    def share(self, result: NDArray[np.float32]) -> NDArray[np.float64]:
        """How much of its bound each result uses: up to 1."""
        error = np.abs(result - self.expected)
        bound = self.relative * self.expected + self.absolute
        return np.divide(error, bound, out=np.where(error > 0.0, np.inf, 0.0), where=bound > 0.0)


CASES: dict[str, Callable[[], Case]] = {}


def case(*parameters: object) -> Callable[[Callable[..., Case]], Callable[..., Case]]:
    """Register a maker of cases, once for each parameter."""

    def register(make: Callable[..., Case]) -> Callable[..., Case]:
        for parameter in parameters or ((),):
            values = parameter if isinstance(parameter, tuple) else (parameter,)
            name = " ".join(["fr_" + make.__name__, *map(str, values)])
            CASES[name] = lambda values=values: make(*values)
        return make

    return register


def grid(*axes):
    return [axis.ravel() for axis in np.meshgrid(*map(np.float32, axes), indexing="ij")]


def slopes(name, k):
    """From end to end of the domain of the lobe."""
    end = lobes.max_slope(name, k)
    return np.float32([1e-4, 1e-3, 0.01, 0.05, *np.linspace(0.1, 0.99, 8) * end, 0.9999 * end])


@case()
def slope_factor():
    x = np.float32([0.0, *np.logspace(-8, 8, 400), 1e20])
    relative = ULP * (4.0 + 5.0 * np.minimum(x, 100.0))
    return Case(
        include("lobe/exact"),
        "fr_slope_factor(x)",
        {"x": x},
        np.exp(-x.astype(float)),
        relative,
        TINY,
    )


@case(0, 4)
def lobe_exact_tan2(k):
    tan2, m = grid([0.0, *np.logspace(-12, 6, 300), 1e20, np.inf], [*slopes("exact", k), 2.0])
    exponent = np.minimum(tan2 / m.astype(float) ** 2, 100.0)
    # m^2 and the division: 3 ulp of the exponent; exp2: 3 + 2 x; 1/c^4: 2
    smallest = TINY * (1.0 + np.minimum(tan2, 1e3)) ** 2  # E flushed to zero, times 1/c^4
    expected = lobes.exact_tan2(tan2, m, k)
    relative = ULP * (5.0 + 6.0 * exponent)
    call = f"fr_lobe_exact_tan2(tan2, m, {k})"
    return Case(include("lobe/exact"), call, {"tan2": tan2, "m": m}, expected, relative, smallest)


def of_the_cosine(name, k):
    c, m = grid(COSINES, slopes(name, k))
    return {"c": c, "m": m}, c.astype(float), m.astype(float)


@case(0, 4)
def lobe_exact(k):
    inputs, c, m = of_the_cosine("exact", k)
    x = c.clip(1e-3)
    exponent = np.minimum((1.0 / x**2 - 1.0) / m**2, 100.0)
    relative = ULP * (10.0 + 9.0 * exponent)  # as above, and five operations more for tan2
    smallest = TINY / np.maximum(x, 0.03) ** 4
    expected = lobes.exact(c, m, k)
    return Case(
        include("lobe/exact"), f"fr_lobe_exact(c, m, {k})", inputs, expected, relative, smallest
    )


@case(0, 4)
def lobe_cosine(k):
    inputs, c, m = of_the_cosine("cosine", k)
    n = 2.0 / m**2 - k
    x = c.clip(1e-30)
    power = np.minimum(n * -np.log2(x), 130.0)
    # n: 4 ulp, more where 2/m^2 - k cancels
    n_error = ULP * (3.0 * 2.0 / m**2 + k) / n
    log_error = np.where(x >= 0.5, 2.0**-21, 3.0 * ULP * -np.log2(x))
    exponent_error = np.log(2.0) * (power * n_error + n * log_error)
    relative = np.expm1(np.minimum(exponent_error, 80.0)) + ULP * (3.0 + 3.0 * power)
    expected = lobes.cosine(c, m, k)
    return Case(
        include("lobe/cosine"), f"fr_lobe_cosine(c, m, {k})", inputs, expected, relative, TINY
    )


def power_error(base, base_error, power):
    """What an error of the base makes of max(base, 0)^power."""
    return power * np.maximum(base + base_error, 0.0) ** (power - 1) * base_error


@case(*((k, g) for k in (0, 4) for g in (4, 8, 16)))
def lobe_g_power(k, g):
    inputs, c, m = of_the_cosine(f"d{g}", k)
    n = 2.0 / m**2 - k
    # the base 1 - (n/g) u: n by 4 ulp, n/g and the product by 3.5 more, the sum by 0.5
    error = ULP * (4.0 * 2.0 / m**2 + 4.0 * n) / g * (1.0 - c) + ULP
    absolute = power_error(1.0 - n / g * (1.0 - c), error, g) + TINY
    expected = lobes.g_power(c, m, k, g)
    call = f"fr_lobe_g_power(c, m, {k}, {g})"
    return Case(include("lobe/g_power"), call, inputs, expected, ULP * g, absolute)


@case(*range(1, 32))
def lobe_clamped_power(g):
    c, steepness = grid(COSINES, [0.0, 0.1, 1.0, 3.0, 30.0, 1e3, 1e8])
    inputs = {"c": c, "steepness": steepness}
    c, steepness = c.astype(float), steepness.astype(float)
    # the base 1 - s u: the product by 0.5 ulp, the differences by 0.5 each
    error = ULP * steepness * (1.0 - c) + ULP
    absolute = power_error(1.0 - steepness * (1.0 - c), error, g) + TINY
    expected = lobes.clamped_power(c, steepness, g)
    call = f"fr_lobe_clamped_power(c, steepness, {g})"
    return Case(include("lobe/g_power"), call, inputs, expected, ULP * g, absolute)


def fitted_terms(lobe, m):
    """Sums of |constants| of the coefficients, for their rounding."""
    table = np.abs(np.array(lobe.table))
    return np.stack([np.polynomial.polynomial.polyval(m**2, row) for row in table.T], axis=-1)


@case(*((k, name) for k in (0, 4) for name in ("fitted", "fitted-fine")))
def lobe_fitted(k, name):
    inputs, c, m = of_the_cosine(name, k)
    lobe = lobes.FITTED[name, k]
    v = ((1.0 - c) / m**2)[:, None] ** np.arange(1, len(lobe.table[0]) + 1)
    # a coefficient: 4 products and sums of its constants, 1/m^2 and its powers, times a power of u
    error = 20.0 * ULP * (fitted_terms(lobe, m) * v).sum(axis=-1) + ULP
    p = 1.0 + (lobe.coefficients(m) * (1.0 - c)[:, None] ** np.arange(1, v.shape[1] + 1)).sum(
        axis=-1
    )
    expected = lobes.lobe(name, c, m, k)
    call = f"fr_lobe_{name.replace('-', '_')}(c, m, {k})"
    relative = ULP * lobe.power
    return Case(
        include("lobe/fitted"),
        call,
        inputs,
        expected,
        relative,
        power_error(p, error, lobe.power) + TINY,
    )


COEFFICIENTS = [(k, "fitted", i) for k in (0, 4) for i in range(3)]
COEFFICIENTS += [(k, "fitted-fine", i) for k in (0, 4) for i in range(4)]


@case(*COEFFICIENTS)
def lobe_fitted_coefficients(k, name, i):
    m = slopes(name, k)
    lobe = lobes.FITTED[name, k]
    w = m.astype(float) ** 2
    expected = lobe.coefficients(m)[:, i] * w ** (i + 1)
    function = f"fr_lobe_{name.replace('-', '_')}_coefficients"
    # scaled back by the same powers of m^2, in an order that cannot overflow
    call = f"3.0 + {function}(m, {k})[{i}]" + " * (m * m)" * (i + 1)
    absolute = 16.0 * ULP * (3.0 + fitted_terms(lobe, m.astype(float))[:, i])
    return Case(include("lobe/fitted"), call, {"m": m}, 3.0 + expected, 0.0, absolute)


F0 = [0.0, 1e-8, 1e-4, 0.028, 0.1, 0.5, 0.9]
FRESNEL_COSINES = [*np.linspace(0, 1, 501), 1e-9, 1e-20]


@case()
def fresnel_schlick():
    f0, c = grid(F0, FRESNEL_COSINES)
    expected = brdf.fresnel_schlick(f0, c)
    inputs = {"f0": f0, "c": c}
    return Case(include("fresnel"), "fr_fresnel_schlick(f0, c)", inputs, expected, 8 * ULP, 8 * ULP)


@case()
def fresnel_dielectric():
    f0, c = grid(F0, FRESNEL_COSINES)
    expected = brdf.fresnel_dielectric(f0, c)
    inputs = {"f0": f0, "c": c}
    # square root, division, square: 10 ulp; b is a difference, and its loss is absolute
    absolute = 16 * ULP * f0.astype(float)
    return Case(
        include("fresnel"), "fr_fresnel_dielectric(f0, c)", inputs, expected, 16 * ULP, absolute
    )


@case()
def masking_v_cavity():
    axis = [1e-6, 1e-3, *np.linspace(0.01, 1.0, 10)]
    names = ("n_dot_h", "v_dot_h", "n_dot_l", "n_dot_v")
    inputs = dict(zip(names, grid(axis, axis, axis, axis), strict=True))
    expected = brdf.masking_v_cavity(*inputs.values())
    call = f"fr_masking_v_cavity({', '.join(names)})"
    return Case(include("masking"), call, inputs, expected, 4 * ULP)


@case()
def masking_kelemen():
    axis = [1e-6, 1e-3, *np.linspace(0.01, 1.0, 20)]
    names = ("v_dot_h", "n_dot_l", "n_dot_v")
    inputs = dict(zip(names, grid(axis, axis, axis), strict=True))
    expected = brdf.masking_kelemen(*inputs.values())
    call = f"fr_masking_kelemen({', '.join(names)})"
    return Case(include("masking"), call, inputs, expected, 8 * ULP)


OWN = GPower(11, 0.2, 0.5)
STEEP = GPower(5, 1.2, 0.8)


@case(*((k, name) for k in (0, 4) for name in (*lobes.NAMES, OWN, STEEP)))
def lobe(k, name):
    """The choice at compile time; what was chosen is tested above."""
    return lobe_case(k, name, chosen("lobe", name))


@case(*((k, g) for k in (0, 4) for g in (None, 5)))
def lobe_default_g_power(k, g):
    """Of the macros of a g-power, one or none: D8, or its steepness with another power."""
    said = f"#define FR_G {g}\n" if g else ""
    prelude = f"{said}#define FR_LOBE FR_LOBE_G_POWER\n" + include("lobe")
    return lobe_case(k, GPower(g, 2.0 / g, k / g) if g else "d8", prelude)


def lobe_case(k, name, prelude):
    c = np.float32(np.linspace(0.5, 1.0, 200))
    inputs = {"c": c, "m": np.full_like(c, 0.3)}
    expected = lobes.lobe(name, c, inputs["m"], k)
    return Case(prelude, f"fr_lobe(c, m, {k})", inputs, expected, 1e-4, 1e-5)


KINDS = ("schlick", "dielectric", "constant")


@case(*KINDS)
def fresnel(kind):
    prelude = f"#define FR_FRESNEL FR_FRESNEL_{kind.upper()}\n" + include("fresnel")
    return fresnel_case(kind, "fr_fresnel(0.1, c)", prelude)


@case(*KINDS)
def fresnel_of(kind):
    """Whatever the host chose for fr_fresnel."""
    other = KINDS[KINDS.index(kind) - 1]
    prelude = f"#define FR_FRESNEL FR_FRESNEL_{other.upper()}\n" + include("fresnel")
    return fresnel_case(kind, f"fr_fresnel_of(0.1, c, FR_FRESNEL_{kind.upper()})", prelude)


def fresnel_case(kind, call, prelude):
    c = np.float32(np.linspace(0.0, 1.0, 101))
    return Case(prelude, call, {"c": c}, brdf.fresnel(0.1, c, kind), 1e-5, 1e-6)


@case(*((axis, small_slope) for axis in "xy" for small_slope in (0, 1)))
def half_vector(axis, small_slope):
    """The header's bound is of the sine of the angle, or of its square."""
    inputs = directions(np.resize(np.float32([1e-4, 1e-3, 0.01, 0.1, 1.0]), 60000))
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


def include(name: str) -> str:
    return f'#include "facerender/{name}.glsl"\n'


def chosen(name: str, lobe: lobes.AnyLobe, **macros: str) -> str:
    """The file with a lobe, and further macros."""
    return defines(lobe_macros(lobe) | macros) + include(name)


COOK_TORRANCE = "fr_cook_torrance(n, l, v, m, 0.028)"
TERMS = "fr_cook_torrance_terms(n, l, v, m, 0.028, FR_FRESNEL_{}, FR_MASKING_{})"
BRDFS = {  # a call, and the Fresnel and the masking term, where it has them
    "cook_torrance": (COOK_TORRANCE, "schlick", "v-cavity"),
    "cook_torrance dielectric": (COOK_TORRANCE, "dielectric", "v-cavity"),
    "cook_torrance kelemen": (COOK_TORRANCE, "schlick", "kelemen"),
    "cook_torrance constant none": (COOK_TORRANCE, "constant", "none"),
    "ward": ("fr_ward(n, l, v, m)", None, None),
    "ward_printed": ("fr_ward_printed(n, l, v, m)", None, None),
}
OF_TERMS = {  # whatever the host chose: nothing, here
    "cook_torrance_terms constant none": (TERMS.format("CONSTANT", "NONE"), "constant", "none"),
    "cook_torrance_terms dielectric kelemen": (
        TERMS.format("DIELECTRIC", "KELEMEN"),
        *("dielectric", "kelemen"),
    ),
}
VARIANTS = [(name, lobe, 1) for name in BRDFS for lobe in (*lobes.NAMES, OWN, STEEP)]
VARIANTS += [(name, lobe, 1) for name in OF_TERMS for lobe in ("exact", "fitted", "d8", OWN)]
BRDFS |= OF_TERMS
VARIANTS += [(name, "exact", 0) for name in BRDFS]


def brdf_case(name, lobe, small_slope, inputs):
    """A BRDF at directions; the bounds are those of its header, relative to what the lobe's peak
    gives in the same directions, and none where it is exactly 0."""
    call, fresnel, masking = BRDFS[name]
    file = name.split()[0].removesuffix("_terms")
    macros = {"FR_SMALL_SLOPE": str(small_slope)}
    n, l, v, m = (inputs[axis].astype(float) for axis in "nlvm")
    n_dot_l, n_dot_v = ((n * x).sum(axis=-1) for x in (l, v))
    above = (n_dot_l > brdf.MIN_COSINE) & (n_dot_v > brdf.MIN_COSINE)
    n_dot_l, n_dot_v = (cosine.clip(brdf.MIN_COSINE) for cosine in (n_dot_l, n_dot_v))
    v_dot_h = 0.5 * np.linalg.norm(l + v, axis=-1).clip(1e-30)
    if fresnel:
        if call == COOK_TORRANCE:
            macros["FR_FRESNEL"] = f"FR_FRESNEL_{fresnel.upper()}"
            macros["FR_MASKING"] = f"FR_MASKING_{masking.upper().replace('-', '_')}"
        terms = {"lobe": lobe, "fresnel_term": fresnel, "masking_term": masking}
        expected = brdf.cook_torrance(n, l, v, m, 0.028, **terms)
        n_dot_h = (n_dot_l + n_dot_v) / (2.0 * v_dot_h)
        masked = {
            "v-cavity": brdf.masking_v_cavity(n_dot_h, v_dot_h, n_dot_l, n_dot_v),
            "kelemen": brdf.masking_kelemen(v_dot_h, n_dot_l, n_dot_v),
            "none": 1.0,
        }
        peak = masked[masking] / (n_dot_l * n_dot_v) * brdf.fresnel(0.028, v_dot_h, fresnel)
    else:
        expected = getattr(brdf, file)(n, l, v, m, lobe=lobe)
        peak = (n_dot_l * n_dot_v if file == "ward" else n_dot_v + v_dot_h) ** -0.5
    peak /= 4.0 * np.pi * m**2
    if fresnel and lobe == "exact":  # above m = 0.7071 it is highest off the normal
        w = np.maximum(m**2, 0.5)
        peak *= 4.0 * w**2 * np.exp(1.0 / w - 2.0)
    accurate = lobe == "exact" and small_slope
    e = 4e-7 * (1.0 + 1.0 / (n_dot_l + n_dot_v)) + 7e-7 * (lobe == "cosine")
    if isinstance(lobe, GPower):
        e *= lobe.factor * lobe.g / 2.0
    bound = 1e-5 + 2e-7 / n_dot_l + 2e-7 / n_dot_v + e / (m if accurate else m**2)
    prelude = chosen(file, lobe, **macros)
    return Case(prelude, call, inputs, expected, 0.0, np.where(above, peak * bound, 0.0))


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


def extremes(m):
    """Each of them at each slope."""
    light, eye = (np.float32(vectors) for vectors in zip(*EXTREMES.values(), strict=True))
    n = np.tile(np.float32([0, 0, 1]), (len(light) * len(m), 1))
    l, v = (np.tile(vectors, (len(m), 1)) for vectors in (light, eye))
    return {"n": n, "l": l, "v": v, "m": np.repeat(np.float32(m), len(light))}


@case(*((name, lobe, small) for name, lobe, small in VARIANTS))
def brdfs(name, lobe, small_slope):
    end = lobes.max_slope(lobe, 4 if "cook" in name else 0)
    m = np.resize(np.float32([1e-4, 1e-3, 0.01, *np.geomspace(0.05, 0.999, 12) * end]), 60001)
    parts = directions(m), extremes([1e-4, 1e-2, 0.3, 0.99 * end])
    inputs = {axis: np.concatenate([part[axis] for part in parts]) for axis in "nlvm"}
    return brdf_case(name, lobe, small_slope, inputs)


@pytest.fixture(scope="module")
def evaluate(backend: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(backend).gl)
    yield evaluator
    evaluator.release()


def check(result, case):
    assert np.isfinite(result).all()
    assert (result >= 0.0).all()
    share = case.share(result)
    worst = share.argmax()
    at = {name: values[worst] for name, values in case.inputs.items()}
    assert share[worst] <= 1.0, (
        f"{result[worst]} in place of {case.expected[worst]} at {at}: "
        f"{share[worst]:.2f} times the bound"
    )


@pytest.mark.parametrize("name", ["cook_torrance", "ward"])
def test_exact_term_is_accurate_where_it_shows(evaluate, name):
    """Relative error at most 1e-4 wherever the lobe is above a thousandth of its peak."""
    m = np.resize(np.float32(np.linspace(0.05, 1.0, 20)), 200000)
    inputs = directions(m, lowest=0.02)
    case = brdf_case(name, "exact", 1, inputs)
    result = evaluate(case.include, case.expression, inputs)
    half = inputs["l"].astype(float) + inputs["v"]
    c = (half * inputs["n"]).sum(axis=-1) / np.linalg.norm(half, axis=-1)
    shown = lobes.exact(c.clip(0.0, 1.0), m, 0) > 1e-3
    assert shown.sum() > 50000
    error = np.abs(result - case.expected)[shown] / case.expected[shown]
    assert error.max() < 1e-4


def test_what_lies_outside_the_domain_counts_as_its_end(evaluate):
    inputs = {"c": np.float32(np.linspace(0.0, 1.0, 100))}
    for lobe in ("fitted", "fitted_fine"):
        for k, end in ((4, 0.7), (0, 1.0)):
            beyond, at = (
                evaluate(include("lobe/fitted"), f"fr_lobe_{lobe}(c, {m}, {k})", inputs)
                for m in (2.0, end)
            )
            np.testing.assert_allclose(beyond, at, atol=1e-6)
    vectors = {name: np.float32([[0, 0, 1]]) for name in "nlv"}
    for file, call in (("cook_torrance", "fr_cook_torrance(n, l, v, m, 0.5)"),
                       ("ward", "fr_ward(n, l, v, m)")):  # fmt: skip
        none, least = (
            evaluate(include(file), call, vectors | {"m": np.float32([m])}) for m in (0.0, 1e-4)
        )
        assert none == least


def test_small_slopes_are_accurate_unless_the_host_says_otherwise(evaluate):
    inputs = directions(np.full(2000, 0.01, np.float32))
    unsaid, small = (
        evaluate(define + include("ward"), "fr_ward(n, l, v, m)", inputs)
        for define in ("", "#define FR_SMALL_SLOPE 1\n")
    )
    np.testing.assert_array_equal(unsaid, small)


def test_masking_of_an_unsaid_choice_is_that_of_v_cavities(evaluate):
    inputs = directions(np.full(2000, 0.3, np.float32))
    unsaid, said = (
        evaluate(define + include("cook_torrance"), COOK_TORRANCE, inputs)
        for define in ("", "#define FR_MASKING FR_MASKING_V_CAVITY\n")
    )
    np.testing.assert_array_equal(unsaid, said)


def test_reflectance_of_unsaid_choices_is_exact_and_schlick(evaluate):
    inputs = {"c": np.float32([0.95])}
    value = evaluate(include("cook_torrance"), "fr_lobe(c, 0.3, 4) + fr_fresnel(0.028, c)", inputs)
    c = float(inputs["c"][0])
    expected = lobes.exact(c, np.float32(0.3), 4) + brdf.fresnel_schlick(0.028, c)
    np.testing.assert_allclose(value, expected, rtol=1e-5)


@pytest.mark.parametrize("name", ["fitted", "fitted-fine"])
def test_fitted_coefficients_may_come_from_the_host(evaluate, name):
    inputs = {"c": np.float32(np.linspace(0.0, 1.0, 100)), "m": np.full(100, 0.3, np.float32)}
    a = ", ".join(map(str, lobes.FITTED[name, 4].coefficients(0.3)))
    macro = f"FR_{name.upper().replace('-', '_')}_COEFFICIENTS"
    prelude = chosen("lobe", name, **{f"{macro}(m, k)": f"vec{3 + name.endswith('fine')}({a})"})
    given = evaluate(prelude, "fr_lobe(c, 0.9, 4)", inputs)  # m is not used
    np.testing.assert_allclose(given, lobes.lobe(name, inputs["c"], 0.3, 4), atol=1e-5)


@pytest.mark.parametrize("name", ["cook_torrance", "ward"])
@pytest.mark.parametrize("lobe", ["exact", "d4", "d8", "d16"])
def test_printed_forms_agree_where_they_are_sound(evaluate, name, lobe):
    inputs = directions(np.full(5000, 0.3, np.float32), lowest=0.2)
    model = "ward_printed" if name == "ward" else name
    case = brdf_case(model, lobe, 1, inputs)
    prelude = case.include.replace(f"facerender/{model}", f"printed/{name}")
    call = case.expression.replace(f"fr_{model}", f"fr_printed_{name}")
    result = evaluate(prelude, call, inputs)
    # Where the clamp acts, the printed power rises again; where V.H or N.H rounds to more than 1,
    # pow of a negative base and acos are NaN.
    half = (inputs["l"] + inputs["v"]).astype(float)
    c = (half * inputs["n"]).sum(axis=-1) / np.linalg.norm(half, axis=-1)
    away = ((inputs["l"] * inputs["v"]).sum(axis=-1) < 0.9999) & (c < 0.9999)
    sound = (case.expected > 0.0) & away
    # acos and tan cost the printed Ward three digits
    np.testing.assert_allclose(result[sound], case.expected[sound], rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_conventions_of_a_shader_file(path):
    text = path.read_text()
    code = re.sub(r"//[^\n]*", "", text)
    guard = re.search(r"#ifndef (FR_\w+)\n#define \1\n", code)
    assert text.startswith("// "), "a header comment comes first"
    assert guard, "an include guard"
    assert code.rstrip().endswith("#endif")
    macros = re.findall(r"^\s*#\s*define\s+(\w+)", code, re.MULTILINE)
    assert all(name.startswith("FR_") for name in macros)
    if functions(code):
        assert all(name.startswith("fr_") for name in functions(code))
        header = text[: text.index("#ifndef")]
        assert re.search(r"^//\s+(unit|result)\b", header, re.MULTILINE)
        assert re.search(r"^//\s+error\b", header, re.MULTILINE)


def functions(code: str) -> list[str]:
    return re.findall(r"^\w+ (\w+)\([^;]*\)\s*\{", code, re.MULTILINE)


def test_every_function_is_walked():
    defined = {name for path in FILES for name in functions(path.read_text())}
    called = {name for make in CASES.values() for name in re.findall(r"fr_\w+", make().expression)}
    assert called == defined


def test_every_reference_function_has_its_twin_in_glsl():
    source = "".join(path.read_text() for path in FILES)
    host_only = {"check_slope", "in_domain", "max_slope"}
    for module, prefix in ((lobes, "fr_lobe_"), (brdf, "fr_")):
        for name, function in inspect.getmembers(module, inspect.isfunction):
            public = function.__module__ == module.__name__ and not name.startswith("_")
            if public and name not in host_only:
                twin = "fr_lobe" if name == "lobe" else prefix + name
                assert re.search(rf"\b{twin}\(", source), name


def test_constants_of_the_fitted_lobes_are_the_same_in_glsl():
    source = (shader_dir() / "facerender/lobe/fitted.glsl").read_text()
    rows = re.findall(r"vec[34]\((-?[\d.]+, [-\d., ]+)\)", source)
    tables = [lobes.FITTED[key].table for key in lobes.FITTED]
    assert [tuple(map(float, row.split(","))) for row in rows] == [r for t in tables for r in t]


def test_source_is_flat_and_includes_may_stand_in_conditions(evaluate):
    assert "#include" not in shader_source("cook_torrance")
    prelude = "#ifdef ABSENT\n" + include("ward") + "#endif\n" + include("cook_torrance")
    up = np.float32([[0, 0, 1]])
    inputs = {"n": up, "l": up, "v": up}
    assert evaluate(prelude, "fr_cook_torrance(n, l, v, 0.3, 0.028)", inputs) > 0.0
    with pytest.raises(InputError, match="unknown shader .ggx.; known: "):
        shader_source("ggx")


@pytest.mark.parametrize("name", ["FR_LOBE_D32", "7", "0"])
def test_unknown_lobe_does_not_compile(evaluate, name):
    prelude = f"#define FR_LOBE {name}\n" + include("ward")
    with pytest.raises(moderngl.Error, match="FR_LOBE is none of"):
        evaluate(prelude, "fr_lobe(1.0, m, 0)", {"m": np.float32([0.3])})
