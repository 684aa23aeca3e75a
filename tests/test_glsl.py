"""Tests the text of the shader library: includes, flat files on every target, and headers."""

from __future__ import annotations

import re
from pathlib import Path

import moderngl
import numpy as np
import pytest

import facerender as fr
from facerender import InputError, lobes
from facerender.commands.shaders import functions
from facerender.glsl.library import term_source
from facerender.lobes import GPower
from tests.conftest import run
from tests.verification.cases import ALL_LOBES, CHOICES, directions

SHADINGS = (
    fr.Shading(),
    fr.Shading(small_slope=False, fresnel="constant", masking="kelemen"),
    fr.Shading(lobe=GPower(5, 0.5, 0.8), fresnel="dielectric", masking="none"),
    fr.Shading(lobe=GPower(8, 1, np.float64(0.5)), m=0.3),
    fr.Shading("ward", "d16", m=0.9),
    fr.Shading("ward-printed", GPower(31, 0.08)),
    *(fr.Shading(model, lobe, m=m) for model in ("cook-torrance", "ward", "ward-printed")
      for lobe, m in (*((lobe, 0.3) for lobe in ALL_LOBES), ("exact", 0.15))),
)  # fmt: skip
# Stages that one run of the compiler may link, and what they must declare.
STAGES = {"vert": "", "comp": "", "tesc": "layout(vertices = 3) out;", "tese": "layout(quads) in;"}
X = {"x": np.float32([0.5])}
WARD = '#include "facerender/ward.glsl"'
BOTH = f'{WARD}\n#include "facerender/cook_torrance.glsl"\n'
CODE = "#if {}; yes; #else; no; #endif"
FITTED = f"#define FR_LOBE FR_LOBE_FITTED\n{BOTH}"


def flat(folder: Path, text: str, *target: str, **choices: object) -> str:
    """Return the flat text of a file a.glsl."""
    (folder / "a.glsl").write_text(text, encoding="utf-8", newline="")
    return fr.shader_source(str(folder / "a.glsl"), *target, **choices)


@pytest.mark.slow
@pytest.mark.compiler
@pytest.mark.parametrize("target", [
    pytest.param("es300", marks=pytest.mark.smoke), "330", "vulkan"])  # fmt: skip
def test_flat_texts_compile_without_a_warning(target, tmp_path):
    texts = [fr.shader_source(name, target, lobe=lobe, m=m) for name, lobe, m in CHOICES]
    texts += [term_source(shading.term, 0.1, target) for shading in SHADINGS]
    stages = STAGES if target == "vulkan" else {"frag": ""}
    paths = [tmp_path / f"{i}.{[*stages][i % len(stages)]}" for i in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(f"{text}\n{stages[path.suffix[1:]]}\nvoid main() {{}}\n", encoding="ascii")
    options = ["-V", "--keep-uncalled", "--spirv-val"] if target == "vulkan" else []
    step = len(stages) if options else len(paths)
    for first in range(0, len(paths), step):
        run(["glslangValidator", *options, *paths[first : first + step]], tmp_path)


@pytest.mark.parametrize(("name", "lobe", "m"), CHOICES)
def test_flat_texts_have_each_file_once_and_one_lobe(name, lobe, m):
    text = fr.shader_source(name, lobe=lobe, m=m)
    assert re.match(r"// facerender/.* facerender \d+\.\d+.*\n.* MIT", text)
    guards = re.findall(r"^#define (FR_\w+_GLSL)$", text, re.MULTILINE)
    assert len(guards) == len({*guards}) > 0
    names = re.findall(r"^(?:#define|(?!precision)\w[\w ]*) (\w+)", text, re.MULTILINE)
    assert {name[:3] for name in names} <= {"FR_", "fr_"}, "names of the user stay free"
    assert ("#define FR_SMALL_SLOPE 0\n" in text) == (lobe == "exact" and m == 0.2)
    assert ("#define FR_SLOPE(m) (m)\n" in text) == (m is None)
    if lobe:
        assert ("exp2" in text) == (lobe in ("exact", "cosine"))
        assert "FR_LOBE ==" not in text
        assert ("#ifndef FR_STEEPNESS" in text) != isinstance(lobe, GPower)


@pytest.mark.parametrize("shading", SHADINGS, ids=str)
def test_flat_texts_compute_a_shading(evaluator, shading):
    """A constant slope replaces that of the caller."""
    term = shading.term
    inputs = directions(np.full(5000, term.m or 0.25, np.float32), lowest=0.02)
    expected = term.brdf(*(inputs[axis].astype(float) for axis in "nlv"), inputs["m"], 0.028)
    name, slope = term.model.replace("-", "_"), "m" if term.m is None else "1.7"
    call = f"fr_{name}(n, l, v, {slope}{', 0.028)' if name == 'cook_torrance' else ') * 0.028'}"
    texts = [term_source(term, 0.2)]
    if shading == fr.Shading(term.model, term.lobe, m=term.m) and term.m:
        texts.append(fr.shader_source(name, lobe=term.lobe, m=term.m))
    for text in texts:
        atol = 1e-5 / inputs["m"][0] ** 2
        np.testing.assert_allclose(evaluator(text, call, inputs), expected, rtol=1e-3, atol=atol)


def test_lobe_files_have_constants_for_both_models(evaluator):
    c = np.float32(np.linspace(0.5, 1.0, 200))
    for call, lobe in {"fitted(c, 1.7, {})": "fitted", "fitted_fine(c, 1.7, {})": "fitted-fine",
                       "cosine(c, 1.7, {})": "cosine", "exact(c, 1.7, {})": "exact",
                       "g_power(c, 1.7, {}, 16)": "d16"}.items():  # fmt: skip
        text = fr.shader_source("lobe/" + re.match("fitted|[a-z_]+", call)[0], m=0.3)
        for k in (4, 0):
            result = evaluator(text, f"fr_lobe_{call.format(k)}", {"c": c})
            np.testing.assert_allclose(result, lobes.lobe(lobe, c, 0.3, k), atol=1e-5)


def test_shaders_of_users_are_flattened_with_their_lobe(tmp_path):
    (tmp_path / "link.glsl").symlink_to(fr.shader_dir() / "facerender/ward.glsl")
    lines = ["\ufeff#version 330 core", FITTED, ' #  include "link.glsl"  // and comments', ""]
    text = flat(tmp_path, "\r\n".join(lines), m=0.3)
    assert text.startswith("#version 330 core\n// a.glsl with")
    assert text.count("#version") == text.count("float fr_ward(") == 1
    assert not any(absent in text for absent in ("\ufeff", "\r", "fr_lobe_exact"))
    assert re.findall(r"FR_FITTED_COEFFICIENTS\(m, k\) (\(.{15})", text) == ["((k) == 4 ? vec3"]
    text = flat(tmp_path, f"#ifndef FR_LOBE\n#define FR_LOBE FR_LOBE_D16\n#endif\n{BOTH}")
    assert "float fr_lobe_exact(" in text, "the host may still choose"


@pytest.mark.parametrize(("text", "expected"), [  # lines where A is 2, and their flat text
    *((CODE.format(condition), "yes") for condition in (
        "B == 2 && defined(A)", "A < 3", "HOST || 1 == 1", "2 <= 2 && 2 >= 2", "(3)")),
    *((CODE.format(condition), "no") for condition in (
        "B > 2 || !defined(A)", "2 >= 3 || 3 <= 2 || 2 > 2 || 2 < 2 || 0", "A != 2 || HOST && 0")),
    *((CODE.format(condition), CODE.format(condition)) for condition in (
        "HOST", "(HOST)", "HOST || 0", "OCTAL == 10", "A == 2 && !(0)", "HOST && A == 2",
        "defined A && !defined ( ABSENT )", "!(defined(HOST) || defined(A))")),
    ("#if A > 2; no; #elif X; 1; #elif A; 2; #else; no; #endif", "#if X; 1; #else; 2; #endif"),
    ("#if 0; #if X; no; #else; #undef A; no; #endif; no; #endif; #ifdef A; 1; #endif", "1"),
    *[("/* 1; #include <no> */; // #include <no>; /* not closed; #include <no>",) * 2],
    ("#define F(x) x; #ifndef F; no; #elif 1; 1; #endif", "#define F(x) x; 1"),
    *[("#if X; #define C 3; #undef A; #undef D; #endif; #if C; 1; #elif A; 2; #endif",) * 2],
])  # fmt: skip
def test_known_macros_decide_conditions(text, expected, tmp_path):
    start = "#define A 2\n#define B A\n#define OCTAL 010\n"
    code = start + text.replace("; ", "\n")
    lines = flat(tmp_path, code).partition(start)[2].split("\n")
    assert "; ".join(filter(None, lines)) == expected
    assert fr.resolve_includes(code) == code, "conditions are the compiler's"


@pytest.mark.parametrize(("text", "count"), [  # lines, and how often they contain WARD afterwards
    ("#if X; WARD; WARD; #endif", 1),
    ("WARD; WARD; #if X; WARD; #endif", 1),
    ("#if X; WARD; #else; WARD; #endif", 2),
    ("#if X == 1; WARD; #endif; WARD", 2),
    ("#if 1; WARD; #endif; WARD", 2),
    ("#if (0); #ifdef X; ABSENT; #else; WARD; #endif; #endif", 0),
    ("#if 0; #elif 0; WARD; #else; #if 1; #elif X; ABSENT; #else; WARD; #endif; #endif", 0),
    ("#if X; #elif 2; #else; ABSENT; WARD; #endif", 0),
    ("#define A 1 // /* \\; #include <no>; WARD /* two; lines */", 1),
    ("#if 1 /* two; lines */; WARD /* two; lines */; #endif", 1),
])  # fmt: skip
def test_files_are_inserted_once_per_branch(evaluator, text, count, tmp_path):
    """Texts compile whatever the host defines. NVIDIA rejects #line at the end of a text."""
    lines = text.replace("WARD", WARD).replace("ABSENT", '#include "absent.glsl"').split("; ")
    texts = [fr.resolve_includes("\n".join([*lines, *end])) for end in ([], [""], ["", ""])]
    for resolved in texts:
        assert resolved.count("float fr_ward(") == count
        assert not resolved.rstrip().split("\n")[-1].startswith("#line")
    texts += [flat(tmp_path, "\n".join(lines)) * 2, flat(tmp_path, "\n".join(lines), "330")]
    for code in [define + code for code in texts for define in ("", "#define X 1\n")]:
        assert evaluator(code.replace("#version 330 core", ""), "x", X) == 0.5


def test_missing_file_within_a_condition_is_left_to_the_compiler(evaluator, tmp_path):
    for line in ('#include "absent.glsl"', "#include <other/absent.glsl>", "#include FILE"):
        for condition in ("#ifdef HOST", "#if HOST == 1", "#if 0\n#elif HOST"):
            text = f"{condition}\n{line}\n#endif\n"
            resolved = fr.resolve_includes(text)
            assert '"' not in resolved, "naga takes the text of an #error for GLSL"
            assert evaluator(resolved + flat(tmp_path, text), "x", X) == 0.5
            with pytest.raises(moderngl.Error, match=r"no file (\S*/)?absent|#include FILE"):
                evaluator(f"#define HOST 1\n{resolved}", "x", X)


def test_include_directories(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name / "facerender").mkdir(parents=True)
        (tmp_path / name / "facerender/ward.glsl").write_text(f"// {name}\n")
    paths = [str(tmp_path / "a"), tmp_path / "b"]
    assert "// a\n" in fr.resolve_includes(WARD, paths)
    assert "// b\n" in fr.resolve_includes(WARD, paths[::-1])
    assert "// a\n" in flat(tmp_path / "b", "#include <facerender/ward.glsl>", paths=paths)
    assert "// b\n" in flat(tmp_path / "b", WARD, paths=paths), "beside the file"
    with pytest.raises(InputError, match=r"line 2: no file c.glsl in .*/a or .*/b or .*/shaders$"):
        fr.resolve_includes('\n#include "c.glsl"', paths)


@pytest.mark.parametrize("version", ["130", "140", "150 core", "330", "300 es"])
def test_line_numbers_of_every_version(evaluator, version, tmp_path):
    """Up to GLSL 150, #line numbers the line after the next. Mesa writes 0:6(1), NVIDIA 0(6)."""
    (tmp_path / "wrong.glsl").write_text("// 1\n#ifdef X\n#endif\nwrong;\n")
    text = f'#version {version}\n\n#include "facerender/constants.glsl"\n\n'
    condition = f"#ifdef GL_core_profile\n{WARD}\n#endif\n"
    for end, file, line in (("", 0, 5), (condition, 0, 8), ('#include "wrong.glsl"\n', 2, 4)):
        resolved = fr.resolve_includes(f"{text}{end}wrong;\n", [tmp_path])
        begun = re.findall(r"\n#line [01] \d+  // facerender/half_vector.glsl\n", resolved)
        assert len(begun) == (end == condition)
        with evaluator.gl as gl, pytest.raises(moderngl.Error, match=rf"\b{file}[:(]{line}[()]"):
            gl.program(f"#version {version}\nvoid main() {{}}", resolved)


def test_names_of_the_library(tmp_path, monkeypatch):
    ward = fr.shader_source("ward")
    assert fr.shader_source("facerender/ward.glsl") == fr.shader_source("ward.glsl") == ward
    for function in functions():
        assert all((function.summary.endswith("."), function.formula, function.error))
        name = function.file.removeprefix("facerender/").removesuffix(".glsl")
        assert fr.shader_source(function.name) == fr.shader_source(name)
    monkeypatch.chdir(tmp_path)
    for name in ("ward.glsl", "plain"):
        Path(name).write_text("float mine;\n")
        assert "float mine;" in fr.shader_source(name)
    assert fr.shader_source("ward") == ward


@pytest.mark.parametrize(("message", "text", "choices"), [  # text: name, or a.glsl and b.glsl
    (r"b\.glsl:1: no file lobe\.glsl in [^ ]*shaders$", "B | #include <lobe.glsl>", {}),
    (r"b\.glsl:1: include cycle .*a\.glsl -> .*b\.glsl -> ", 'B | #include "./a.glsl"', {}),
    (r"a\.glsl:1: #include facerender: write", "#include facerender", {}),
    (r"b\.glsl:1: #else without #if", "#if X\nB\n#endif | #else", {}),
    (r"a\.glsl: #if without #endif", "#if X", {}),
    (r"a\.glsl:3: a second #version", "#version 330\n\n#version 330", {}),
    (r"62\.glsl:1: more than 64 nested includes", '#include "0.glsl"', {}),
    ("a.glsl contains #version 330 core: leave out that", "#version 330 core", {"target": "es300"}),
    ("a.glsl:1 defines FR_LOBE, which lobe or m sets", FITTED, {"lobe": "d16"}),
    ("a.glsl:1 defines FR_STEEPNESS, wh", "#define FR_STEEPNESS(m, k) 1", {"lobe": GPower(8, 1)}),
    ("m = 0.9 is outside the domain of lobe fitted for Cook", FITTED, {"m": 0.9}),
    ("unknown target '120'; known: 330, es300, vulkan", "ward", {"target": "120"}),
    (r"g-power 5 \(0.2/m\^2 - 0.8\) .*, 0.5\]", "ward", {"lobe": GPower(5, 0.2, 0.8), "m": 0.6}),
    ("m = 0.3 without a lobe", "ward", {"m": 0.3}),
    ("masking does not use a slope: leave m = 0.3 out", "masking", {"m": 0.3}),
    ("cook_torrance_two has two", "cook_torrance_two", {"lobe": "d16", "m": 0.3}),
])  # fmt: skip
def test_errors_name_file_and_line(message, text, choices, tmp_path):
    for i in range(66):
        (tmp_path / f"{i}.glsl").write_text(f'#include "{i + 1}.glsl"')
    a, _, b = re.sub(r"\bB\b", '#include "b.glsl"', text).partition(" | ")
    (tmp_path / "b.glsl").write_text(b)
    with pytest.raises(InputError, match=message):
        flat(tmp_path, a, **choices) if "#" in a else fr.shader_source(a, **choices)
