"""Tests the translations of GLSL to HLSL, Metal and WGSL: names, compilation and values."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

import facerender as fr
from facerender import InputError
from facerender.commands.shaders import functions
from tests.conftest import missing, require_module
from tests.verification import metal
from tests.verification.cases import CHOICES, GROUPS, Case, cases_of, evaluated
from tests.verification.hosts import CHOICES as SCENES
from tests.verification.hosts import SCENE, SIZE, desktop, flat
from tests.verification.targets import LAVAPIPE, TRANSLATED, Remote, compiled

ROOT = Path(__file__).parents[1]
# Every file without choices, and every fourth with choices.
TEXTS = [text for i, text in enumerate(CHOICES) if text[1:] == (None, None) or i % 4 == 0]
HLSL_MAIN = "\nfloat4 main() : SV_Target { return 0; }\n"
# GLSL that the library does not use, or that a language does not have.
PLAIN = """
#define TWICE(x) (2.0 * (x))
const float UNIT = 1.0, WEIGHTS[3] = float[](0.5, 0.25, 0.125);
bool both(float x, out float sum, inout vec2 kept) {
    sum = x + kept.x;
    kept *= 2.0;
    return true;
}
float walked(float c, vec3 n, int count) {
    float total = 0.5, other;
    float one = 1, line = total;  // a whole number, and a word of HLSL
    total *= one + (line - n.s) - (line - n.r);
    for (int i = 0; i < count; ++i) {
        if (i == 2) continue;
        else if (i > 5) break;
        total += float(i) * c + WEIGHTS[i % 3];
        n.xy = n.yx * -1.0;
        n.z += i % 2 == 0 ? 0.25 : TWICE(TWICE(0.25)) - 0.125;
    }
    vec2 kept = vec2(c, 1.0);
    bool never = c < 0.0 && both(c, n.y, kept), ever = c >= 0.0 && both(c, other, kept);
    const mat2 turn = mat2(0.6, 0.8, -0.8, 0.6);
    vec2 turned = turn * kept + n.xy * turn;
    bool same = kept == vec2(2.0 * c, 2.0);
    kept.x++, --kept.xy;
    n.xy += kept;
    c = atan(turned.y, turned.x) + dot(max(n, 0.0), clamp(n, 0.0, 1.0));
    return mix(total + other, c, same ? 0.25 : 1.0) + mix(n, vec3(UNIT), 0.5).b + length(turned);
}
vec3 constructed(float c, vec3 n) {
    mat3 two = mat3(2.0), three = mat3(mat4(3.0));
    two *= two == three ? two : mat3(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0);
    vec3 whole = vec3(int(4.0 * c), 010U + 0XFu, 2) / 255.0f;
    vec3 mixed = mix(n, whole, bvec3(true, c > 0.5, n.x > 0.0));
    return inverse(two + mat3(30.0)) * n + three * whole + mixed;
}
"""
UNUSED = "float unused(float a, precise out float b, inout float c[3]) { a = 2.0; return a; }\n"
SAMPLED = "float sampled(sampler2D map, vec2 at) { return texture(map, at).x; }\n"
LOBE = '#include "facerender/lobe.glsl"\n'
SHADOW = f'#ifdef X\n{LOBE}#endif\n{LOBE}#include "facerender/shadow.glsl"\n'
CALLS = [f"walked(c, n, {i})" for i in (0, 1, 4, 9)] + [f"constructed(c, n)[{i}]" for i in range(3)]


@pytest.fixture(scope="module", autouse=True)
def translators() -> None:
    try:
        flat("float f(float x) { return x; }", "wgsl")
        metal.drawn([], [], SIZE)
    except (InputError, FileNotFoundError) as error:
        missing(str(error))


@pytest.fixture(scope="module", params=LAVAPIPE)
def target(request: pytest.FixtureRequest) -> Iterator[Remote]:
    require_module("wgpu")
    with Remote(request.param) as remote:
        yield remote


def check(cases: Mapping[str, Case], target: Remote) -> None:
    results = evaluated(cases, target)
    faults = {name: case.fault(results[name]) for name, case in cases.items()}
    assert {name: fault for name, fault in faults.items() if fault} == {}


@pytest.mark.vulkan
def test_functions_agree_with_float64(target):
    check({name: case for group in GROUPS for name, case in cases_of(group).items()}, target)


@pytest.mark.slow
@pytest.mark.vulkan
@pytest.mark.smoke
@pytest.mark.parametrize("target", TRANSLATED, indirect=True)
def test_models_and_shadows_agree_with_float64(target):
    by_model = {name.split()[1]: name for name in cases_of("models-by-macros")}
    check({name: cases_of("models-by-macros")[name] for name in by_model.values()}, target)
    check(cases_of("fr_shadow_disc"), target)


@pytest.mark.vulkan
@pytest.mark.smoke
@pytest.mark.parametrize("target", TRANSLATED, indirect=True)
def test_translated_glsl_gives_the_same_values(target, evaluator):
    random = np.random.default_rng(2)
    inputs = {"c": random.random(500, np.float32), "n": random.random((500, 3), np.float32) - 0.5}
    expected = evaluator.each(PLAIN, CALLS, inputs)
    np.testing.assert_allclose(target.each(PLAIN, CALLS, inputs), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.compiler
@pytest.mark.vulkan
@pytest.mark.parametrize("language", ["hlsl", "metal", "wgsl"])
def test_every_file_and_choice_compiles_without_a_warning(language):
    """Each translation has the functions of the file."""
    require_module("wgpu")
    from tests.verification.webgpu import Device

    texts = [fr.shader_source(name, language, lobe=lobe, m=m) for name, lobe, m in TEXTS]
    for (file, *_), text in zip(TEXTS, texts, strict=True):
        names = [x.name for x in functions() if x.file == f"facerender/{file}.glsl"]
        assert {*names} <= {*re.findall(r"^(?:fn|\w+) (\w+)\(", text, re.MULTILINE)}
    texts.append((ROOT / f"docs/languages/specular.{language}").read_text(encoding="utf-8"))
    if language == "metal":
        metal.drawn(texts, [], SIZE)
        return
    device = Device()
    for text in texts:
        device.compile(compiled(text + HLSL_MAIN, hlsl=True) if language == "hlsl" else text)


@pytest.mark.slow
@pytest.mark.compiler
@pytest.mark.smoke
def test_metal_draws_the_same_as_opengl(egl):
    scenes = [f"{macros}{SCENE}" for macros in SCENES.values()]
    images = metal.drawn([], [flat(scene, "metal") for scene in scenes], SIZE)
    for image, expected in zip(images, desktop(scenes)[1], strict=True):
        assert np.abs(image - expected).max() < 1e-6 * expected.max()


HEADS = {  # of functions in each language
    "hlsl": """float fr_lobe(float c, float m, int k)
bool both(float x, out float sum, inout float2 kept)
float walked(float c, float3 n, int count)
float unused(float a, out float b, inout float c[3])
float fr_shadow_depth(Texture2D<float4> map, int3 tile, float2 texel)
float sampled(Texture2D<float4> map, SamplerState _map_sampler, float2 at)""",
    "metal": """float fr_lobe(float c, float m, int k)
bool both(float x, thread float& sum, thread float2& kept)
float walked(float c, float3 n, int count)
float unused(float a, thread float& b, thread float (&c)[3])
float fr_shadow_depth(texture2d<float> map, int3 tile, float2 texel)
float sampled(texture2d<float> map, sampler mapSmplr, float2 at)""",
    "wgsl": """fn fr_lobe(c: f32, m: f32, k: i32) -> f32 {
fn both(x: f32, sum: ptr<function, f32>, kept: ptr<function, vec2<f32>>) -> bool {
fn walked(c: f32, n: vec3<f32>, count: i32) -> f32 {
fn unused(a: f32, b: ptr<function, f32>, c: ptr<function, array<f32, 3>>) -> f32 {
fn fr_shadow_depth(map: texture_2d<f32>, tile: vec3<i32>, texel: vec2<f32>) -> f32 {""",
}


@pytest.mark.compiler
@pytest.mark.smoke
@pytest.mark.parametrize("language", HEADS)
def test_functions_keep_their_comments_and_parameters(language):
    heads = HEADS[language].split("\n")
    lobe = fr.shader_source("lobe", language, lobe="d16")
    text = lobe + flat(f"{PLAIN}{UNUSED}{SHADOW}", language)
    text += flat(SAMPLED, language) if language != "wgsl" else ""
    assert [head for head in heads if f"\n{head}\n" not in text] == []
    assert re.match("// .*facerender.*\n// .*MIT", lobe)
    assert "\n// Lobe that the macro FR_LOBE selects, for example by #define" in lobe
    assert re.findall(r" FR_LOBE_(\w+)(?:: i32 =)? \d+", lobe) == ["D16", "OWN", "EVERY"]
    assert fr.shader_source("ward", "msl") == fr.shader_source("ward", "metal")


@pytest.mark.compiler
@pytest.mark.parametrize(("language", "text", "message"), [
    ("hlsl", "uniform vec2 q;", "'non-opaque uniforms outside a block' : not allowed"),
    ("metal", "layout(location = 0) in float q;", "the variable q would have no value: pass"),
    ("wgsl", "float k = 1.0;\nfloat f(float x) { return k += x; }", "the variable k would have"),
    ("hlsl", "float f() { return gl_FragCoord.x; }", "the variable gl_FragCoord would have no"),
    ("wgsl", "\nfloat f() { return y; }", "'y' : undeclared identifier in 'float f() { return y"),
    ("wgsl", "void f(int i) {} void f(bool b) {}", "the name f is reserved or has an overload: c"),
    ("hlsl", "float lerp(float a, float b) { return mix(a, b, 0.5); }", "the name lerp is res"),
    ("hlsl", "float half2(float x) { return x; }", "';' : Expected in 'float half2(float x)'"),
    ("metal", "float float2(float x) { return x; }", "the name float2 is reserved"),
    ("wgsl", "float final(float x) { return x; }", "the name final is reserved"),
    ("metal", "float f(float x[2]) { return x[0]++; }", "f changes its array thread float (&x)[2]"),
    ("hlsl", "float[2] f(float x) { return float[2](x, x); }", "f would have other parameters"),
    ("metal", "float f(double x) { return float(x); }", "double is not available: use float"),
    ("wgsl", "float f(sampler2D a) { return texture(a, vec2(0.0)).x; }", "use texelFetch"),
    ("wgsl", "float f(float x) { return x / uintBitsToFloat(0x7F800000u); }", "no constant for"),
    ("hlsl", "uint f(uint a, out uint b) { return uaddCarry(a, 1, b); }", "'uaddCarry' : no match"),
])  # fmt: skip
def test_untranslatable_glsl_is_refused(language, text, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        flat(text, language)
    assert re.search(f"scene.glsl in {language}: ", str(caught.value), re.IGNORECASE)


def test_missing_translators_are_named(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match=r"needs .*: apt-get install glslang-tools spirv-cross$"):
        fr.shader_source("ward", "metal")
