"""Every public function of the shader library against its NumPy twin, and its conventions.

The bounds come from the precision that OpenGL and Vulkan ask of drivers, in units of the last place
(2^-23): division 2.5, inversesqrt 2, exp(x) 3 + 2|x|; sums and products 0.5.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import moderngl
import numpy as np
import pytest

from facerender import InputError, brdf, lobes, shader_dir, shader_source
from facerender.context import Backend
from tests.gpu import Evaluator

ULP = 2.0**-23
TINY = 1.2e-38  # where float32's full precision ends; drivers may flush what is smaller to zero
SLOPES = np.float32([0.05, 0.1, 0.2, 0.3, 0.5, 0.7])  # in every lobe's domain
WIDE_SLOPES = np.float32([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0])  # in that of the exact lobe
FILES = sorted((shader_dir() / "facerender").rglob("*.glsl"))


@pytest.fixture(scope="module")
def evaluate(backend: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(backend)
    yield evaluator
    evaluator.release()


def include(name: str) -> str:
    return f'#include "facerender/{name}.glsl"\n'


def grid(*axes):
    return [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]


def check(result, expected, relative, absolute=TINY):
    assert np.isfinite(result).all()
    assert (result >= 0.0).all()
    excess = np.abs(result - expected) - relative * expected - absolute
    worst = excess.argmax()
    assert excess[worst] <= 0.0, f"at {worst}: {result[worst]} in place of {expected[worst]}"


@pytest.mark.parametrize("k", [0, 4])
def test_exact_lobe_from_the_tangent(evaluate, k):
    tan2, m = grid(np.float32([0.0, *np.logspace(-6, 6, 200), 1e20, np.inf]), WIDE_SLOPES)
    result = evaluate(
        include("lobe/exact"), f"fr_lobe_exact_tan2(tan2, m, {k})", {"tan2": tan2, "m": m}
    )
    exponent = np.minimum(tan2 / m.astype(float) ** 2, 100.0)
    # m^2 and the division: 3 ulp of the exponent; exp: 3 + 2 x; 1/c^4: 2
    smallest = TINY * (1.0 + np.minimum(tan2, 1e3)) ** 2  # E flushed to zero, times 1/c^4
    check(result, lobes.exact_tan2(tan2, m, k), ULP * (5.0 + 5.0 * exponent), smallest)


@pytest.mark.parametrize("k", [0, 4])
def test_exact_lobe_from_the_cosine(evaluate, k):
    c, m = grid(np.float32(np.cos(np.linspace(0.0, np.pi / 2, 500))).clip(0, 1), WIDE_SLOPES)
    result = evaluate(include("lobe/exact"), f"fr_lobe_exact(c, m, {k})", {"c": c, "m": m})
    x = c.astype(float).clip(1e-3)
    exponent = np.minimum((1.0 / x**2 - 1.0) / m.astype(float) ** 2, 100.0)
    # as above, and five operations more for tan2
    smallest = TINY / np.maximum(x, 0.03) ** 4
    check(result, lobes.exact(c, m, k), ULP * (10.0 + 9.0 * exponent), smallest)


@pytest.mark.parametrize("k", [0, 4])
def test_cosine_lobe(evaluate, k):
    c, m = grid(np.float32(np.cos(np.linspace(0.0, np.pi / 2, 500))).clip(0, 1), SLOPES)
    result = evaluate(include("lobe/cosine"), f"fr_lobe_cosine(c, m, {k})", {"c": c, "m": m})
    n = 2.0 / m.astype(float) ** 2 - k
    x = c.astype(float).clip(1e-6)
    power = np.minimum(n * -np.log2(x), 130.0)
    # log2: 3 ulp, but 2^-21 absolute in [0.5, 2]; n: 4 ulp, more where 2/m^2 - k cancels
    n_error = ULP * (3.0 * 2.0 / m.astype(float) ** 2 + k) / n
    log_error = np.where(x >= 0.5, 2.0**-21, 3.0 * ULP * -np.log2(x))
    relative = np.log(2.0) * (power * n_error + n * log_error) + ULP * (3.0 + 3.0 * power)
    check(result, lobes.cosine(c, m, k), relative)


@pytest.mark.parametrize("k", [0, 4])
@pytest.mark.parametrize("g", [4, 8, 16])
def test_g_power_lobe(evaluate, k, g):
    c, m = grid(np.float32(np.cos(np.linspace(0.0, np.pi / 2, 500))).clip(0, 1), SLOPES)
    result = evaluate(include("lobe/g_power"), f"fr_lobe_g_power(c, m, {k}, {g})", {"c": c, "m": m})
    n = 2.0 / m.astype(float) ** 2 - k
    # the base b = 1 - (n/g) u: n by 4 ulp, n/g and the product by 3.5 more, the sum by 0.5; and
    # d(b^g) = g b^(g-1) db <= g db, plus the squarings
    base_error = ULP * (4.0 * 2.0 / m.astype(float) ** 2 + 4.0 * n) / g * (1.0 - c) + ULP
    check(result, lobes.g_power(c, m, k, g), ULP * g, absolute=g * base_error)


def test_fresnel(evaluate):
    cosines = np.float32([*np.linspace(0, 1, 501), 1e-9, 1e-20])
    f0, c = grid(np.float32([0.0, 1e-8, 1e-4, 0.028, 0.1, 0.5, 0.9]), cosines)
    inputs = {"f0": f0, "c": c}
    schlick = evaluate(include("fresnel"), "fr_fresnel_schlick(f0, c)", inputs)
    check(schlick, brdf.fresnel_schlick(f0, c), 8 * ULP, absolute=8 * ULP)
    exact = evaluate(include("fresnel"), "fr_fresnel_dielectric(f0, c)", inputs)
    # square root, division, square: 10 ulp; b is a difference, and its loss is absolute
    check(exact, brdf.fresnel_dielectric(f0, c), 16 * ULP, absolute=16 * ULP * f0)


def test_masking(evaluate):
    axis = np.float32(np.linspace(0.01, 1.0, 12))
    names = ("n_dot_h", "v_dot_h", "n_dot_l", "n_dot_v")
    inputs = dict(zip(names, grid(axis, axis, axis, axis), strict=True))
    result = evaluate(include("masking"), f"fr_masking_v_cavity({', '.join(names)})", inputs)
    check(result, brdf.masking_v_cavity(*inputs.values()), 4 * ULP)


def unit_vectors(count: int, seed: int, lowest: float):
    """Directions at least ``lowest`` above the plane of N = (0, 0, 1), rounded to float32."""
    random = np.random.default_rng(seed)
    z = random.uniform(lowest, 1.0, count)
    angle = random.uniform(0.0, 2 * np.pi, count)
    r = np.sqrt(1.0 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)


BRDFS = {
    "cook_torrance": ("fr_cook_torrance(n, l, v, m, 0.028)", "schlick"),
    "cook_torrance, dielectric": ("fr_cook_torrance(n, l, v, m, 0.028)", "dielectric"),
    "ward": ("fr_ward(n, l, v, m)", None),
    "ward_printed": ("fr_ward_printed(n, l, v, m)", None),
}


def reference(name, fresnel, lobe, n, l, v, m):
    if fresnel:
        return brdf.cook_torrance(n, l, v, m, 0.028, lobe=lobe, fresnel_term=fresnel)
    return getattr(brdf, name)(n, l, v, m, lobe=lobe)


@pytest.mark.parametrize("lobe", lobes.NAMES)
@pytest.mark.parametrize("case", BRDFS)
def test_brdf(evaluate, case, lobe):
    call, fresnel = BRDFS[case]
    name = case.split(",")[0]
    count = 20000
    l, v = unit_vectors(count, 1, 0.02), unit_vectors(count, 2, 0.02)
    l[:1000] = v[:1000] * np.float32([-1, -1, 1])  # mirror directions: the peak of the lobe
    l[1000:2000] = v[1000:2000]
    n = np.tile(np.float32([0, 0, 1]), (count, 1))
    m = np.resize(WIDE_SLOPES[1:] if lobe == "exact" else SLOPES[1:], count)
    defines = f"#define FR_LOBE FR_LOBE_{lobe.upper()}\n"
    if fresnel:
        defines += f"#define FR_FRESNEL FR_FRESNEL_{fresnel.upper()}\n"
    result = evaluate(defines + include(name), call, {"n": n, "l": l, "v": v, "m": m})
    expected = reference(name, fresnel, lobe, n, l, v, m)

    # The header's bound; the peak is what these directions would give with a lobe of 1.
    half = (l.astype(float) + v) / np.linalg.norm(l.astype(float) + v, axis=1)[:, None]
    k = 4 if fresnel else 0
    shape = lobes.lobe(lobe, np.clip((half * n).sum(axis=1), 0.0, 1.0), m, k)
    peak = np.divide(expected, shape, out=np.zeros(count), where=shape > 1e-30)
    slope = m.astype(float)
    check(result, expected, 0.0, absolute=peak * (5e-7 / slope**2 + 1e-5) + 1e-30)


@pytest.mark.parametrize("case", BRDFS)
@pytest.mark.parametrize("lobe", lobes.NAMES)
def test_brdf_at_the_extremes(evaluate, case, lobe):
    """Light or eye below the surface gives exactly 0; the horizon and V = -L stay finite."""
    call, fresnel = BRDFS[case]
    rows = {
        "light below": ([0.6, 0, -0.8], [0, 0, 1]),
        "eye below": ([0, 0, 1], [0.6, 0, -0.8]),
        "V = -L": ([0.6, 0, 0.8], [-0.6, 0, -0.8]),
        "V = -L at the horizon": ([1, 0, 0], [-1, 0, 0]),
        "both at the horizon": ([1, 0, 0], [0, 1, 0]),
        "nearly at the horizon": ([1, 0, 1e-20], [-1, 0, 1e-20]),
        "mirror at 1e-7": ([1, 0, 1e-7], [-1, 0, 1e-7]),
        "longer by 1e-6": ([0, 0, 1.000001], [0, 0, 1.000001]),
    }
    l, v = (np.float32([row[side] for row in rows.values()]) for side in (0, 1))
    slopes = np.float32([1e-4, 1e-2, 0.3, 0.7])
    count = len(rows)
    m = np.repeat(slopes, count)
    inputs = {
        "n": np.tile(np.float32([0, 0, 1]), (len(m), 1)),
        "l": np.tile(l, (len(slopes), 1)),
        "v": np.tile(v, (len(slopes), 1)),
        "m": m,
    }
    defines = f"#define FR_LOBE FR_LOBE_{lobe.upper()}\n"
    if fresnel:
        defines += f"#define FR_FRESNEL FR_FRESNEL_{fresnel.upper()}\n"
    result = evaluate(defines + include(case.split(",")[0]), call, inputs)
    assert np.isfinite(result).all()
    assert (result >= 0.0).all()
    assert (result.reshape(len(slopes), count)[:, :5] == 0.0).all()


def test_reflectance_of_unsaid_choices_is_exact_and_schlick(evaluate):
    inputs = {"c": np.float32([0.95])}
    at = "fr_lobe(c, 1.0, 0.3, FR_K_COOK_TORRANCE) + fr_fresnel(0.028, c)"
    value = evaluate(include("cook_torrance"), at, inputs)
    c = float(inputs["c"][0])
    expected = lobes.exact(c, np.float32(0.3), 4) + brdf.fresnel_schlick(0.028, c)
    np.testing.assert_allclose(value, expected, rtol=1e-5)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_conventions_of_a_shader_file(path):
    text = path.read_text()
    code = re.sub(r"//[^\n]*", "", text)
    guard = re.search(r"#ifndef (FR_\w+)\n#define \1\n", code)
    assert text.startswith("// "), "a header comment comes first"
    assert guard, "an include guard"
    assert code.rstrip().endswith("#endif")
    functions = re.findall(r"^\w+ (\w+)\([^;]*\)\s*\{", code, re.MULTILINE)
    macros = re.findall(r"^\s*#\s*define\s+(\w+)", code, re.MULTILINE)
    assert all(name.startswith("fr_") for name in functions)
    assert all(name.startswith("FR_") for name in macros)
    if functions:
        header = text[: text.index("#ifndef")]
        assert re.search(r"^//\s+(unit|result)\b", header, re.MULTILINE)
        assert re.search(r"^//\s+error\b", header, re.MULTILINE)
        assert all(re.search(rf"\b{name}\b", __source__()) for name in functions), "tested here"


def __source__() -> str:
    with open(__file__, encoding="utf-8") as file:
        return file.read()


def test_every_reference_function_has_its_twin_in_glsl():
    source = "".join(path.read_text() for path in FILES)
    host_only = {"lobe", "check_slope", "max_slope"}  # fr_lobe takes products of vectors
    for module, prefix in ((lobes, "fr_lobe_"), (brdf, "fr_")):
        for name, function in inspect.getmembers(module, inspect.isfunction):
            public = function.__module__ == module.__name__ and not name.startswith("_")
            if public and name not in host_only:
                assert f"float {prefix}{name}(" in source


def test_source_is_flat_and_includes_may_stand_in_conditions(evaluate):
    assert "#include" not in shader_source("cook_torrance")
    prelude = "#ifdef ABSENT\n" + include("ward") + "#endif\n" + include("cook_torrance")
    up = np.float32([[0, 0, 1]])
    inputs = {"n": up, "l": up, "v": up}
    assert evaluate(prelude, "fr_cook_torrance(n, l, v, 0.3, 0.028)", inputs) > 0.0
    with pytest.raises(InputError, match=r"no shader file facerender/ggx.glsl in "):
        shader_source("ggx")


@pytest.mark.parametrize("name", ["FR_LOBE_D32", "5", "0"])
def test_unknown_lobe_does_not_compile(evaluate, name):
    prelude = f"#define FR_LOBE {name}\n" + include("ward")
    with pytest.raises(moderngl.Error, match="FR_LOBE is none of"):
        evaluate(prelude, "fr_lobe(1.0, 1.0, m, 0)", {"m": np.float32([0.3])})
