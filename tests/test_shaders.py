"""Tests conventions of the shader library, defaults of its macros, ends of domains, and formulas as
published. ``test_targets.py`` tests the values of its functions."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import moderngl
import numpy as np
import pytest

from facerender import InputError, brdf, lobes, resolve_includes, shader_dir, shader_source
from facerender.drawing.context import Backend, create_context
from facerender.glsl.library import defines, lobe_macros
from facerender.scene.shading import Term
from facerender.terms.lobe import LOBES, Lobe, lobe_entry
from facerender.terms.model import FRESNEL, MASKING, Fresnel, Masking
from tests.verification.cases import brdf_case, directions, flat, include
from tests.verification.evaluate import Evaluator

COOK_TORRANCE = "fr_cook_torrance(n, l, v, m, 0.028)"
FILES = sorted((shader_dir() / "facerender").rglob("*.glsl"))


@pytest.fixture(scope="module")
def evaluate(backend: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(backend).gl)
    yield evaluator
    evaluator.release()


@pytest.mark.first_case
@pytest.mark.parametrize("model", ["cook-torrance", "ward"])
def test_exact_term_is_accurate_where_it_is_visible(evaluate, model):
    """The relative error is at most 1e-4 where the lobe is above 1/1000 of its peak."""
    m = np.resize(np.float32(np.linspace(0.05, 1.0, 20)), 200000)
    inputs = directions(m, lowest=0.02)
    case = brdf_case(Term(model), inputs)
    result = evaluate(case.prelude, case.expression, inputs)
    half = inputs["l"].astype(float) + inputs["v"]
    c = (half * inputs["n"]).sum(axis=-1) / np.linalg.norm(half, axis=-1)
    shown = lobes.exact(c.clip(0.0, 1.0), m, 0) > 1e-3
    assert shown.sum() > 50000
    error = np.abs(result - case.expected)[shown] / case.expected[shown]
    assert error.max() < 1e-4


@pytest.mark.parametrize("f0", [0.0, 1e-8, 0.028])
def test_error_of_normals_off_unit_length_is_in_the_bound(evaluate, f0):
    m = np.resize(np.float32(np.linspace(0.05, 1.0, 20)), 100000)
    inputs = directions(m, lowest=0.02)
    inputs["n"] = inputs["n"] * np.float32(0.999999)
    case = brdf_case(Term("cook-torrance"), inputs, f0=f0)
    assert not case.fault(evaluate(case.prelude, case.expression, inputs))


def test_slopes_outside_the_domain_are_clamped(evaluate):
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
        assert least < none < np.inf


@pytest.mark.parametrize(
    ("macro", "default", "m"),
    [
        ("FR_SMALL_SLOPE", "1", 0.01),
        ("FR_LOBE", "FR_LOBE_EXACT", 0.3),
        ("FR_FRESNEL", "FR_FRESNEL_SCHLICK", 0.3),
        ("FR_MASKING", "FR_MASKING_V_CAVITY", 0.3),
    ],
)
def test_choices_have_defaults(evaluate, macro, default, m):
    inputs = directions(np.full(2000, m, np.float32))
    implicit, explicit = (
        evaluate(include("cook_torrance", **macros), COOK_TORRANCE, inputs)
        for macros in ({}, {macro: default})
    )
    np.testing.assert_array_equal(implicit, explicit)


@pytest.mark.parametrize("name", ["fitted", "fitted-fine"])
def test_fitted_coefficients_may_come_from_the_host(evaluate, name):
    inputs = {"c": np.float32(np.linspace(0.0, 1.0, 100)), "m": np.full(100, 0.3, np.float32)}
    a = ", ".join(map(str, lobes.FITTED[name, 4].coefficients(0.3)))
    macro = f"FR_{name.upper().replace('-', '_')}_COEFFICIENTS"
    vector = f"vec{3 + name.endswith('fine')}({a})"
    prelude = include("lobe", **lobe_macros(name) | {f"{macro}(m, k)": vector})
    given = evaluate(prelude, "fr_lobe(c, 0.9, 4)", inputs)  # ignores m
    np.testing.assert_allclose(given, lobes.lobe(name, inputs["c"], 0.3, 4), atol=1e-5)


@pytest.mark.parametrize(
    ("model", "file", "call", "f0"),
    [
        ("cook-torrance", "cook_torrance", "fr_printed_cook_torrance(n, l, v, m, 0.028)", 0.028),
        ("ward-printed", "ward", "fr_printed_ward(n, l, v, m)", 1.0),
    ],
)
@pytest.mark.parametrize("lobe", ["exact", "d4", "d8", "d16"])
def test_published_forms_agree_where_they_are_valid(evaluate, model, file, call, f0, lobe):
    inputs = directions(np.full(5000, 0.3, np.float32), lowest=0.2)
    expected = Term(model, lobe).brdf(*inputs.values(), f0)
    prelude = defines(lobe_macros(lobe)) + flat(f'#include "printed/{file}.glsl"\n')
    result = evaluate(prelude, call, inputs)
    # The published power rises again where ours is clamped. If V.H or N.H is rounded above 1, pow
    # of a negative base and acos are NaN.
    half = (inputs["l"] + inputs["v"]).astype(float)
    c = (half * inputs["n"]).sum(axis=-1) / np.linalg.norm(half, axis=-1)
    away = ((inputs["l"] * inputs["v"]).sum(axis=-1) < 0.9999) & (c < 0.9999)
    sound = (expected > 0.0) & away
    # Ward as published loses three digits in acos and tan.
    np.testing.assert_allclose(result[sound], expected[sound], rtol=2e-3, atol=1e-5)


def functions(code: str) -> list[str]:
    return re.findall(r"^\w+ (\w+)\([^;]*\)\s*\{", code, re.MULTILINE)


def test_every_reference_function_exists_in_glsl():
    source = "".join(path.read_text() for path in FILES)
    host_only = {"check_slope", "in_domain", "max_slope"}
    for module, prefix in ((lobes, "fr_lobe_"), (brdf, "fr_")):
        public = {name for name, value in vars(module).items() if inspect.isfunction(value)}
        assert public > host_only if module is lobes else public
        for name in public - host_only:
            twin = "fr_lobe" if name == "lobe" else prefix + name
            assert re.search(rf"\b{twin}\(", source), name


def test_constants_of_the_fitted_lobes_are_the_same_in_glsl():
    source = (shader_dir() / "facerender/lobe/fitted.glsl").read_text()
    rows = re.findall(r"vec[34]\((-?[\d.]+, [-\d., ]+)\)", source)
    tables = [lobes.FITTED[key].table for key in lobes.FITTED]
    assert [tuple(map(float, row.split(","))) for row in rows] == [r for t in tables for r in t]


@pytest.mark.parametrize("name", ["FR_LOBE_D32", "77", "0"])
def test_unknown_lobe_does_not_compile(evaluate, name):
    prelude = include("ward", FR_LOBE=name)
    with pytest.raises(moderngl.Error, match="FR_LOBE is none of"):
        evaluate(prelude, "fr_lobe(1.0, m, 0)", {"m": np.float32([0.3])})


GENERAL = {"FR_LOBE_OWN": 90, "FR_LOBE_EVERY": 91}  # numbers in lobe.glsl without a lobe
DISPATCH: dict[str, list[Lobe | Fresnel | Masking]] = {
    "lobe": [*LOBES.values(), lobe_entry(lobes.GPower(8, 0.25))],
    "fresnel": [*FRESNEL.values()],
    "masking": [*MASKING.values()],
}


@pytest.mark.parametrize("kind", DISPATCH)
def test_registry_and_glsl_have_the_same_macros(kind):
    """The cases of test_targets.py call each term by its macro."""
    text = (shader_dir() / f"facerender/{kind}.glsl").read_text(encoding="utf-8")
    macros = {entry.macro: entry.number for entry in DISPATCH[kind]}
    macros |= GENERAL if kind == "lobe" else {}
    assert len({*macros.values()}) == len(macros)
    defined = re.findall(rf"^#define (FR_{kind.upper()}_\w+) (\d+)$", text, re.MULTILINE)
    assert sorted(defined) == sorted((macro, str(number)) for macro, number in macros.items())
    if kind == "lobe":
        message = " ".join(re.findall("^#error .*", text, re.MULTILINE))
        assert all(re.search(rf" {number} {macro}\b", message) for macro, number in macros.items())


def test_lobe_that_is_not_available_does_not_compile(evaluate):
    inputs = {"c": np.float32([0.9])}
    names = [entry.macro for entry in LOBES.values()]
    for lobe, name in zip(names, [*names[1:], names[0]], strict=True):
        prelude = include("lobe", FR_LOBE=lobe)
        assert evaluate(prelude, f"fr_lobe_of(c, 0.3, 4, {lobe})", inputs) > 0.0
        with pytest.raises(moderngl.Error, match=name):
            evaluate(prelude, f"fr_lobe_of(c, 0.3, 4, {name})", inputs)
    assert evaluate(prelude, "fr_lobe_of(c, 0.3, 4, 99)", inputs) == 0.0


PAIRS = [
    ("cook_torrance", "ward", "FR_LOBE", "FR_LOBE_EXACT", "FR_LOBE_D16"),
    ("ward", "cook_torrance", "FR_LOBE", "FR_LOBE_FITTED", "2"),
    ("lobe", "lobe", "FR_LOBE", "FR_LOBE_D8", "FR_LOBE_D16"),
    ("cook_torrance", "cook_torrance_two", "FR_FRESNEL", "FR_FRESNEL_SCHLICK", "1"),
    ("environment", "cook_torrance", "FR_MASKING", "1", "FR_MASKING_NONE"),
    ("cook_torrance", "cook_torrance", "FR_MASKING", "FR_MASKING_KELEMEN", "0"),
    ("cook_torrance_sample", "ward", "FR_SMALL_SLOPE", "1", "0"),
]


@pytest.mark.parametrize(("first", "second", "macro", "value", "other"), PAIRS)
def test_macro_that_changes_between_includes_does_not_compile(
    evaluate, first, second, macro, value, other, tmp_path
):
    """The includes of a program share code, which can have one value of each macro."""
    define = f"#undef {macro}\n#define {macro} {{}}\n".format
    files = [f'#include "facerender/{file}.glsl"\n' for file in (first, second)]
    text = define(value) + files[0] + define(other) + files[1]
    inputs = {"x": np.float32([0.5])}
    message = f"{macro} differs from its value at the first include"
    with pytest.raises(moderngl.Error, match=message):
        evaluate(resolve_includes(text), "x", inputs)
    flat = "".join([define(value), shader_source(first), define(other), shader_source(second)])
    with pytest.raises(moderngl.Error, match=message):
        evaluate(flat, "x", inputs)
    (tmp_path / "both.glsl").write_text(text)
    with pytest.raises((InputError, moderngl.Error), match=message):
        evaluate(shader_source(str(tmp_path / "both.glsl")), "x", inputs)
    same = define(value) + files[0] + define(value) + files[1]
    assert evaluate(resolve_includes(same), "x", inputs) == 0.5


def test_lobe_of_a_host_needs_its_function(evaluate):
    prelude = include("lobe", FR_LOBE="FR_LOBE_OWN")
    with pytest.raises(moderngl.Error, match="FR_LOBE_OWN needs FR_LOBE_FUNCTION"):
        evaluate(prelude, "fr_lobe(c, 0.3, 4)", {"c": np.float32([0.9])})


def test_directives_suit_every_preprocessor():
    """The preprocessors of naga and Babylon.js lack features of GLSL's. test_hosts.py and
    test_web.py run them."""
    term = r"FR_\w+ == \w+|!?defined\(FR_\w+\)"
    for path in FILES:
        for line in path.read_text(encoding="utf-8").split("\n"):
            if line.startswith(("#if ", "#elif ")):
                assert re.fullmatch(rf"#\w+ ({term})( (\|\||&&) ({term}))*", line), line
            elif line.startswith("#include"):
                assert (path.parent / line.split('"')[1]).is_file(), "beside the file"
            else:  # naga takes quotes for GLSL's, and Babylon.js reads comments as well
                assert not re.search(r"#error.*['\"]|.#(if|el|endif)", line), line
