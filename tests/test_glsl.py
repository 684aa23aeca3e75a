"""Tests the text of the shader library: includes, flattened files on every target, and headers."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import moderngl
import numpy as np
import pytest

import facerender as fr
from facerender import InputError, brdf, lobes
from facerender.drawing.context import Backend, create_context
from facerender.glsl import library as glsl
from facerender.glsl.includes import Includes, Preprocessor
from facerender.glsl.library import functions
from facerender.lobes import GPower
from tests.conftest import missing
from tests.verification.cases import directions
from tests.verification.evaluate import Evaluator

WITH_A_LOBE = ("cook_torrance", "lobe", "ward", "ward_printed")
COOK_TORRANCE = {"name": "cook_torrance", "lobe": "d16"}
ARGUMENTS = {"vec3": "vec3(0.0, 0.6, 0.8)", "float": "0.5", "int": "4"}
ARGUMENTS |= {"vec2": "vec2(0.5, 0.2)", "mat2x4": "mat2x4(0.5)", "ivec3": "ivec3(0, 0, 8)"}
ARGUMENTS |= {"sampler2D": "texels", "ivec2": "ivec2(1)", "mat2x3": "mat2x3(0.5)"}
ARGUMENTS |= {
    f"{kind}[{count}]": f"{kind}[{n}]({', '.join([f'{kind}(0.5)'] * n)})"
    for kind, count, n in (
        *(("vec4", "FR_SCATTER_GAUSSIANS", 4), ("vec3", "FR_SCATTER_SAMPLES", 16)),
        ("vec3", "9", 9),
    )
}
SAMPLER = {"vulkan": "layout(binding = 0) uniform sampler2D texels;"}
OUTPUT = {"330": "", "es300": "", "vulkan": "layout(location = 0) "}
LOBES = (*lobes.NAMES, GPower(11, 0.2, 0.5))
AT_LINE = r"\b0[:(]{}[()]"  # in messages of Mesa, "0:6(1): ", and of NVIDIA, "0(6) : "
# Every file, without choices and with a lobe or a slope.
CHOICES: list[tuple[str, lobes.AnyLobe | None, float | None]] = [
    *((name, None, None) for name in glsl.library()),
    *((name, lobe, m) for name in WITH_A_LOBE for lobe in LOBES for m in (None, 0.15, 0.3)),
    *(("cook_torrance_two", lobe, None) for lobe in LOBES),
    *((f"lobe/{name}", None, 0.3) for name in ("cosine", "exact", "fitted", "g_power")),
]
SHADINGS = (
    fr.Shading(),
    fr.Shading(small_slope=False, fresnel="constant", masking="kelemen"),
    fr.Shading(lobe=GPower(5, 0.5, 0.8), fresnel="dielectric", masking="none"),
    fr.Shading(lobe=GPower(8, 1, np.float64(0.5)), m=0.3),
    fr.Shading(lobe="fitted", masking="kelemen", m=0.25),
    fr.Shading("ward", GPower(31, 0.08)),
    fr.Shading("ward-printed", m=0.15),
)


STAGES = {  # of a Vulkan program: declarations, and a statement that uses a float
    "vert": ("", "gl_Position = vec4({});"),
    "tesc": ("layout(vertices = 3) out;", "gl_out[gl_InvocationID].gl_Position = vec4({});"),
    "tese": ("layout(triangles) in;", "gl_Position = vec4({});"),
    "geom": (
        "layout(triangles) in; layout(points, max_vertices = 1) out;",
        "gl_Position = vec4({}); EmitVertex();",
    ),
    "frag": (f"{OUTPUT['vulkan']}out vec4 result;", "result = vec4({});"),
}


def calls(name: str) -> str:
    """Return an expression that calls all functions of a file, made from their signatures."""
    values = []
    for function in functions():
        parameters = re.search(r"\((.*)\)", function.signature)[1].split(", ")
        call = f"{function.name}({', '.join(ARGUMENTS[word.split()[0]] for word in parameters)})"
        if function.file == f"facerender/{name}.glsl":
            kind = function.signature.split()[0]
            other = f"{call}[0][0]" if kind.startswith("mat") else f"dot({call}, {call})"
            values.append(call if kind == "float" else other)
    return " + ".join(values) or "0.0"


@pytest.mark.slow
@pytest.mark.compiler
@pytest.mark.parametrize(
    "target",
    [pytest.param(each, marks=[pytest.mark.smoke] * (each == "es300")) for each in glsl.TARGETS],
)
def test_every_flattened_file_compiles_without_a_warning(target, tmp_path):
    compile_all(
        target,
        tmp_path,
        [(name, fr.shader_source(name, target, lobe=lobe, m=m)) for name, lobe, m in CHOICES],
    )


@pytest.mark.first_case
@pytest.mark.compiler
@pytest.mark.smoke
@pytest.mark.parametrize("target", glsl.TARGETS)
def test_every_shading_compiles_without_a_warning(target, tmp_path):
    compile_all(
        target,
        tmp_path,
        [(shading.term.entry.file, glsl.term_source(shading.term, m, target))
         for shading in SHADINGS for m in (0.1, 0.25)],
    )  # fmt: skip


def compile_all(target: glsl.Target, folder: Path, files: Sequence[tuple[str, str]]) -> None:
    """Compile files, given as (name, text), without errors or warnings.

    A Vulkan program has a file in each of its stages, because starting the compiler takes longest.
    """
    stages = STAGES if target == "vulkan" else {"frag": ("out vec4 result;", STAGES["frag"][1])}
    paths = []
    for number, (name, text) in enumerate(files):
        stage = [*stages][number % len(stages)]
        declared, main = stages[stage]
        declared += SAMPLER.get(target, "uniform highp sampler2D texels;")
        paths.append(folder / f"{number // len(stages)}.{stage}")
        body = main.format(calls(name))
        paths[-1].write_text(f"{text}\n{declared}\nvoid main() {{ {body} }}\n", encoding="ascii")
    if target != "vulkan":
        run(["glslangValidator", *paths])
        return
    for first in range(0, len(paths), len(stages)):
        program = paths[first : first + len(stages)]
        run(["glslangValidator", "-V", *program], folder)
        for path in program:
            run(["spirv-val", f"{path.suffix[1:]}.spv"], folder)


def run(command: Sequence[str | Path], folder: Path | None = None) -> None:
    if shutil.which(command[0]) is None:
        missing(f"{command[0]} is not installed")
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    output = done.stdout + done.stderr
    assert done.returncode == 0, output
    assert "WARNING" not in output.upper(), output


@pytest.mark.compiler
def test_compiler_warnings_fail(tmp_path):
    path = tmp_path / "x.frag"
    path.write_text(
        "#version 300 es\nprecision highp float;\nout float x;\nfloat f__x = 1.0;\nvoid main() {}\n"
    )
    with pytest.raises(AssertionError):
        run(["glslangValidator", path])


@pytest.mark.parametrize(("name", "lobe", "m"), CHOICES)
def test_flattened_files_hold_each_file_once(name, lobe, m):
    text = fr.shader_source(name, lobe=lobe, m=m)
    assert "#include" not in text
    guards = re.findall(r"^#define (FR_\w+_GLSL)$", text, re.MULTILINE)
    assert len(guards) == len(set(guards)) > 0
    lines = text.split("\n")
    assert re.match(r"// facerender/.* facerender \d+\.\d+", lines[0])
    assert "MIT" in lines[1]
    if lobe:
        assert ("exp2" in text) == (lobe in ("exact", "cosine"))
        assert "FR_LOBE ==" not in text
        if not isinstance(lobe, GPower):
            assert "FR_LOBE FR_LOBE_G_POWER" not in text
        assert ("#ifndef FR_STEEPNESS" in text) != isinstance(lobe, GPower)
    macros = dict(re.findall(r"^#define (FR_[A-Z_]+)(?:\(m.*?\))? (.+)$", text, re.MULTILINE))
    assert (macros["FR_SLOPE"] == "(m)") == (m is None)


@pytest.mark.parametrize("file", [*glsl.library(), "../printed/ward", "../printed/cook_torrance"])
def test_files_suit_every_hosts_preprocessor(file):
    """The preprocessors of naga and Babylon.js each lack some features of GLSL's.
    test_hosts.py and test_web.py run them."""
    path = fr.shader_dir() / f"facerender/{file}.glsl"
    for line in path.read_text(encoding="utf-8").split("\n"):
        if line.startswith("#include") and ".." not in file:
            assert (path.parent / line.split('"')[1]).is_file(), "beside the file"
        elif line.startswith("#error"):
            assert not {*line} & {*"'\""}, "characters that naga takes for GLSL's"
        elif line.startswith(("#if ", "#elif ")):
            term = r"FR_\w+ (==|!=) \w+|!?defined\(FR_\w+\)"
            assert re.fullmatch(rf"#\w+ ({term})( (\|\||&&) ({term}))*", line), line
            assert "!=" not in line or ".." in file, "Babylon.js has no such operator"
        else:
            assert not re.search(r".#(if|el|endif)", line), "Babylon.js reads comments as well"


def test_file_that_is_included_twice_keeps_its_guard(tmp_path):
    own = tmp_path / "own.frag"
    ward = '#include "facerender/ward.glsl"\n'
    own.write_text(f"#if X == 1\n{ward}#endif\n{ward}")
    assert fr.shader_source(str(own), "330").count("#ifndef FR_WARD_GLSL") == 2


@pytest.fixture(scope="module")
def evaluate(egl: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(egl).gl)
    yield evaluator
    evaluator.release()


@pytest.mark.parametrize(("lobe", "m"), [*((lobe, 0.3) for lobe in LOBES), ("exact", 0.15)])
def test_constant_slope_replaces_that_of_the_caller(evaluate, lobe, m):
    inputs = directions(np.full(5000, m, np.float32), lowest=0.02)
    vectors = [inputs[axis].astype(float) for axis in "nlv"]
    for name, call, expected in (
        ("cook_torrance", "fr_cook_torrance(n, l, v, 1.7, 0.028)",
         brdf.cook_torrance(*vectors, m, 0.028, lobe=lobe)),
        ("ward", "fr_ward(n, l, v, 1.7)", brdf.ward(*vectors, m, lobe=lobe)),
    ):  # fmt: skip
        result = evaluate(fr.shader_source(name, lobe=lobe, m=m), call, inputs)
        np.testing.assert_allclose(result, expected, rtol=1e-3, atol=2e-5 / m**2)


@pytest.mark.parametrize("shading", SHADINGS, ids=str)
def test_source_of_a_shading_is_its_brdf(evaluate, shading):
    m = shading.term.m or 0.25
    inputs = directions(np.full(5000, m, np.float32), lowest=0.02)
    vectors = [inputs[axis].astype(float) for axis in "nlv"]
    name = shading.term.model.replace("-", "_")
    slope = "m" if shading.term.m is None else "1.7"
    call = f"fr_{name}(n, l, v, {slope}{', 0.028)' if name == 'cook_torrance' else ') * 0.028'}"
    result = evaluate(glsl.term_source(shading.term, 0.2), call, inputs)
    expected = shading.term.brdf(*vectors, inputs["m"], 0.028)
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-5 / m**2)


@pytest.mark.parametrize("k", [4, 0])
def test_a_lobe_alone_has_constants_for_both_models(evaluate, k):
    c = np.float32(np.linspace(0.5, 1.0, 200))
    for file, function, lobe in (
        ("fitted", f"fr_lobe_fitted(c, 1.7, {k})", "fitted"),
        ("fitted", f"fr_lobe_fitted_fine(c, 1.7, {k})", "fitted-fine"),
        ("g_power", f"fr_lobe_g_power(c, 1.7, {k}, 16)", "d16"),
        ("cosine", f"fr_lobe_cosine(c, 1.7, {k})", "cosine"),
        ("exact", f"fr_lobe_exact(c, 1.7, {k})", "exact"),
    ):
        result = evaluate(fr.shader_source(f"lobe/{file}", m=0.3), function, {"c": c})
        np.testing.assert_allclose(result, lobes.lobe(lobe, c, 0.3, k), atol=1e-5)


def test_shaders_of_users_are_flattened(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts/light.glsl").write_text('#include "color.glsl"\nvec3 light;\n')
    (tmp_path / "parts/color.glsl").write_text("#include <facerender/ward.glsl>\nvec3 color;\n")
    own = tmp_path / "own.frag"
    own.write_text(
        "#version 330 core\n"
        '// #include "nothing.glsl"\n'
        "/* #include <nothing.glsl>\n"
        "   #include <nothing.glsl> */\n"
        "#define FR_LOBE FR_LOBE_D16\n"
        '  #  include "parts/light.glsl"  // and comments /* behind */\n'
        '#include "facerender/lobe.glsl" /* again */\n'
        "out vec4 result;\n"
        "void main() { result = vec4(fr_ward(light, light, light, 0.3)); }\n"
    )
    text = fr.shader_source(str(own))
    assert text.startswith("#version 330 core\n// ")
    assert text.count("#version") == 1
    assert text.index("float fr_ward") < text.index("vec3 color;") < text.index("vec3 light;")
    assert text.count("float fr_lobe(") == 1
    assert "fr_lobe_exact" not in text, "its own #define decides"
    with pytest.raises(InputError, match="own.frag contains #version 330 core: leave out that"):
        fr.shader_source(str(own), "es300")


DECIDED = {  # conditions where A is 2: their value, or None where the host or the compiler decides
    **dict.fromkeys(("B == 2 && defined(A)", "A < 3", "HOST || 1 == 1"), True),
    **dict.fromkeys(("B > 2 || !defined(A)", "2 >= 3 || 3 <= 2 || 2 > 2 || 2 < 2 || 0"), False),
    **dict.fromkeys(("HOST", "(HOST)", "HOST || 0", "OCTAL == 10", "A == 2 && !(0)"), None),
    **dict.fromkeys(("defined A && !defined ( ABSENT )", "!(defined(HOST) || defined(A))"), None),
}


@pytest.mark.parametrize("condition", DECIDED)
def test_conditions_decided_by_macros_are_removed(condition):
    code = f"#if {condition}\nyes\n#else\nno\n#endif"
    preprocessor = Preprocessor(fr.shader_dir())
    preprocessor.append(f"#define A 2\n#define B A\n#define OCTAL 010\n{code}\n")
    lines = [line for line in preprocessor.text.split("\n") if line and "#define" not in line]
    assert lines == {True: ["yes"], False: ["no"], None: code.split("\n")}[DECIDED[condition]]


def test_nested_branches_decided_by_macros_are_removed():
    text = """#define A 2
#if A > 2
no
#elif HOST
yes1
#elif A < 3
yes2
#else
no
#endif
#ifndef A
no
#else
yes3
#if HOST
yes4
#define A 3
#endif
#endif
#undef A
#if A == 2
yes5
#endif
#if 0
#if HOST
no
#else
no
#endif
no
#endif
#define F(x) x
#ifdef F
yes6
#endif
#undef NEVER
"""
    preprocessor = Preprocessor(fr.shader_dir())
    preprocessor.append(text)
    lines = preprocessor.text.split("\n")
    assert [line for line in lines if line and "#" not in line] == [f"yes{i}" for i in range(1, 7)]
    conditions = [line for line in lines if re.match("#(if|el|endif)", line)]
    kept = ("#if HOST", "#else", "#endif", "#if HOST", "#endif", "#if A == 2", "#endif")
    assert conditions == [*kept]
    assert fr.resolve_includes(text) == text, "conditions are the compiler's"


def test_include_in_a_branch_does_not_replace_one_outside():
    ward = '#include "facerender/ward.glsl"\n'
    definition = "float fr_ward("
    assert fr.resolve_includes(ward + ward).count(definition) == 1
    assert fr.resolve_includes(f"#if X\n{ward}{ward}#endif\n").count(definition) == 1
    assert fr.resolve_includes(f"{ward}#if X\n{ward}#endif\n").count(definition) == 1
    assert fr.resolve_includes(f"#if X\n{ward}#else\n{ward}#endif\n").count(definition) == 2
    assert fr.resolve_includes(f"#if X\n{ward}#endif\n{ward}").count(definition) == 2
    assert fr.resolve_includes(f"#if 1\n{ward}#endif\n{ward}").count(definition) == 2


def test_line_directives_name_the_included_files():
    lines = fr.resolve_includes('\n#include "facerender/ward.glsl"\n').split("\n")
    (directive,) = (
        line for line in lines if "facerender/half_vector.glsl" in line and "#line 1 " in line
    )
    assert re.fullmatch(r"#line 1 \d+  // facerender/half_vector.glsl", directive)


@pytest.mark.parametrize("end", ["", "\n", "\n\n", "\n#endif", "\n#endif\n"])
def test_no_line_directive_at_the_end(end):
    start = "#if 1\n" if "endif" in end else ""
    text = fr.resolve_includes(f'{start}#include "facerender/ward.glsl"{end}')
    assert not text.rstrip().split("\n")[-1].startswith("#line"), "NVIDIA rejects it"


@pytest.mark.parametrize(
    "text",
    [
        "#if 0\n{}#endif\n",
        "#if (0)\n#ifdef X\n{}#else\n{}#endif\n#endif\n",
        "#if 1\n#else\n{}#endif\n",
        "#if 0\n#elif 0\n{}#else\n#if 1\n#elif X\n{}#endif\n#endif\n",
        "#if X\n#elif 2\n#else\n{}#endif\n",
    ],
)
@pytest.mark.parametrize("file", ["absent.glsl", "facerender/fresnel.glsl"])
def test_includes_that_literal_conditions_skip_are_ignored(evaluate, text, file):
    text = text.replace("{}", f'#include "{file}"\n')
    for flat in (Includes(fr.shader_dir()), Preprocessor(fr.shader_dir())):
        flat.append(text)
        assert flat.files == []
        assert "include" not in flat.text
    assert evaluate(fr.resolve_includes(text), "x", {"x": np.float32([0.5])}) == 0.5


def test_missing_file_within_a_condition_is_left_to_the_compiler(evaluate, tmp_path):
    inputs = {"x": np.float32([0.5])}
    own = tmp_path / "own.glsl"
    for line in ('#include "absent.glsl"\n', "#include <other/absent.glsl>\n", "#include FILE\n"):
        for condition in ("#ifdef HOST", "#if HOST == 1", "#if 1\n#elif HOST", "#if 0\n#elif HOST"):
            text = f"{condition}\n{line}#endif\n"
            own.write_text(text)
            for flat in (fr.resolve_includes(text), fr.shader_source(str(own))):
                assert evaluate(flat, "x", inputs) == 0.5
            if "#if 1" not in condition:
                with pytest.raises(moderngl.Error, match=r"no file (\S*/)?absent|#include FILE"):
                    evaluate(f"#define HOST 1\n{fr.resolve_includes(text)}", "x", inputs)
    (tmp_path / "inner.glsl").write_text('#include "absent.glsl"\n')
    text = '#ifdef HOST\n#include "inner.glsl"\n#endif\n'
    assert "#error no file absent.glsl in " in fr.resolve_includes(text, [tmp_path])
    with pytest.raises(InputError, match=r"inner\.glsl:1: no file absent\.glsl in "):
        fr.resolve_includes('#include "inner.glsl"\n', [tmp_path])


def test_include_directories(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / f"{folder}/shared.glsl").write_text(f"// {folder}\n")
    (tmp_path / "b/own.glsl").write_text(
        '#include <shared.glsl>\n#include "facerender/ward.glsl"\n'
    )
    paths = [str(tmp_path / "a"), tmp_path / "b"]
    assert "// a\n" in fr.resolve_includes('#include "shared.glsl"\n', paths)
    assert "// b\n" in fr.resolve_includes("#include <shared.glsl>\n", paths[::-1])
    text = fr.shader_source(str(tmp_path / "b/own.glsl"), paths=paths)
    assert "// a\n" in text
    assert "float fr_ward(" in text
    with pytest.raises(InputError, match=r"no file c.glsl in .*/a or .*/b or .*/shaders$"):
        fr.resolve_includes('#include "c.glsl"', paths)
    for wrong in ([1], [""]):
        with pytest.raises(InputError, match="paths"):
            fr.resolve_includes("", wrong)


@pytest.mark.parametrize("version", ["130", "140", "150 core", "330", "300 es"])
def test_line_numbers_of_every_version(evaluate, version, tmp_path):
    """Up to GLSL 150, #line numbers the line after the next."""
    (tmp_path / "wrong.glsl").write_text("// 1\n#ifdef X\n#endif\nwrong;\n")
    text = f'#version {version}\n\n#include "facerender/constants.glsl"\n\n'
    vertex = f"#version {version}\nvoid main() {{}}"
    for end, match in (
        ("wrong;\n", AT_LINE.format(5)),
        (
            '#ifdef GL_core_profile\n#include "facerender/ward.glsl"\n#endif\nwrong;\n',
            AT_LINE.format(8),
        ),
        ('#include "wrong.glsl"\n', AT_LINE.format(4).replace("0", "2", 1)),
    ):
        with evaluate.gl as gl, pytest.raises(moderngl.Error, match=match):
            gl.program(vertex, fr.resolve_includes(text + end, [tmp_path]))


def test_default_macro_is_not_an_include_guard():
    default = "#ifndef FR_LOBE\n#define FR_LOBE FR_LOBE_D16\n#endif\n"
    preprocessor = Preprocessor(fr.shader_dir())
    preprocessor.append(default + '#include "facerender/lobe.glsl"\n')
    assert "float fr_lobe_exact(" in preprocessor.text, "the host may still choose"


def test_comments_do_not_become_code():
    text = """#define A 1 // of /* one \\
#include "nothing.glsl"
#if 1 /* begins
ends */ && 1
yes
#endif
#include "facerender/masking.glsl" /* begins
ends */
/* not closed
#include "nothing.glsl"
"""
    for flat in (Includes(fr.shader_dir()), Preprocessor(fr.shader_dir())):
        flat.append(text)
        lines = flat.text.split("\n")
        assert "ends */" not in lines
        assert lines[-3:-1] == ["/* not closed", '#include "nothing.glsl"']


def test_file_with_two_paths_is_included_once(tmp_path):
    (tmp_path / "link.glsl").symlink_to(fr.shader_dir() / "facerender/ward.glsl")
    own = tmp_path / "own.glsl"
    own.write_bytes(b'\xef\xbb\xbf#include "link.glsl"\r\n#include "facerender/ward.glsl"\r\n')
    text = fr.shader_source(str(own), lobe="d16", m=0.9)
    assert text.count("float fr_ward(") == 1
    assert "\ufeff" not in text
    assert text.startswith("// own.glsl with")


def test_names_of_the_library(tmp_path, monkeypatch):
    ward = fr.shader_source("ward")
    assert fr.shader_source("facerender/ward.glsl") == fr.shader_source("ward.glsl") == ward
    monkeypatch.chdir(tmp_path)
    Path("ward.glsl").write_text("float own;\n")
    assert "float own;" in fr.shader_source("ward.glsl")
    assert fr.shader_source("ward") == ward
    Path("plain").write_text("float own;\n")
    assert "float own;" in fr.shader_source("plain")


def test_own_files_and_choices(tmp_path):
    own = tmp_path / "own.glsl"
    both = '#include "facerender/ward.glsl"\n#include "facerender/cook_torrance.glsl"\n'
    own.write_text("#define FR_LOBE FR_LOBE_FITTED\n" + both)
    text = fr.shader_source(str(own), m=0.3)
    assert re.search(r"#define FR_FITTED_COEFFICIENTS\(m, k\) \(\(k\) == 4 \? vec3", text)
    with pytest.raises(InputError, match="own.glsl:1 defines FR_LOBE, which lobe or m sets"):
        fr.shader_source(str(own), lobe="d16")
    own.write_text("#define FR_STEEPNESS(m, k) 1.0\n" + both)
    with pytest.raises(InputError, match="own.glsl:1 defines FR_STEEPNESS, which lobe or m sets"):
        fr.shader_source(str(own), lobe=GPower(8, 0.25))
    own.write_text("#define FR_LOBE FR_LOBE_FITTED\n" + both)
    with pytest.raises(InputError, match="m = 0.9 is outside the domain of lobe fitted for Cook"):
        fr.shader_source(str(own), m=0.9)
    own.write_text(f"#ifdef X\n{both}#else\n{both}#endif\n")
    assert (
        fr.shader_source(str(own), lobe="fitted", m=0.3).count("FR_FITTED_COEFFICIENTS(m, k) (")
        == 1
    )
    own.write_text(
        '#include "facerender/lobe/exact.glsl"\n#include "facerender/lobe/fitted.glsl"\n'
    )
    assert "FR_FITTED_FINE_COEFFICIENTS(m, k) (" in fr.shader_source(str(own), m=0.3)


@pytest.mark.parametrize(
    ("lobe", "m", "plain"), [("exact", 0.2, True), ("exact", 0.19, False), ("d16", 0.3, False)]
)
def test_constant_slope_selects_the_cheaper_form(lobe, m, plain):
    text = fr.shader_source("ward", lobe=lobe, m=m)
    assert ("#define FR_SMALL_SLOPE 0\n" in text) == plain


def test_errors_name_file_and_line(tmp_path):
    def fail(message: str, **files: str) -> None:
        for name, text in files.items():
            (tmp_path / f"{name}.glsl").write_text(text)
        with pytest.raises(InputError, match=message):
            fr.shader_source(str(tmp_path / "a.glsl"))

    fail(r"a\.glsl:2: no file nothing\.glsl in .* or .*shaders", a='\n#include "nothing.glsl"\n')
    fail(
        r"b\.glsl:1: no file lobe\.glsl in [^ ]*shaders$",
        a='#include "b.glsl"',
        b="#include <lobe.glsl>",
    )
    fail(r"b\.glsl:1: include cycle .*a\.glsl -> .*b\.glsl -> .*a\.glsl", b='#include "a.glsl"')
    fail(r"a\.glsl:1: include cycle .*a\.glsl -> .*a\.glsl", a='#include "./a.glsl"')
    fail(r"a\.glsl:1: #include facerender: write", a="#include facerender")
    fail(r"a\.glsl:1: #endif without #if", a="#endif")
    fail(r"b\.glsl:1: #else without #if", a='#if X\n#include "b.glsl"\n#endif', b="#else")
    fail(r"a\.glsl: #if without #endif", a="#if X")
    fail(r"a\.glsl:2: a second #version", a="#version 330\n#version 330")
    fail(r"a\.glsl:1: cannot read xxx.*: file name too long", a=f'#include "{"x" * 300}"')
    for i in range(100):
        (tmp_path / f"{i}.glsl").write_text(f'#include "{i + 1}.glsl"')
    fail(r"62\.glsl:1: more than 64 nested includes", a='#include "0.glsl"')
    with pytest.raises(InputError, match="line 2: no file facerender/ggx.glsl in "):
        fr.resolve_includes('\n#include "facerender/ggx.glsl"')


def test_invalid_choices_are_refused(tmp_path):
    for message, arguments in (
        ("unknown shader 'ggx'; known: albedo, constants, cook_torrance, ", {"name": "ggx"}),
        ("unknown target '120'; known: 330, es300, vulkan", {"name": "ward", "target": "120"}),
        ("unknown lobe 'd32'; known: exact, ", {"name": "ward", "lobe": "d32"}),
        (r"m = 0.9 is outside .* give m in \[0.0001, 0.7071\)", COOK_TORRANCE | {"m": 0.9}),
        ("m = 0.9 is outside", {"name": "lobe/fitted", "m": 0.9}),
        (r"m = 0.6 is outside .* g-power 5 \(0.2/m\^2 - 0.8\) .* in \[0.0001, 0.5\]",
         {"name": "ward", "lobe": GPower(5, 0.2, 0.8), "m": 0.6}),
        ("m = 0.3 without a lobe", {"name": "ward", "m": 0.3}),
        ("fresnel does not use FR_LOBE: leave lobe d16 out", {"name": "fresnel", "lobe": "d16"}),
        ("masking does not use a slope: leave m = 0.3 out", {"name": "masking", "m": 0.3}),
        ("cook_torrance_two has two slopes: leave m = 0.3 out",
         {"name": "cook_torrance_two", "lobe": "d16", "m": 0.3}),
        ("cannot read .*none.frag: no such file", {"name": str(tmp_path / "none.frag")}),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            fr.shader_source(**arguments)
    (tmp_path / "latin.glsl").write_bytes(b"// \xe9")
    with pytest.raises(InputError, match="latin.glsl: it is not UTF-8 text"):
        fr.shader_source(str(tmp_path / "latin.glsl"))
    assert fr.shader_source("ward", lobe="d16", m=0.9), "Ward's domain is larger"


def test_a_function_names_its_file():
    for function in functions():
        name = function.file.removeprefix("facerender/").removesuffix(".glsl")
        assert fr.shader_source(function.name) == fr.shader_source(name)


def test_moderngl_programs_may_include(evaluate):
    with evaluate.gl as gl:
        fr.moderngl_includes(gl)
        fragment = """#version 330 core
        #define FR_LOBE FR_LOBE_D16
        #include "facerender/ward.glsl"
        #include "facerender/cook_torrance.glsl"
        out float result;
        const vec3 z = vec3(0.0);
        void main() { result = fr_ward(z, z, z, 0.3) + fr_lobe(1.0, 0.3, 0); }
        """
        gl.program("#version 330\nvoid main() {}", fragment)  # gl.gc() frees it
        gl.includes.clear()


@pytest.mark.parametrize("function", functions(), ids=lambda function: function.name)
def test_headers_are_complete(function):
    assert function.summary.endswith(".")
    assert all(function.parameters.values())
    assert all((function.formula, function.unit, function.error, function.source))


def test_every_symbol_carries_the_prefix():
    """Functions and macros of the library must not collide with names of the user."""
    for name in glsl.library():
        text = (fr.shader_dir() / f"facerender/{name}.glsl").read_text()
        code = re.sub(r"//[^\n]*", "", text)
        macros = re.findall(r"^\s*#\s*define\s+(\w+)", code, re.MULTILINE)
        outside = re.sub(r"^\s*#[^\n]*|precision highp \w+;", "", code, flags=re.MULTILINE)
        while "{" in outside:
            outside = re.sub(r"\([^()]*\)\s*\{[^{}]*\}|\{[^{}]*\}", ";", outside)
        declared = re.findall(r"\w+(?=\s*;)", outside)
        assert all(macro.startswith("FR_") for macro in macros)
        assert all(symbol.startswith("fr_") for symbol in declared), declared
        assert len(declared) == sum(f.file == f"facerender/{name}.glsl" for f in functions())
