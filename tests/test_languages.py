"""Tests the translations of the shader library to HLSL, WGSL and Metal: text, compilation and
results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

import numpy as np
import pytest

import facerender as fr
from facerender import InputError
from facerender.drawing.context import Backend, create_context
from facerender.glsl import library as glsl
from tests.conftest import missing, require_module
from tests.test_glsl import CHOICES
from tests.verification import metal
from tests.verification.cases import Case, cases_of, evaluated
from tests.verification.evaluate import Evaluator
from tests.verification.hosts import CHOICES as SCENES
from tests.verification.hosts import SCENE, SIZE, desktop
from tests.verification.targets import (
    LAVAPIPE,
    TRANSLATED,
    UNTRANSLATED,
    Remote,
    compiled,
    groups_of,
)

# Every file without choices, and every fourth with choices.
TEXTS = [each for each in CHOICES if each[0] not in UNTRANSLATED]
TEXTS = [each for i, each in enumerate(TEXTS) if each[1:] == (None, None) or i % 4 == 0]
SETS = "bool set(out float x) { x = 1.0; return true; }\n"
MAIN = {
    "hlsl": "float4 main() : SV_Target { return 0; }",
    "wgsl": "@fragment fn main() -> @location(0) vec4f { return vec4f(); }",
}
# GLSL that the translator supports, including features that the library does not use.
PLAIN = """
#define TWICE(x) (2.0 * (x))
// a const before one
const float UNIT = 1.0;
#define HALF (0.5)
#if HALF_OF_IT
float never(float x) { return unknown(x); }
#endif
void both(float x, out float sum, inout vec2 kept) { sum = x + kept.x; kept *= 2.0; }

float walked(float c, vec3 n, int count) {
    float total = HALF, other;  // two in one
    float one = 1, sample = total;  // a whole number, and a word of HLSL's
    total *= one + (sample - n.s) - (sample - n.r);
    for (int i = 0; i < count; ++i) {
        if (i == 2) continue;
        else if (i > 5) break;
        total += float(i) * c;
        n.xy = n.yx * -1.0;
        n.z += i % 2 == 0 ? 0.25 : TWICE(0.25) - 0.125;
    }
    vec2 kept = vec2(c, 1.0);
    both(c, other, kept);
    const mat2 turn = mat2(0.6, 0.8, -0.8, 0.6);
    vec2 turned = turn * kept + n.xy * turn;
    bool same = kept == vec2(2.0 * c, 2.0);
    kept.x++;
    --kept.xy;
    n.xy += kept;
    c = atan(turned.y, turned.x) + dot(max(n, 0.0), clamp(n, 0.0, 1.0));
    return mix(total + other, c, same ? 0.25 : 1.0) + mix(n, vec3(UNIT), 0.5).b + length(turned);
}
"""

# Numbers, nested calls of macros, and conversions.
RARE = """
#define twice(a) (2.0 * (a))
#define top(a, b) max(a, b)
#define same(a) a
float one(void) { return 1.0; }
float numbers(float c) { return c * 2.0f + 1.F - 1e0f + float(010U + 0XFu) + one(); }
float nested(float c) { return twice(twice(c)) + top(top(c, 0.1), top(0.2, twice(c))); }
float final(float c) {
#define c (c + 1.0)
    return same(c) + twice(same(c));
#undef c
}
float wider(float c) {
    ivec2 i = ivec2(1, 2);
    return 2 * c + (c > 0.5 ? 1 : 0.25) + float(i.y);
}
"""
RARE_CALLS = [f"{name}(c)" for name in ("numbers", "nested", "final", "wider")]


@pytest.fixture(scope="module", params=LAVAPIPE)
def target(request: pytest.FixtureRequest) -> Iterator[Remote]:
    require_module("wgpu")
    with Remote(request.param) as remote:
        yield remote


def check(cases: Mapping[str, Case], target: Remote) -> None:
    results = evaluated(cases, target)
    faults = {name: case.fault(results[name]) for name, case in cases.items()}
    if message := [f"{name}: {fault}" for name, fault in faults.items() if fault]:
        pytest.fail("\n".join(message), pytrace=False)


@pytest.mark.vulkan
def test_functions_agree_with_float64(target):
    groups = (cases_of(group) for group in groups_of(target.name))
    check({name: case for cases in groups for name, case in cases.items()}, target)


@pytest.mark.slow
@pytest.mark.vulkan
@pytest.mark.smoke
@pytest.mark.parametrize("target", TRANSLATED, indirect=True)
def test_models_agree_with_float64(target):
    by_model = {name.split()[1]: name for name in cases_of("models-by-macros")}
    check({name: cases_of("models-by-macros")[name] for name in by_model.values()}, target)
    check(cases_of("fr_cook_torrance_sample"), target)


@pytest.mark.vulkan
@pytest.mark.smoke
@pytest.mark.parametrize("target", TRANSLATED, indirect=True)
def test_translated_glsl_gives_the_same_values(target, egl: Backend):
    random = np.random.default_rng(2)
    inputs = {"c": random.random(500, np.float32), "n": random.random((500, 3), np.float32) - 0.5}
    calls = [f"walked(c, n, {count})" for count in (0, 1, 4, 9)]
    evaluator = Evaluator(create_context(egl).gl)
    for text, some in ((PLAIN, calls), (RARE, RARE_CALLS)):
        expected = evaluator.each(f"#define HALF_OF_IT 0\n{text}", some, inputs)
        result = target.each(text, some, inputs)
        np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-6)
    evaluator.release()


@pytest.mark.compiler
@pytest.mark.vulkan
@pytest.mark.parametrize("language", MAIN)
def test_every_file_and_choice_compiles_without_a_warning(language):
    require_module("wgpu")
    from tests.verification.webgpu import Device

    device = Device()
    for name, lobe, m in TEXTS:
        text = f"{fr.shader_source(name, language, lobe=lobe, m=m)}\n{MAIN[language]}\n"
        device.compile(compiled(text, hlsl=True) if language == "hlsl" else text)


def metal_drawn(texts: list[str], scenes: list[str]) -> list[np.ndarray]:
    try:
        return metal.drawn(texts, [glsl.translated(scene, "msl") for scene in scenes], SIZE)
    except FileNotFoundError:
        missing("no g++")


@pytest.mark.compiler
def test_every_file_and_choice_compiles_as_metal():
    metal_drawn([fr.shader_source(name, "msl", lobe=lobe, m=m) for name, lobe, m in TEXTS], [])


@pytest.mark.slow
@pytest.mark.compiler
@pytest.mark.smoke
def test_metal_draws_the_same_as_opengl(egl):
    scenes = [f"{macros}{SCENE}" for macros in SCENES.values()]
    images = metal_drawn([], scenes)
    for image, expected in zip(images, desktop(scenes)[1], strict=True):
        assert np.abs(image - expected).max() < 1e-6 * expected.max()


@pytest.mark.parametrize("language", glsl.LANGUAGES)
def test_translations_are_readable(language):
    """A translation keeps headers, comments and functions, and contains no GLSL syntax."""
    source, text = fr.shader_source("cook_torrance"), fr.shader_source("cook_torrance", language)
    header, _ = (fr.shader_dir() / "facerender/cook_torrance.glsl").read_text().split("\n#", 1)
    assert header in text
    assert "// Not normalised: V.H = |h|/2." in text
    for name in re.findall(r"^float (fr_cook\w+|fr_lobe_exact)\(", source, re.MULTILINE):
        assert re.search(rf"^(float|fn) {name}\(", text, re.MULTILINE)
    code = re.sub(r"//.*", "", text)
    assert not re.search(r"#(if|define)|\b(vec[234]\(|mix|inversesqrt|highp)\b", code)
    assert ("select(" in code) == (language == "wgsl")
    longest, own = (max(map(len, each.split("\n"))) for each in (code, source))
    assert longest <= own + 20


@pytest.mark.parametrize("language", glsl.LANGUAGES)
def test_translation_keeps_the_choices_of_a_users_file(language, tmp_path):
    own = tmp_path / "own.glsl"
    own.write_text(
        "#define FR_LOBE FR_LOBE_D8\n#define FR_MASKING FR_MASKING_NONE\n"
        '#include "facerender/cook_torrance.glsl"\n'
        "float mine(vec3 n) { return fr_cook_torrance(n, n, n, 0.3, 0.028); }\n"
    )
    text = fr.shader_source(str(own), language)
    assert "fr_lobe_exact" not in text
    assert "f0, FR_LOBE_D8, FR_FRESNEL_SCHLICK, FR_MASKING_NONE)" in text
    assert "mine(" in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("uniform float x;\n", "'uniform'; only functions and constants"),
        ("float f(sampler2D map) { return 0.0; }\n", "'sampler2D'; only functions and constants"),
        ("float f(float x) { return y; }\n", "'y' is not declared"),
        ("float f(float x) { return noise1(x); }\n", "noise1(), which is neither declared"),
        ("float f(float x) { return x }\n", "; is missing before '}'"),
        ("float f(float x[3]) { return x[0]; }\n", "an array"),
        ("float f() { return float[2](1.0, 2.0)[0]; }\n", "an array"),
        ("float f(float x) { return x[0]; }\n", "'[' of a float"),
        ("float f(vec3 x) { return float(x.length()); }\n", "'length' of a vec3"),
        ("float f(float x) { float a = x = 1.0; return a; }\n", "'=' within an expression"),
        ("float f(vec3 x) { int i = 0; return x[i++]; }\n", "'++' within an expression"),
        (f"{SETS}float f(vec3 x) {{ set(x.y); return x.y; }}\n", "an output argument of set: give"),
        (f"{SETS}float f(bool b, float x) {{ b = b && set(x); return x; }}\n", "use if"),
        ("float f(float x) { return x; }\nfloat f(vec3 x) { return x.x; }\n", "an overload of"),
        ("float f(vec3 x) { for (int i = 0; i < 9; x.xy++) ++i; return x.x; }\n", "use its body"),
        ("float f(float x) { do x += 1.0; while (x < 0.0); return x; }\n", "'do'; only if, for"),
        ("float f(float x) { if (x < 0.0) discard; return x; }\n", "'discard'; only if, for"),
        ("float f(float x) { return (x", "the text ends too early"),
        ("float f(float x) { return x.y; }\n", "'y' of a float"),
        ("#extension GL_X : require\n", "not translated: #extension GL_X"),
        ("#if (X)\n#endif\n", "cannot evaluate #if (X)"),
        ("float f() { return 1.0; @ }\n", "not translated: '@"),
        ("float f(float x) { return (x, 2.0); }\n", "function f: the comma operator"),
        ("float f(float) { return 2.0; }\n", "function f: a parameter without a name"),
        ("float f(float x) { for (;;) x += 1.0; return x; }\n", "for without a declaration"),
        ("float f(float x) { ; return x; }\n", "function f: an empty statement"),
        ("float f(float x) { for (int i = 0, j = 1; i < 2; i++) x += 1.0; return x; }\n",
         "several variables in the head of for"),
    ],
)  # fmt: skip
def test_untranslatable_glsl_is_refused(text, message, tmp_path):
    own = tmp_path / "own.glsl"
    own.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        fr.shader_source(str(own), "wgsl")
    assert str(caught.value).startswith(f"{own} in WGSL: ") or "#if" in text
    assert "\n" not in str(caught.value)


CONSTRUCTS = [  # not in any language, not in HLSL, not in WGSL
    ("", "mat2(float)", "mat2 f(float s) { return mat2(s); }"),
    ("", "mat4(mat3)", "mat4 f(mat3 a) { return mat4(a); }"),
    ("", "mat2(vec4)", "mat2 f(vec4 a) { return mat2(a); }"),
    ("", "mat2 != mat2", "bool f(mat2 a, mat2 b) { return a != b; }"),
    ("", "mix(vec2, vec2, bvec2)", "vec2 f(vec2 a, bvec2 b) { return mix(a, a.yx, b); }"),
    ("", "vec2(vec3)", "vec2 f(vec3 a) { return vec2(a); }"),
    ("hlsl", "mat2 *= mat2", "mat2 f(mat2 a, mat2 b) { a *= b; return a; }"),
    ("wgsl", "vec2(int)", "vec2 f(int a) { return vec2(a); }"),
    ("wgsl", "vec4(ivec2, float, int)", "vec4 f(ivec2 a) { return vec4(a, 1.0, a.x); }"),
    ("wgsl", "mat2(int, int, int, int)", "mat2 f(int a) { return mat2(a, 0, 0, a); }"),
    ("wgsl", "vec2 * int", "vec2 f(vec2 a, int b) { return a * b; }"),
    ("wgsl", "float += uint", "float f(float a, uint b) { a += b; return a; }"),
    ("wgsl", "float b = int", "float f(int a) { float b = a; return b; }"),
    ("wgsl", "bool ? int ? float", "float f(bool a, int b) { return a ? b : 1.0; }"),
    ("wgsl", "pow(float, int)", "float f(float a, int b) { return pow(a, b); }"),
    ("wgsl", "g(int)", "float g(float a) { return a; }\nfloat f(int a) { return g(a); }"),
    ("wgsl", "mat2 / float", "mat2 f(mat2 a) { return a / 2.0; }"),
    ("wgsl", "- mat2", "mat2 f(mat2 a) { return -a; }"),
    ("wgsl", "+ float", "float f(float a) { return +a; }"),
    ("wgsl", "ivec2 += float", "ivec2 f(ivec2 a) { a++; return a; }"),
    ("wgsl", "bool ? mat2 ? mat2", "mat2 f(bool a, mat2 b) { return a ? b : b; }"),
]


@pytest.mark.parametrize(("lacking", "construct", "text"), CONSTRUCTS)
def test_constructs_that_a_language_lacks_are_refused(lacking, construct, text):
    for language in glsl.LANGUAGES:
        if lacking in ("", language):
            with pytest.raises(InputError, match=f"function f: {re.escape(construct)}$"):
                glsl.translated(text, language)
        else:
            assert " f(" in glsl.translated(text, language)


@pytest.mark.slow
@pytest.mark.parametrize("name", UNTRANSLATED)
def test_files_with_samplers_are_for_glsl(name):
    """The message names file and function, and quotes no source text."""
    for language in glsl.LANGUAGES:
        with pytest.raises(InputError, match=r"not translated: function fr_\w+: ") as caught:
            fr.shader_source(name, language)
        message = str(caught.value)
        assert message.startswith(f"facerender/{name}.glsl in {language.upper()}: ")
        assert re.search(r": ('sampler2D'|an array); only [a-z, ]+ are supported; write ", message)
