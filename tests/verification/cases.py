"""Cases of every public function of the shader library and every term of the registry. A case has
an expression, its inputs, the float64 values and error bounds.

The bounds follow from the precision that OpenGL and Vulkan require of drivers, in units of the last
place (2^-23): division 2.5, inversesqrt 2, exp2(x) 3 + 2|x|, log2 3 and 2^-21 absolute in [0.5, 2];
sums and products 0.5.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facerender import brdf, lobes, resolve_includes
from facerender.glsl import library
from facerender.lobes import AnyLobe, GPower
from facerender.scene.shading import Term
from facerender.terms import environment, transport
from facerender.terms.lobe import LOBES, TINY, ULP, lobe_entry, power_error
from facerender.terms.model import FRESNEL, MASKING, MODELS
from tests.verification import shadow
from tests.verification.evaluate import WIDTH, Inputs

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

DIRECTIONS = 10_000  # per BRDF
PLACES = 4096  # distinct inputs of functions with a slow reference; further inputs repeat them
FLOOR = 4e-13  # FR_FLOOR
F0 = 0.028


def singles(values: ArrayLike) -> Singles:
    return np.asarray(values, dtype=np.float32)


COSINES = singles(
    [*np.cos(np.linspace(0.0, np.pi / 2, 500)).clip(0), 1.0 - 2.0**-24, 1e-3, 1e-10, 1e-30]
)


class Each(Protocol):
    """Interface of Evaluator: evaluates expressions of the same inputs."""

    def each(self, prelude: str, expressions: list[str], inputs: Inputs, /) -> Singles: ...


@dataclass(frozen=True, eq=False)
class Case:
    """An expression, its inputs, the expected float64 values and the error bounds of a target."""

    prelude: str
    expression: str
    inputs: Inputs
    expected: Floats
    relative: Floats | float = 0.0
    absolute: Floats | float = 0.0

    def share(self, result: Singles) -> Floats:
        """Return each result's error as a fraction of its bound; at most 1 is within the bound."""
        error = np.abs(result - self.expected)
        bound = self.relative * self.expected + self.absolute
        return np.divide(error, bound, out=np.where(error > 0.0, np.inf, 0.0), where=bound > 0.0)

    def fault(self, result: Singles) -> str:
        """Return a message about the worst result, or "" if all are valid.

        A result is valid if it is finite, not negative and within its bound.
        """
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


def add(name: str, make: Callable[..., Case], *values: object) -> None:
    """Add a case; its name begins with its group."""
    assert name not in CASES, name
    CASES[name] = partial(make, *values)


def add_of(group: str, make: Callable[..., Case], *values: object) -> None:
    """Add a case with a name made of its group and values."""
    add(" ".join([group, *map(str, values)]), make, *values)


def case(*parameters: tuple[object, ...]) -> Callable[[Callable[..., Case]], Callable[..., Case]]:
    """Add a case for each tuple of parameters; its group is ``fr_`` and the decorated name."""

    def register(make: Callable[..., Case]) -> Callable[..., Case]:
        for values in parameters or ((),):
            add_of("fr_" + make.__name__, make, *values)
        return make

    return register


@cache
def cases_of(group: str) -> dict[str, Case]:
    """Return the cases of one of GROUPS by name."""
    return {name: make() for name, make in CASES.items() if name.split()[0] == group}


def evaluated(cases: Mapping[str, Case], target: Each) -> dict[str, Singles]:
    """Return the results of cases on a target; it draws cases with equal inputs together."""
    together: dict[tuple[str, int], dict[str, Case]] = {}
    for name, each in cases.items():
        together.setdefault((each.prelude, id(each.inputs)), {})[name] = each
    results: dict[str, Singles] = {}
    for (prelude, _), group in together.items():
        inputs = next(iter(group.values())).inputs
        values = target.each(prelude, [each.expression for each in group.values()], inputs)
        results |= zip(group, values, strict=True)
    return results


flat = cache(resolve_includes)


def include(name: str, **macros: str) -> str:
    """Return macros, followed by a file of the library with its includes resolved."""
    return library.defines(macros) + flat(f'#include "facerender/{name}.glsl"\n')


def grid(*axes: ArrayLike) -> list[Singles]:
    return [axis.ravel() for axis in np.meshgrid(*map(singles, axes), indexing="ij")]


def repeated(values: NDArray[Any], count: int) -> NDArray[Any]:
    """Return ``count`` rows, repeating ``values``."""
    return np.resize(values, (count, *values.shape[1:]))


# --- lobes ---------------------------------------------------------------------------------------


@cache
def slopes(end: float) -> Singles:
    """Return slopes over the whole domain of a lobe."""
    return singles([1e-4, 1e-3, 0.01, 0.05, *np.linspace(0.1, 0.99, 8) * end, 0.9999 * end])


@cache
def cosines_and_slopes(end: float) -> dict[str, Singles]:
    return dict(zip("cm", grid(COSINES, slopes(end)), strict=True))


OWN = GPower(11, 0.2, 0.5)
STEEP = GPower(5, 1.2, 0.8)
ALL_LOBES: tuple[AnyLobe, ...] = (*LOBES, OWN, STEEP)
# Every file of the library, without choices and with a lobe or a slope, for flat texts.
CHOICES: list[tuple[str, AnyLobe | None, float | None]] = [
    *((name, None, None) for name in library.library()),
    *((name, lobe, m) for name in ("cook_torrance", "lobe", "ward", "ward_printed")
      for lobe in ALL_LOBES[:-1] for m in (None, 0.15, 0.2)),
    *(("cook_torrance_two", lobe, None) for lobe in ALL_LOBES[:-1]),
    *((f"lobe/{name}", None, 0.3) for name in ("cosine", "exact", "fitted", "g_power")),
]  # fmt: skip


def lobe_case(file: str, macros: Mapping[str, str], call: str, lobe: AnyLobe, k: int) -> Case:
    """Return the case of a call that evaluates a lobe of c and m; the registry has its bound."""
    entry = lobe_entry(lobe)
    inputs = cosines_and_slopes(entry.end(k))
    c, m = (values.astype(float) for values in inputs.values())
    expected = entry.evaluate(c, m, k)
    return Case(include(file, **macros), call, inputs, expected, *entry.rounding(c, m, k))


EVERY = {"FR_LOBE": "FR_LOBE_EVERY"}
for _lobe in ALL_LOBES:
    _entry, _own = lobe_entry(_lobe), library.lobe_macros(_lobe)
    _alone, _within = _entry.call.split("(")[0], "(c, m, 1.0 / (m * m)"
    for _k in _entry.ends:
        for _group, _file, _macros, _call in (
            # Called by a BRDF with 1/m^2; alone; chosen by the host's macro; by an argument.
            ("fr_lobe_with_inverse_m2", "lobe", _own | EVERY, f"{_within}, {_k}, {_entry.macro})"),
            (_alone, _entry.file, {}, re.sub(r"\bk\b", str(_k), _entry.call[len(_alone) :])),
            ("fr_lobe", "lobe", _own, f"(c, m, {_k})"),
            ("fr_lobe_of", "lobe", _own | EVERY, f"(c, m, {_k}, {_entry.macro})"),
        ):
            if _group != _alone or _lobe in LOBES:
                _all = _file, _macros, _group + _call, _lobe, _k
                add(f"{_group} {_lobe} {_k}", lobe_case, *_all)

# Without FR_G a g-power is D8; FR_G alone changes its power and keeps the steepness of D8.
for _k in (0, 4):
    for _g in (None, 5):
        _macros = {"FR_LOBE": "FR_LOBE_G_POWER"} | ({"FR_G": str(_g)} if _g else {})
        _lobe = GPower(_g or 8, 2 / (_g or 8), _k / (_g or 8))
        add(f"fr_lobe {_k} {_g}", lobe_case, "lobe", _macros, f"fr_lobe(c, m, {_k})", _lobe, _k)


def lobe_of_the_host(chosen: str) -> Case:
    """Return the case of a lobe function of the host, chosen by a macro or by an argument."""
    own = "highp float own(highp float c, highp float m, int k) { return c * m + float(k); }\n"
    macros = {"FR_LOBE_FUNCTION": "own"} | ({"FR_LOBE": chosen} if chosen else {})
    call = "fr_lobe_of(c, m, 4, FR_LOBE_OWN)" if "EVERY" in chosen else "fr_lobe(c, m, 4)"
    inputs = cosines_and_slopes(lobes.MAX_SLOPE)
    c, m = (values.astype(float) for values in inputs.values())
    return Case(own + include("lobe", **macros), call, inputs, c * m + 4.0, 2 * ULP)


for _chosen in ("", "FR_LOBE_OWN", "FR_LOBE_EVERY"):
    add_of("fr_lobe", lobe_of_the_host, _chosen)


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


@case((0,), (4,))
def lobe_exact_tan2(k: int) -> Case:
    inputs = tangents_and_slopes()
    tan2, m = inputs.values()
    exponent = np.minimum(tan2 / m.astype(float) ** 2, 100.0)
    # Errors in ulp: m^2 and the division 3 of the exponent; exp2 3 + 2 x; 1/c^4 2.
    smallest = TINY * (1.0 + np.minimum(tan2, 1e3)) ** 2  # E may be flushed to 0; times 1/c^4
    expected = lobes.exact_tan2(tan2, m, k)
    relative = ULP * (5.0 + 6.0 * exponent)
    call = f"fr_lobe_exact_tan2(tan2, m, {k})"
    return Case(include("lobe/exact"), call, inputs, expected, relative, smallest)


@cache
def cosines_and_steepness() -> dict[str, Singles]:
    axes = grid(COSINES, [0.0, 0.1, 1.0, 3.0, 30.0, 1e3, 1e8])
    return dict(zip(("c", "steepness"), axes, strict=True))


@case(*((g,) for g in range(1, 32)))
def lobe_clamped_power(g: int) -> Case:
    inputs = cosines_and_steepness()
    c, steepness = (values.astype(float) for values in inputs.values())
    # Error of the base 1 - s u: 0.5 ulp for the product and for each difference.
    error = ULP * steepness * (1.0 - c) + ULP
    absolute = power_error(1.0 - steepness * (1.0 - c), error, g) + TINY
    expected = lobes.clamped_power(c, steepness, g)
    call = f"fr_lobe_clamped_power(c, steepness, {g})"
    return Case(include("lobe/g_power"), call, inputs, expected, ULP * g, absolute)


@cache
def slopes_alone(end: float) -> dict[str, Singles]:
    return {"m": slopes(end)}


def coefficient(name: str, k: int, i: int, call: str, above: float, digits: float) -> Case:
    """Return the case of a fitted lobe's coefficient times m^(2 i + 2), offset from 0 by a sum."""
    lobe = lobes.FITTED[name, k]
    inputs = slopes_alone(lobe.max_slope)
    m = inputs["m"].astype(float)
    expected = above + lobe.coefficients(m)[:, i] * m ** (2 * (i + 1))
    absolute = digits * ULP * (above + lobe.magnitudes(m)[:, i])
    return Case(include("lobe/fitted"), f"{above} + {call}", inputs, expected, 0.0, absolute)


for _name, _k in lobes.FITTED:
    _function = f"fr_lobe_{_name.replace('-', '_')}"
    _call = f"{_function}_with_inverse_m2(c, m, 1.0 / (m * m), {_k})"
    add(
        f"fr_lobe_fitted_with_inverse_m2 {_name} {_k}",
        lobe_case,
        "lobe/fitted",
        {},
        _call,
        _name,
        _k,
    )
    for _i in range(len(lobes.FITTED[_name, _k].table[0])):
        # Scaled back by m^2, one factor after the other: this order cannot overflow.
        _scaled = f"{_function}_coefficients(m, {_k})[{_i}]" + " * (m * m)" * (_i + 1)
        for _what, _call, _bounds in (
            ("coefficients", _scaled, (3.0, 16.0)),
            ("numerators", f"{_function}_numerators(m, {_k})[{_i}]", (9.0, 8.0)),
        ):
            _place = _name, _k, _i, _call, *_bounds
            add(f"fr_lobe_fitted_{_what} {_name} {_k} {_i}", coefficient, *_place)


@case((4, 0.49), (0, 1.0))
def lobe_fitted_variable(k: int, end: float) -> Case:
    inputs = cosines_and_slopes(lobes.MAX_SLOPE)
    c, m = (values.astype(float) for values in inputs.values())
    call = f"fr_lobe_fitted_variable(1.0 - min(c, 1.0), 1.0 / (m * m), {k})"
    expected = (1.0 - c) / np.minimum(m**2, end)
    return Case(include("lobe/fitted"), call, inputs, expected, 8 * ULP, ULP / m**2)


@case((0.3,), (8.0,), (1e4,))
def lobe_power(n: float) -> Case:
    c = COSINES.astype(float)
    power = n * -np.log2(c.clip(1e-30))
    log_error = np.where(c >= 0.5, 2.0**-21, 3.0 * ULP * -np.log2(c.clip(1e-30)))
    relative = np.expm1(np.minimum(np.log(2.0) * n * log_error, 80.0))
    relative += ULP * (4.0 + 4.0 * np.minimum(power, 130.0))
    expected = c.clip(1e-30) ** n
    return Case(
        include("lobe/cosine"), f"fr_lobe_power(c, {n})", {"c": COSINES}, expected, relative, TINY
    )


# --- Fresnel and masking terms -------------------------------------------------------------------


@cache
def reflectances_and_cosines() -> dict[str, Singles]:
    f0 = [0.0, 1e-8, 1e-4, F0, 0.1, 0.5, 0.9]
    return dict(zip(("f0", "c"), grid(f0, [*np.linspace(0, 1, 501), 1e-9, 1e-20]), strict=True))


def fresnel_case(name: str, file: str, macros: Mapping[str, str], call: str) -> Case:
    """Return the case of a call that evaluates a Fresnel term of f0 and c."""
    inputs, entry = reflectances_and_cosines(), FRESNEL[name]
    f0, c = (values.astype(float) for values in inputs.values())
    bounds = entry.rounding(f0, c)
    return Case(include(file, **macros), call, inputs, entry.evaluate(f0, c), *bounds)


for _name, _fresnel in FRESNEL.items():
    _alone = _fresnel.call.split("(")[0]
    if _alone.startswith("fr_"):
        _call = _fresnel.call.replace("v_dot_h", "c")
        add(f"{_alone} {_name}", fresnel_case, _name, _fresnel.file, {}, _call)
    for _chosen, _other in FRESNEL.items():
        _macros = {"FR_FRESNEL": _other.macro}
        if _chosen == _name:
            _term = "fresnel", _macros, "fr_fresnel(f0, c)"
            add(f"fr_fresnel {_name}", fresnel_case, _name, *_term)
        else:  # an argument takes precedence over the host's macro
            _term = "fresnel", _macros, f"fr_fresnel_of(f0, c, {_fresnel.macro})"
            add(f"fr_fresnel_of {_name} {_chosen}", fresnel_case, _name, *_term)


SCALE = 0.0551589


@case(*((name,) for name in FRESNEL))
def fresnel_times(name: str) -> Case:
    call = f"fr_fresnel_times({SCALE}, f0, c, {FRESNEL[name].macro}) / {SCALE}"
    return replace(fresnel_case(name, "fresnel", {}, call), absolute=2e-6)


@case(("grazing", ""), ("times", "f0, "), ("rgb", "vec3(f0), vec3(0.7), "))
def fresnel_schlick_scaled(name: str, arguments: str) -> Case:
    """Return the case of fr_fresnel_schlick_grazing, _times or _rgb."""
    inputs = reflectances_and_cosines()
    f0, c = (values.astype(float) for values in inputs.values())
    u5 = (1.0 - c) ** 5
    low, high = {"grazing": (0.0 * f0, 1.0), "times": (f0, 1.0), "rgb": (f0, 0.7)}[name]
    call = f"fr_fresnel_schlick_{name}({SCALE}, {arguments}c)" + ".y" * (name == "rgb")
    expected = SCALE * (low + (high - low) * u5)
    return Case(include("fresnel/schlick"), call, inputs, expected, 0.0, 2e-6 * SCALE)


def masking_case(name: str, count: int, words: str, ulps: float) -> Case:
    """Return the case of a masking term over a grid of its cosines."""
    axis = [1e-6, 1e-3, *np.linspace(0.01, 1.0, count)]
    names = words.split()
    inputs = dict(zip(names, grid(*[axis] * len(names)), strict=True))
    expected = getattr(brdf, f"masking_{name}")(*inputs.values())
    call = f"fr_masking_{name}({', '.join(names)})"
    return Case(include("masking"), call, inputs, expected, ulps * ULP)


for _name, _count, _words, _ulps in (
    ("v_cavity", 10, "n_dot_h v_dot_h n_dot_l n_dot_v", 4),
    ("kelemen", 20, "v_dot_h n_dot_l n_dot_v", 8),
):
    add(f"fr_masking_{_name}", masking_case, _name, _count, _words, _ulps)


@cache
def cosines_with_a_long_half_vector() -> dict[str, Singles]:
    """Return cosines with h = l + v; the length of h is at least N.H and at most 2."""
    axis = [2e-6, 1e-3, *np.linspace(0.01, 1.0, 20)]
    n_dot_l, n_dot_v, share = grid(axis, axis, np.linspace(0.0, 1.0, 10))
    n_dot_h = n_dot_l + n_dot_v
    h_dot_h = n_dot_h**2 + share * (4.0 - n_dot_h**2)
    return {"n_dot_h": n_dot_h, "h_dot_h": h_dot_h, "n_dot_l": n_dot_l, "n_dot_v": n_dot_v}


def masking_ratio(name: str, call: str) -> Case:
    """Return the case of G/((N.L)(N.V)) (h.h), the quotient of a call's two results."""
    inputs = cosines_with_a_long_half_vector()
    n_dot_h, h_dot_h, n_dot_l, n_dot_v = (values.astype(float) for values in inputs.values())
    length = np.sqrt(h_dot_h)
    masked = MASKING[name].evaluate(n_dot_h / length, 0.5 * length, n_dot_l, n_dot_v)
    prelude = include("masking") + "highp float quotient(highp vec2 x) { return x.x / x.y; }\n"
    expected = masked / (n_dot_l * n_dot_v) * h_dot_h
    return Case(
        prelude, f"quotient({call})", inputs, expected, 8 * ULP + FLOOR / (n_dot_l * n_dot_v)
    )


for _name, _masking in MASKING.items():
    _call = f"fr_masking_of(n_dot_h, h_dot_h, n_dot_l, n_dot_v, {_masking.macro})"
    add(f"fr_masking_of {_name}", masking_ratio, _name, _call)
    if _masking.call.startswith("fr_"):
        add(f"{_masking.call.split('(')[0]} {_name}", masking_ratio, _name, _masking.call)


# --- slope variance -----------------------------------------------------------------------------


def variance_case(name: str, relative: float, **axes: ArrayLike) -> Case:
    """Return the case of a function of slope_variance.glsl over a grid of its arguments."""
    inputs = dict(zip(axes, grid(*axes.values()), strict=True))
    expected = getattr(brdf, name)(*(values.astype(float) for values in inputs.values()))
    call = f"fr_{name}({', '.join(axes)})"
    return Case(include("slope_variance"), call, inputs, expected, relative, TINY)


@case()
def slope_filtered() -> Case:
    m = [0.0, 1e-4, *np.linspace(0.01, 2.0, 50)]
    return variance_case("slope_filtered", 4e-7, m=m, variance=[0.0, *np.logspace(-12, 18, 60)])


@case()
def slope_variance_map() -> Case:
    return variance_case("slope_variance_map", 3e-7, alpha=np.linspace(0.0, 1.0, 511))


@cache
def discs(last: float) -> tuple[Singles, Singles]:
    """Return s and k of discs with radii up to ``last`` degrees."""
    radius = np.radians([0.0, 0.25, *np.linspace(1.0, last, 12)])
    return singles(np.sin(radius)), singles(0.5 + 0.5 * np.cos(radius))


def disc_case(name: str, last: float, relative: float, axis: str, values: ArrayLike) -> Case:
    """Return the case of a function of slope_variance.glsl over a grid of discs and ``values``."""
    s, k = discs(last)
    index, other = grid(np.arange(len(s)), values)
    at = index.astype(int)
    inputs = {"s": s[at], "k": k[at], axis: other}
    order = ("c", "s", "k") if axis == "c" else ("s", "k", axis)
    expected = getattr(brdf, name)(*(inputs[each].astype(float) for each in order))
    call = f"fr_{name}({', '.join(order)})"
    absolute = 4e-7 if axis == "c" else TINY
    return Case(include("slope_variance"), call, inputs, expected, relative, absolute)


@case()
def slope_variance_disc() -> Case:
    return disc_case("slope_variance_disc", 20.0, 1e-6, "v_dot_h", np.linspace(0.0, 1.0, 101))


@case()
def cosine_disc() -> Case:
    return disc_case("cosine_disc", 30.0, 0.0, "c", [*np.linspace(-1.0, 1.0, 401), 1e-9, -1e-9])


HARD = 0.2  # bias; large enough to change results, since depths are multiples of 1/4
DISC = (0.2, 1.0, 0.1, 1.5)  # tangent of the radius, top, bias, width
START = (0.8, 0.6)


@cache
def shadows() -> tuple[tuple[int, int, int], dict[str, Singles], Floats, Floats]:
    """Return a tile of a shadow map, the inputs, the map, and the sensitivity of a disc's shadow.

    Depths in the map are multiples of 1/4; places have depths in between. The sensitivity is the
    change of the shadow when a place moves by 5e-5; places where it is 1e-2 or more are left out.
    """
    random = np.random.default_rng(11)
    tile, count = (700, 3, 16), 20 * WIDTH
    map_ = singles(random.integers(-3, 3, count) / 4.0)
    p = np.hstack([random.uniform(-1.2, 1.2, (PLACES, 2)), np.zeros((PLACES, 1))])
    p[:, 2] = random.integers(-4, 3, PLACES) / 4.0 + 0.12
    plane = np.hstack([random.uniform(-2.0, 2.0, (PLACES, 2)), np.zeros((PLACES, 1))])
    image = map_.reshape(-1, WIDTH).astype(float)
    ends = [
        shadow.shadow_disc(image, tile, p + aside, plane[:, :2], *DISC, START)
        for aside in (-5e-5, [5e-5, -5e-5, 0.0], [-5e-5, 5e-5, 0.0], 5e-5)
    ]
    differs = np.ptp(ends, axis=0)
    steady = np.flatnonzero(differs < 1e-2)
    kept = repeated(np.where(differs < 1e-2, np.arange(PLACES), steady[0]), count)
    inputs = {"map": map_, "p": singles(p[kept]), "plane": singles(plane[kept])}
    return tile, inputs, image, differs[kept]


@case(("fr_shadow_hard", "p, plane.xy, 2.4, 0.2"))
def shadow_hard(function: str, arguments: str) -> Case:
    tile, inputs, map_, differs = shadows()
    places = inputs["p"][:PLACES], inputs["plane"][:PLACES, :2]
    expected = shadow.shadow_hard(map_, tile, *places, np.array(2.4), HARD)
    expected = repeated(expected, len(inputs["p"]))
    call = f"{function}(map_texels, ivec3{tile}, {arguments})"
    return Case(include("shadow"), call, inputs, expected, 0.0, 1e-4 + differs)


@case()
def shadow_depth() -> Case:
    tile, inputs, map_, _ = shadows()
    expected = shadow.shadow_depth(map_, tile, 8.0 * inputs["p"][:PLACES, :2] + 8.0)
    call = f"2.0 + fr_shadow_depth(map_texels, ivec3{tile}, 8.0 * p.xy + 8.0)"
    expected = 2.0 + repeated(expected, len(inputs["p"]))
    return Case(include("shadow"), call, inputs, expected, 0.0, 1e-6)


@case()
def shadow_weight() -> Case:
    _, inputs, _, _ = shadows()
    p, plane = (inputs[name][:PLACES, :2].astype(float) for name in ("p", "plane"))
    expected = shadow.shadow_weight(p, plane, np.array(2.4))
    call = "fr_shadow_weight(p.xy, plane.xy, 2.4)"
    return Case(include("shadow"), call, inputs, repeated(expected, len(inputs["p"])), 0.0, 1e-6)


@case()
def shadow_disc() -> Case:
    tile, inputs, map_, differs = shadows()
    places = inputs["p"][:PLACES], inputs["plane"][:PLACES, :2]
    expected = repeated(shadow.shadow_disc(map_, tile, *places, *DISC, START), len(inputs["p"]))
    numbers = ", ".join(map(str, DISC))
    call = (
        f"fr_shadow_disc(map_texels, ivec3{tile}, p, plane.xy, {numbers}, vec2{START}, vec2(0.5))"
    )
    return Case(include("shadow"), call, inputs, expected, 0.0, 1e-4 + differs)


# --- scattering ----------------------------------------------------------------------------------


GAUSSIANS = ((0.6, 0.2, 0.1, 0.0), (2.0, 0.5, 0.2, 0.05))
SIXTEEN = transport.spiral(GAUSSIANS, 16)


def array(kind: str, rows: ArrayLike) -> str:
    """Return the GLSL expression of an array of vectors."""
    vectors = [f"{kind}({', '.join(map(repr, map(float, row)))})" for row in np.asarray(rows)]
    return f"{kind}[{len(vectors)}]({', '.join(vectors)})"


def gaussians() -> str:
    rows = [(*(np.divide(w, 2.0 * np.pi * v)), -0.5 / (v * np.log(2.0))) for v, *w in GAUSSIANS]
    return array("vec4", rows)


@case((0,), (1,), (2,))
def scatter_profile(channel: int) -> Case:
    r2 = singles([0.0, *np.logspace(-6, 18, 500)])
    expected = transport.scatter_profile(r2, GAUSSIANS)[:, channel]
    call = f"fr_scatter_profile(r2, {gaussians()})[{channel}]"
    prelude = include("scatter", FR_SCATTER_GAUSSIANS="2")
    highest = transport.scatter_profile(0.0, GAUSSIANS)[channel]
    return Case(prelude, call, {"r2": r2}, expected, 0.0, 1e-6 * highest)


@case()
def scatter_area() -> Case:
    c = singles(np.linspace(-1.0, 1.0, 401))
    expected = transport.scatter_area(c.astype(float))
    return Case(include("scatter"), "fr_scatter_area(c)", {"c": c}, expected, 4 * ULP)


@case()
def scatter_turn() -> Case:
    x, y = (each.ravel() for each in np.mgrid[0:16000:37, 0:16000:311])
    inputs = {"x": singles(x), "y": singles(y)}
    call = "fr_scatter_turn(ivec2(int(x), int(y))) + 4.0"
    return Case(include("scatter"), call, inputs, transport.scatter_turn(x, y) + 4.0, 4 * ULP)


@cache
def scattered() -> tuple[dict[str, Singles], Floats, Floats]:
    """Return places on a wavy surface with their light, the scattered light and error bounds.

    The bound is large for places whose samples lie so near to the border of a pixel that rounding
    decides which pixel they read.
    """
    random = np.random.default_rng(13)
    shape = 20, WIDTH
    y, x = np.mgrid[: shape[0], : shape[1]]
    place = np.stack([x, y, 9.0 * np.sin(0.1 * x) + 5.0 * (x > 700)], axis=-1) / 4.0
    light = random.uniform(0.0, 3.0, (*shape, 3))
    place, light = (singles(each).astype(float) for each in (place, light))
    one, every = np.ones(shape), np.ones(shape, dtype=bool)
    scale = 4.0 * one.ravel()
    images = light, place, one, one, every
    expected = transport.scatter(*images, scale=scale, unit=1.0, gaussians=GAUSSIANS, samples=16)
    spiral = 4.0 * (SIXTEEN[:, 0] + 1j * SIXTEEN[:, 1])
    turned = spiral * np.exp(1j * transport.scatter_turn(x, y))[..., None]
    borders = np.stack([turned.real, turned.imag]) + 0.5
    reach = 1e-4 + 2.0**-11 * np.abs(spiral)  # Vulkan's sine and cosine have errors of 2^-11
    unsure = (np.abs(borders - np.round(borders)) < reach).any(axis=(0, -1))
    inputs = {"light": singles(light.reshape(-1, 3)), "place": singles(place.reshape(-1, 3))}
    return inputs, expected, np.where(unsure.ravel(), 3.0, 3e-5)


@case((0,), (1,), (2,))
def scatter(channel: int) -> Case:
    inputs, expected, bounds = scattered()
    rest = f"vec3({', '.join(map(repr, map(float, transport.rest(GAUSSIANS))))})"
    call = (
        f"fr_scatter(light_texels, place_texels, at, 4.0, {gaussians()}, "
        f"{rest}, {array('vec3', SIXTEEN)})[{channel}] + 0.0 * (light.x + place.x)"
    )
    prelude = include("scatter", FR_SCATTER_GAUSSIANS="2")
    return Case(prelude, call, inputs, expected[:, channel], 0.0, bounds)


# --- environment ---------------------------------------------------------------------------------


AROUND = 16  # height of an environment map's finest level, in texels


@cache
def around() -> tuple[dict[str, Singles], Floats]:
    """Return the inputs and a random environment map; n, v and m repeat PLACES rows."""
    random = np.random.default_rng(12)
    count = (AROUND + 2) * WIDTH
    map_ = singles(random.uniform(0.0, 1.0, (count, 3)))
    n, v = (unit(random.normal(size=(PLACES, 3))) for _ in range(2))
    cosine = np.einsum("...i,...i", n, v)[:, None]
    v = np.where(cosine < 0.0, -v, v)
    v[np.abs(cosine[:, 0]) < 0.05] = n[np.abs(cosine[:, 0]) < 0.05]
    inputs = {
        "map": map_,
        "n": repeated(singles(n), count),
        "v": repeated(singles(v), count),
        "l": singles(unit(random.normal(size=(count, 3)))),
        "m": repeated(singles(random.choice([1e-4, 0.02, 0.1, 0.3, 0.6, 2.0], PLACES)), count),
        "w": singles(np.exp(random.uniform(-12.0, 3.0, count))),
    }
    return inputs, map_.reshape(-1, WIDTH, 3).astype(float)


@case()
def environment_irradiance() -> Case:
    inputs, _ = around()
    sh = np.random.default_rng(13).normal(size=(9, 3)) + [[4.0], *[[0.0]] * 8]
    code_ = ", ".join(f"vec3({', '.join(map(str, row))})" for row in sh)
    expected = environment.environment_irradiance(sh, inputs["n"])[:, 1]
    call = f"fr_environment_irradiance(vec3[9]({code_}), n).y"
    return Case(include("environment"), call, inputs, expected, 0.0, 1e-6 * np.abs(sh).sum())


@case()
def environment_radiance() -> Case:
    inputs, map_ = around()
    expected = environment.environment_radiance(map_, AROUND, inputs["l"], inputs["w"])[:, 1]
    call = f"fr_environment_radiance(map_texels, {AROUND}, l, w).y"
    return Case(include("environment"), call, inputs, expected, 0.0, 2e-5)


@case()
def environment_level() -> Case:
    inputs, map_ = around()
    place = np.abs(inputs["l"][:, :2]).astype(float)
    level = np.full(len(place), 1)
    expected = environment.level_at(map_, AROUND, place, level)[:, 1]
    call = f"fr_environment_level(map_texels, {AROUND}, abs(l.xy), 1).y"
    return Case(include("environment"), call, inputs, expected, 0.0, 1e-5)


@case(*((name,) for name in FRESNEL))
def environment_cook_torrance(fresnel: str) -> Case:
    inputs, map_ = around()
    masking = {"schlick": "v-cavity", "dielectric": "kelemen"}.get(fresnel, "none")
    n, v, m = (inputs[name][:PLACES] for name in "nvm")
    expected = environment.environment_cook_torrance(map_, AROUND, n, v, m, F0, fresnel, masking)
    macros = f"{FRESNEL[fresnel].macro}, {MASKING[masking].macro}"
    call = f"fr_environment_cook_torrance(map_texels, {AROUND}, n, v, m, {F0}, {macros}).y"
    expected = repeated(expected[:, 1], len(inputs["n"]))
    return Case(include("environment"), call, inputs, expected, 1e-4, 1e-6)


@case(("direction",), ("steradians",), ("axes",))
def environment_sample(what: str) -> Case:
    inputs, _ = around()
    n, v, m = (inputs[name].astype(float) for name in ("n", "v", "m"))
    axes = environment.environment_axes(n, v)
    l, steradians = environment.environment_sample(n, v, m, axes, np.array([0.6, -0.8]), 11)
    call = "fr_environment_sample(n, v, m, fr_environment_axes(n, v), vec2(0.6, -0.8), 11)"
    across = (0.6 * axes[0] + 0.8 * axes[1])[:, 1]
    expression, expected = {
        "direction": (f"2.0 + {call}.x", 2.0 + l[:, 0]),
        "steradians": (f"max({call}.w, 0.0)", np.maximum(steradians, 0.0)),
        "axes": ("2.0 + (fr_environment_axes(n, v) * vec2(0.6, 0.8)).y", 2.0 + across),
    }[what]
    return Case(include("environment"), expression, inputs, expected, 0.0, 2e-5)


@case()
def environment_ward() -> Case:
    inputs, map_ = around()
    n, v, m = (inputs[name][:PLACES] for name in "nvm")
    expected = environment.environment_ward(map_, AROUND, n, v, m)[:, 1]
    expected = repeated(expected, len(inputs["n"]))
    call = f"fr_environment_ward(map_texels, {AROUND}, n, v, m).y"
    return Case(include("environment"), call, inputs, expected, 1e-4, 1e-6)


# --- models --------------------------------------------------------------------------------------


def true_directions(m: Singles, lowest: float = 1e-5) -> dict[str, Floats]:
    """Return random directions n, l and v in float64, one triple for each slope.

    N.L and N.V are above ``lowest``, and half of them are log-uniform. Half of the half vectors are
    near the normal: their tangents are 0 to 3 m, dense near 0.
    """
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
    return {"n": n, "l": l, "v": v}


def directions(m: Singles, lowest: float = 1e-5) -> dict[str, Singles]:
    """Return :func:`true_directions` rounded to float32, with the slopes."""
    vectors = true_directions(m, lowest)
    return {name: x.astype(np.float32) for name, x in vectors.items()} | {"m": m}


@cache
def directions_at_five_slopes() -> dict[str, Singles]:
    return directions(np.resize(singles([1e-4, 1e-3, 0.01, 0.1, 1.0]), DIRECTIONS))


@case(*((axis, small_slope) for axis in "xy" for small_slope in (0, 1)))
def half_vector(axis: str, small_slope: int) -> Case:
    """The header bounds the error of the sine (small_slope) or of its square."""
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
    prelude = include("half_vector", FR_SMALL_SLOPE=str(small_slope))
    call = f"fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).{axis}"
    return Case(prelude, call, inputs, expected, 0.0, absolute)


NOISE = 1.3e-6  # headers state no error for cosines up to this, which are rounding noise
UNSTATED = 1e300  # bound where headers state none; above any value
NO_MORE = 2e-6  # headers add this to a Fresnel term, since 1 - V.H loses digits


@case()
def half_vector_square() -> Case:
    inputs = directions_at_five_slopes()
    h = inputs["l"].astype(np.float64) + inputs["v"].astype(np.float64)
    call = "fr_half_vector_square(l + v)"
    return Case(include("half_vector"), call, inputs, (h * h).sum(axis=-1), 4e-7, 2.0 * FLOOR)


def _highest(lobe: str, m: Floats, k: int) -> Floats:
    """Return the largest value of a lobe over c.

    It is 1, except for the exact lobe of Cook-Torrance with m > 0.7071: its peak is off the normal.
    """
    w = np.maximum(m**2, 0.5) if lobe == "exact" and k else np.full_like(m, 0.5)
    return np.asarray(4.0 * w**2 * np.exp(1.0 / w - 2.0))


def brdf_case(
    term: Term, inputs: Inputs, prelude: str = "", call: str = "", f0: float = F0
) -> Case:
    """Return the case of a BRDF, called by the term's generated GLSL or by another call.

    The header states the bounds, relative to the BRDF with the lobe's peak in the same directions.
    Below the surface the BRDF is exactly 0, and so is the bound.
    """
    n, l, v, m = (inputs[axis].astype(float) for axis in "nlvm")
    n_dot_l, n_dot_v = ((n * x).sum(axis=-1) for x in (l, v))
    lower = np.minimum(n_dot_l, n_dot_v)
    n_dot_l, n_dot_v = (cosine.clip(brdf.MIN_COSINE) for cosine in (n_dot_l, n_dot_v))
    v_dot_h = 0.5 * np.linalg.norm(l + v, axis=-1).clip(1e-30)
    n_dot_h = (n_dot_l + n_dot_v) / (2.0 * v_dot_h)
    if term.entry.factors:
        masked = MASKING[term.masking].evaluate(n_dot_h, v_dot_h, n_dot_l, n_dot_v)
        fresnel = FRESNEL[term.fresnel].evaluate(f0, v_dot_h)
        peak = masked / (n_dot_l * n_dot_v) * (fresnel + NO_MORE)
    else:
        peak = f0 * (n_dot_l * n_dot_v if term.model == "ward" else n_dot_v + v_dot_h) ** -0.5
    lobe, k = lobe_entry(term.lobe), term.entry.k
    peak *= _highest(lobe.name, m, k) / (4.0 * np.pi * m**2)
    lengths = [np.linalg.norm(x, axis=-1) for x in (n, l, v)]
    off = np.abs(np.subtract(lengths, 1.0)).max(axis=0)
    off = np.maximum(off - 1e-7, 0.0)
    e = lobe.amplified(4e-7 * (1.0 + 1.0 / (n_dot_l + n_dot_v)) + 2.0 * off)
    accurate = lobe.of_tan2 is not None and term.keeps_small_slopes(0.0)
    bound = 1e-5 + 2e-7 / n_dot_l + 2e-7 / n_dot_v + e / (m if accurate else m**2)
    if term.entry.factors:
        bound += 3.0 * off / (f0 + NO_MORE) ** 0.2  # error of (1 - V.H)^5
    return Case(
        f"const float f0 = {f0};\n" + (prelude or flat(library.prelude(term, 0.0))),
        call or library.call(term),
        inputs,
        term.brdf(n, l, v, m, f0),
        0.0,
        np.select([lower > NOISE, lower > -NOISE / 10], [peak * bound, UNSTATED], 0.0),
    )


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
    """Return every direction of EXTREMES at every slope."""
    light, eye = (singles(vectors) for vectors in zip(*EXTREMES.values(), strict=True))
    n = np.tile(singles([0, 0, 1]), (len(light) * len(m), 1))
    l, v = (np.tile(vectors, (len(m), 1)) for vectors in (light, eye))
    return {"n": n, "l": l, "v": v, "m": np.repeat(singles(m), len(light))}


@cache
def directions_and_extremes(end: float) -> dict[str, Singles]:
    """Return random and extreme directions at slopes up to ``end``."""
    m = singles([1e-4, 1e-3, 0.01, *np.geomspace(0.05, 0.999, 12) * end])
    parts = directions(np.resize(m, DIRECTIONS + 1)), extremes([1e-4, 1e-2, 0.3, 0.99 * end])
    return {axis: np.concatenate([part[axis] for part in parts]) for axis in "nlvm"}


def in_domain(term: Term, prelude: str, call: str) -> Case:
    end = lobe_entry(term.lobe).end(term.entry.k)
    return brdf_case(term, directions_and_extremes(end), prelude, call)


def among_all(
    two: bool, model: str, lobe: AnyLobe, fresnel: str, masking: str, small_slope: bool = True
) -> Case:
    """Return the case of a term with one or two lobes, in a program that contains every lobe."""
    term = Term(model, lobe, fresnel, masking, small_slope=small_slope)
    small = {} if small_slope else {"FR_SMALL_SLOPE": "0"}
    prelude = include(library.file_of(term, two), **library.lobe_macros(lobe) | EVERY | small)
    if two:
        return two_lobes(term, prelude, library.call(term, 1.0))
    return in_domain(term, prelude, library.call(term))


def model_by_macros(model: str, lobe: AnyLobe, fresnel: str, masking: str) -> Case:
    """Return the case of a model's function whose terms are chosen by the host's macros."""
    term = Term(model, lobe, fresnel, masking)
    macros = library.term_macros(Term("cook-torrance", lobe, fresnel, masking), 0.0)
    files = "".join(f'#include "facerender/{entry.file}.glsl"\n' for entry in MODELS.values())
    own = f"fr_{term.entry.file}(n, l, v, m"
    call = f"{own}, f0)" if term.entry.factors else f"f0 * {own})"
    return in_domain(term, library.defines(macros) + flat(files), call)


@cache
def pairs_of_slopes(end: float) -> dict[str, Singles]:
    """Return random and extreme directions, each with two slopes up to ``end`` and a weight."""
    inputs = directions_and_extremes(end)
    m = inputs["m"]
    share = singles(np.random.default_rng(3).choice([0.0, 0.001, 0.15, 0.5, 0.85, 1.0], m.size))
    return {**inputs, "second_m": np.roll(m, 5), "lobe_weight": share}


def two_lobes(term: Term, prelude: str, call: str) -> Case:
    """Return the case of a BRDF with two lobes; its value and bound are weighted sums of both."""
    both = pairs_of_slopes(lobe_entry(term.lobe).end(term.entry.k))
    first, second = (brdf_case(term, both | {"m": both[name]}) for name in ("m", "second_m"))
    w = both["lobe_weight"].astype(float)
    return Case(
        f"const float f0 = {F0};\n" + prelude,
        call,
        both,
        w * first.expected + (1.0 - w) * second.expected,
        0.0,
        w * first.absolute + (1.0 - w) * second.absolute,
    )


def two_lobes_by_macros(model: str, lobe: AnyLobe, fresnel: str, masking: str) -> Case:
    term = Term(model, lobe, fresnel, masking)
    entry = term.entry.two
    assert entry is not None
    call = f"fr_{entry.file}(n, l, v, m, second_m, lobe_weight, f0)"
    return two_lobes(term, include(entry.file, **library.term_macros(term, 0.0)), call)


def in_colour(lobe: AnyLobe, f0: float) -> Case:
    """Return the case of fr_cook_torrance_rgb with f90 = 1."""
    term = Term("cook-torrance", lobe)
    prelude = include("cook_torrance", **library.lobe_macros(lobe))
    call = f"fr_cook_torrance_rgb(n, l, v, m, vec3({f0}), vec3(1.0)).z"
    end = lobe_entry(lobe).end(4)
    return brdf_case(term, directions_and_extremes(end), prelude, call, f0)


def of_parts(lobe: AnyLobe) -> Case:
    term = Term("cook-torrance", lobe, "constant")
    prelude = include("cook_torrance", **library.lobe_macros(lobe))
    call = "f0 * fr_cook_torrance_scale(FR_DEFAULT_LOBE)"
    call += " * fr_cook_torrance_parts(n, l, v, m, FR_DEFAULT_LOBE, FR_MASKING).x"
    return in_domain(term, prelude, call)


for _lobe in ("exact", "d8"):
    add_of("fr_cook_torrance_parts", of_parts, _lobe)
    for _f0 in (0.5, 0.0, 1e-8):  # the error of 1 - V.H shows where f0 is near 0
        add_of("fr_cook_torrance_rgb", in_colour, _lobe, _f0)

DEFAULT = (Term.fresnel, Term.masking)
FACTORS = dict.fromkeys(
    [
        *((fresnel, Term.masking) for fresnel in FRESNEL),
        *((Term.fresnel, masking) for masking in MASKING),
        *(("constant", "none"), ("dielectric", "kelemen")),
    ]
)

for _model, _brdf in MODELS.items():
    _one, _two = partial(among_all, False), partial(among_all, True)
    _terms = f"fr_{_brdf.file}_terms"
    _both = f"fr_{_brdf.two.file}_terms" if _brdf.two else "two-calls"
    for _factors in FACTORS if _brdf.factors else [DEFAULT]:
        for _lobe in ALL_LOBES:
            _names = _model, _lobe, *_factors
            add_of(_terms, _one, *_names)
            if _factors == DEFAULT or _lobe == Term.lobe:
                add_of("models-by-macros", model_by_macros, *_names)
            if _factors == DEFAULT or (_brdf.two and _lobe == Term.lobe):
                add_of(_both, _two, *_names)
            if _factors == DEFAULT and _brdf.two:
                add_of(f"fr_{_brdf.two.file}", two_lobes_by_macros, *_names)
        add_of(_terms, _one, _model, Term.lobe, *_factors, False)
    if _brdf.two:
        add_of(_both, _two, _model, Term.lobe, *DEFAULT, False)


@case()
def cook_torrance_half() -> Case:
    """Every target has the bound of half precision; tests/test_half.py emulates half precision."""
    inputs = directions(np.resize(singles(np.linspace(0.1, 1.0, 10)), DIRECTIONS), 0.05)
    n, l, v, m = (inputs[axis].astype(float) for axis in "nlvm")
    n_dot_l, n_dot_v = (n * l).sum(axis=-1), (n * v).sum(axis=-1)
    v_dot_h = 0.5 * np.linalg.norm(l + v, axis=-1)
    n_dot_h = (n_dot_l + n_dot_v) / (2.0 * v_dot_h)
    masked = brdf.masking_v_cavity(n_dot_h, v_dot_h, n_dot_l, n_dot_v)
    peak = brdf.fresnel_schlick(F0, v_dot_h) * masked / (4.0 * np.pi * m**2 * n_dot_l * n_dot_v)
    call = f"fr_cook_torrance_half(n, l, v, m, {F0})"
    expected = brdf.cook_torrance(n, l, v, m, F0)
    return Case(include("cook_torrance_half"), call, inputs, expected, 0.0, 0.01 * peak)


# --- sampling ------------------------------------------------------------------------------------

SINE = 2.0**-11  # error of sine and cosine that Vulkan allows; Chromium's renderer uses it


@cache
def directions_and_numbers() -> dict[str, Singles]:
    """Return directions and random numbers that choose the same side of a cavity after rounding."""
    inputs = directions(np.resize(singles([1e-3, 0.01, *np.linspace(0.05, 2.0, 8)]), DIRECTIONS))
    u = np.random.default_rng(5).random((DIRECTIONS, 3), dtype=np.float32)
    n, v, m = (inputs[name].astype(float) for name in "nvm")
    across = brdf.slope_sample(unit(n), m, u[:, :2])
    first, second = (
        (unit(v) * h).sum(axis=-1).clip(0) for h in (unit(n) + across, unit(n) - across)
    )
    length = np.linalg.norm(across, axis=-1)
    doubt = np.abs(u[:, 2] * (first + second) - first) < 4.0 * SINE * (1.0 + length)
    u[doubt, 2] = 0.0
    u[doubt & (first < 8.0 * SINE * (1.0 + length)), 2] = 0.99
    return {**inputs, "p": u}


def unit(x: Floats) -> Floats:
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


@case(*((axis,) for axis in "xyz"))
def slope_sample(axis: str) -> Case:
    inputs = directions_and_numbers()
    n, u, m = (inputs[name].astype(float) for name in "npm")
    slopes_ = brdf.slope_sample(unit(n), m, u[:, :2])
    length = np.linalg.norm(slopes_, axis=-1)
    call = f"10.0 + fr_slope_sample(n, m, p.xy).{axis}"
    expected = 10.0 + slopes_[:, "xyz".index(axis)]
    absolute = 2e-6 * (2.0 + length) + SINE * length
    return Case(include("slope_sample"), call, inputs, expected, 0.0, absolute)


def model_sample(model: str, axis: str) -> Case:
    """Return the case of a component of a sampled direction.

    Where rounding decides whether Ward's half vector faces away, any result is accepted.
    """
    inputs = directions_and_numbers()
    n, v, u, m = (inputs[name].astype(float) for name in "nvpm")
    count, numbers = (3, "p") if model == "cook_torrance" else (2, "p.xy")
    l = getattr(brdf, f"{model}_sample")(unit(n), unit(v), m, u[:, :count])
    across = brdf.slope_sample(unit(n), m, u[:, :2])
    turned = np.abs((unit(v) * (unit(n) + across)).sum(axis=-1))
    close = turned < 2.0 * SINE * (1.0 + np.linalg.norm(across, axis=-1))
    absolute = np.where(close & (model == "ward"), 4.0, 1e-5 + 2.0 * SINE)
    call = f"2.0 + fr_{model}_sample(n, v, m, {numbers}).{axis}"
    expected = 2.0 + l[:, "xyz".index(axis)]
    return Case(include(f"{model}_sample"), call, inputs, expected, 0.0, absolute)


for _model in ("cook_torrance", "ward"):
    for _axis in "xyz":
        add(f"fr_{_model}_sample {_axis}", model_sample, _model, _axis)


@case(("cook_torrance",), ("ward",))
def pdf(model: str) -> Case:
    inputs = directions_and_extremes(lobes.MAX_SLOPE)
    n, l, v, m = (inputs[name].astype(float) for name in "nlvm")
    expected = getattr(brdf, f"{model}_pdf")(n, l, v, m)
    n_dot_l, n_dot_v = ((n * x).sum(axis=-1) for x in (l, v))
    n_dot_h = n_dot_l + n_dot_v
    above = (
        np.minimum(n_dot_l, n_dot_v) if model == "ward" else np.minimum(n_dot_h, n_dot_v)
    ) > brdf.MIN_COSINE
    safe = np.where(above, n_dot_h, 1.0), np.where(above, n_dot_v, 1.0)
    seen = np.minimum(
        1.0, 4.0 * safe[0] * safe[1] / np.where(above, ((l + v) ** 2).sum(axis=-1), 1.0)
    )
    peak = 0.5 / safe[0] if model == "ward" else seen / (4.0 * safe[1])
    peak *= _highest("exact", m, 4) / (np.pi * m**2)
    e = 4e-7 * (1.0 + 1.0 / safe[0])
    bound = 1e-5 + 2e-7 / safe[1] + e / m
    call = f"fr_{model}_pdf(n, l, v, m)"
    return Case(
        include(f"{model}_sample"), call, inputs, expected, 0.0, np.where(above, peak * bound, 0.0)
    )


# --- albedo --------------------------------------------------------------------------------------


@cache
def cosines_slopes_and_reflectances() -> dict[str, Singles]:
    axes = grid(
        [*np.linspace(0.0, 1.0, 101), 1e-4, 1e-3],
        [1e-3, *np.linspace(0.05, 1.5, 20)],
        [0.0, F0, 0.9],
    )
    return dict(zip(("c", "m", "f0"), axes, strict=True))


@case(
    ("cook_torrance_albedo(c, m, f0)", ""),
    ("cook_torrance_albedo(c, m, f0)", "fr_albedo_of(fr_albedo_fit(m, f0), c)"),
    ("cook_torrance_albedo_mean(m, f0)", ""),
    ("cook_torrance_albedo_mean(m, f0)", "fr_albedo_mean(fr_albedo_fit(m, f0))"),
    ("diffuse_coupled(m, c, f0)", ""),
)
def albedo(function: str, call: str) -> Case:
    """Return the case of a function, or of an equivalent call."""
    inputs = cosines_slopes_and_reflectances()
    name, words = function.rstrip(")").split("(")
    expected = getattr(brdf, name)(*(inputs[word].astype(float) for word in words.split(", ")))
    return Case(include("albedo"), call or f"fr_{function}", inputs, expected, 4 * ULP, 2e-6)


GROUPS = tuple(dict.fromkeys(name.split()[0] for name in CASES))
