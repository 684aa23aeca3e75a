"""Every public function of the shader library is finite and >= 0 wherever it may be called, and the
BRDFs are exactly 0 below the surface.

The fragment shader draws the inputs itself, so that 1e8 samples take seconds. The results are
counted in NumPy, as a compiler may take x != x for false. Slopes at which an approximation has no
meaning are among them: it must still give a number.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from facerender import shader_dir
from facerender.drawing.context import Backend, create_context
from tests.gpu import Evaluator

SIZE = (512, 512)
SAMPLES = 4 * SIZE[0] * SIZE[1]  # of one draw
MANY_DRAWS = -(-(10**8) // SAMPLES)

CHOICES = {  # FR_K is of this test alone: the argument k
    "FR_K": ("FR_K_COOK_TORRANCE", "FR_K_WARD"),
    "FR_LOBE": (
        "FR_LOBE_EXACT",
        "FR_LOBE_COSINE",
        "FR_LOBE_D4",
        "FR_LOBE_D8",
        "FR_LOBE_D16",
        "FR_LOBE_FITTED",
        "FR_LOBE_FITTED_FINE",
        "FR_LOBE_G_POWER",
    ),
    "FR_SMALL_SLOPE": ("0", "1"),
    "FR_FRESNEL": ("FR_FRESNEL_SCHLICK", "FR_FRESNEL_DIELECTRIC", "FR_FRESNEL_CONSTANT"),
    "FR_MASKING": ("FR_MASKING_V_CAVITY", "FR_MASKING_KELEMEN", "FR_MASKING_NONE"),
}
FRONTAL = "lit(fr_cook_torrance_terms(n, l, v, m, f0, FR_FRESNEL_CONSTANT, FR_MASKING_NONE))"
FUNCTIONS = (  # a file, a float of the inputs that SAMPLER draws, the choices on which it depends
    ("cook_torrance", "lit(fr_cook_torrance(n, l, v, m, f0))", "FR_LOBE FR_FRESNEL"),
    ("cook_torrance", "lit(fr_cook_torrance(n, l, v, m, f0))", "FR_LOBE FR_MASKING"),
    ("cook_torrance", "lit(fr_cook_torrance(n, l, v, m, f0))", "FR_SMALL_SLOPE FR_MASKING"),
    ("cook_torrance", FRONTAL, "FR_LOBE"),
    ("cook_torrance", FRONTAL, "FR_SMALL_SLOPE"),
    ("cook_torrance", FRONTAL.replace("CONSTANT", "DIELECTRIC").replace("NONE", "KELEMEN"), ""),
    ("ward", "lit(fr_ward(n, l, v, m))", "FR_LOBE"),
    ("ward", "lit(fr_ward(n, l, v, m))", "FR_SMALL_SLOPE"),
    ("ward_printed", "lit(fr_ward_printed(n, l, v, m))", "FR_LOBE"),
    ("half_vector", "fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).x", "FR_SMALL_SLOPE"),
    ("half_vector", "fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).y", "FR_SMALL_SLOPE"),
    ("lobe", "fr_lobe(c, m, FR_K)", "FR_LOBE FR_K"),
    ("lobe/exact", "fr_slope_factor(tan2)", ""),
    ("lobe/exact", "fr_lobe_exact(c, m, FR_K)", "FR_K"),
    ("lobe/exact", "fr_lobe_exact_tan2(tan2, m, FR_K)", "FR_K"),
    ("lobe/cosine", "fr_lobe_cosine(c, m, FR_K)", "FR_K"),
    ("lobe/g_power", "fr_lobe_clamped_power(c, tan2, 1)", ""),
    ("lobe/g_power", "fr_lobe_clamped_power(c, tan2, 31)", ""),
    ("lobe/g_power", "fr_lobe_g_power(c, m, FR_K, 4)", "FR_K"),
    ("lobe/g_power", "fr_lobe_g_power(c, m, FR_K, 8)", "FR_K"),
    ("lobe/g_power", "fr_lobe_g_power(c, m, FR_K, 16)", "FR_K"),
    ("lobe/fitted", "fr_lobe_fitted(c, m, FR_K)", "FR_K"),
    ("lobe/fitted", "fr_lobe_fitted_fine(c, m, FR_K)", "FR_K"),
    ("lobe/fitted", "length(fr_lobe_fitted_coefficients(m, FR_K) * m * m)", "FR_K"),
    ("lobe/fitted", "length(fr_lobe_fitted_fine_coefficients(m, FR_K) * m * m * m)", "FR_K"),
    ("fresnel", "fr_fresnel(f0, c)", "FR_FRESNEL"),
    *(("fresnel", f"fr_fresnel_of(f0, c, {kind})", "") for kind in CHOICES["FR_FRESNEL"]),
    ("fresnel", "fr_fresnel_schlick(f0, c)", ""),
    ("fresnel", "fr_fresnel_dielectric(f0, c)", ""),
    ("masking", "fr_masking_v_cavity(c, p.x, p.y, p.z)", ""),
    ("masking", "fr_masking_kelemen(max(p.x, 0.5 * (p.y + p.z)), p.y, p.z)", ""),
)

SAMPLER = """
uniform uint seed;
out vec4 result;
uint state;

uint word() {  // PCG (O'Neill 2014); each seed has a sequence of its own
    state = state * 747796405u + (2u * seed + 1u);
    uint x = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (x >> 22u) ^ x;
}

uint pick(uint count) { return word() % count; }

float uniform_() { return float(word() >> 8u) / 16777216.0; }  // [0, 1)

// In (0, 1]: log-uniform down to a bound that is drawn too; a third lies below 1e-12.
float small() { return exp2(-126.0 * uniform_() * uniform_()); }

// In [0, 1] and an ulp more: uniform, log-uniform towards 0, towards 1, and the ends.
float cosine() {
    uint kind = pick(8u);
    float even = uniform_(), tiny = small(), end = float[](0.0, 1.0, 1.00000012)[pick(3u)];
    return kind < 3u ? even : kind < 5u ? tiny : kind < 7u ? 1.0 - tiny : end;
}

// A unit vector: a quarter points below the plane z = 0, many lie in it or along an axis.
vec3 direction() {
    float z = min(cosine(), 1.0), r = sqrt((1.0 - z) * (1.0 + z));
    float turn = pick(4u) == 0u ? 0.0 : 6.28318531 * uniform_();
    return vec3(r * cos(turn), r * sin(turn), pick(4u) == 0u ? -z : z);
}

vec3 stretched(vec3 x) { return pick(2u) == 0u ? x : x * (1.0 + 1e-6 * (2.0 * uniform_() - 1.0)); }

vec3 n, l, v, p;  // unit vectors, and p in (0, 1] for products of them
float m, f0, tan2, c;

void draw_inputs() {
    vec3 light = direction(), eye = direction(), shift = 0.5 * small() * direction();
    uint kind = pick(4u);
    if (kind == 1u) eye = light * vec3(-1.0, -1.0, 1.0);  // the mirror direction
    if (kind == 2u) eye = light;
    if (kind == 3u) eye = -light;
    if (pick(2u) == 0u) eye = normalize(eye + shift);

    vec3 up = direction();
    if (pick(2u) == 0u) up = vec3(0.0, 0.0, 1.0);
    vec3 side = abs(up.x) < 0.5 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0);
    vec3 across = normalize(cross(side, up));
    mat3 frame = mat3(across, cross(up, across), up);
    n = stretched(up);
    l = stretched(frame * light);
    v = stretched(frame * eye);

    float slopes[] = float[](1e-4, 2.0), reflectances[] = float[](0.0, 1e-8, 0.028, 0.99999994);
    m = clamp(2.0 * exp2(-14.3 * uniform_()), 1e-4, 2.0);
    if (pick(8u) == 0u) m = slopes[pick(2u)];
    f0 = 0.999 * uniform_();
    if (pick(2u) == 0u) f0 = reflectances[pick(4u)];

    c = cosine();
    p = max(vec3(cosine(), cosine(), cosine()), 1e-37);
    tan2 = small();
    kind = pick(8u);
    if (kind == 0u) tan2 = 0.0;
    if (kind > 4u) tan2 = 1.0 / tan2;
}

// The value of a BRDF, or -1 where it should be exactly 0 and is not.
float lit(float value) {
    return min(dot(n, l), dot(n, v)) <= 0.0 && value != 0.0 ? -1.0 : value;
}

void main() {
    state = uint(gl_FragCoord.x);
    state = word() + uint(gl_FragCoord.y);
    state = word();
    result = vec4(0.0);
    for (int i = 0; i < 4; ++i) {
        draw_inputs();
        result = vec4(result.yzw, EXPRESSION);
    }
}
"""

FAULTS: dict[str, Callable[[NDArray[np.float32]], NDArray[np.bool_]]] = {
    "NaN": np.isnan,
    "infinite": np.isinf,
    "negative": lambda values: (values < 0.0) & (values != -1.0),
    "not 0 below the surface": lambda values: values == -1.0,
}


class Case(NamedTuple):
    file: str
    expression: str
    defines: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        return " ".join([self.expression, *(f"{name}={value}" for name, value in self.defines)])

    def fragment(self, expression: str) -> str:
        """Return the shader that draws an expression with the library as this case has it."""
        defines = [f"#define {name} {value}" for name, value in self.defines]
        includes = [f'#include "facerender/{file}.glsl"' for file in ("constants", self.file)]
        sampler = SAMPLER.replace("EXPRESSION", expression)
        return "\n".join(["#version 330 core", *defines, *includes, sampler])


CASES = [
    Case(file, expression, tuple(zip(choices.split(), values, strict=True)))
    for file, expression, choices in FUNCTIONS
    for values in product(*(CHOICES[name] for name in choices.split()))
]


@pytest.fixture(scope="module")
def evaluator(egl: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(egl).gl)
    yield evaluator
    evaluator.release()


def faults(evaluator: Evaluator, case: Case, draws: int) -> str:
    """Tell what is wrong with the values of a case, and the inputs of the first that is."""
    counts = dict.fromkeys(FAULTS, 0)
    bad_samples = []
    for seed, values in enumerate(
        evaluator.draws(case.fragment(case.expression), SIZE, range(draws))
    ):
        bad = ~(np.isfinite(values) & (values >= 0.0))
        if bad.any():
            bad_samples.append((seed, bad.argmax()))
            for name, finds in FAULTS.items():
                counts[name] += int(finds(values).sum())
    if not bad_samples:
        return ""
    seed, index = bad_samples[0]

    def there(expression: str) -> str:
        (values,) = evaluator.draws(case.fragment(expression), SIZE, [seed])
        return f"{values[index]:.9g}"

    told = ", ".join(f"{count} {name}" for name, count in counts.items())
    lines = [f"{case}: {told} in {draws * SAMPLES} samples", f"first: {there(case.expression)} at"]
    for name in dict.fromkeys(re.findall(r"\b(?:[nlvpmc]|f0|tan2)\b", case.expression)):
        axes = "xyz" if name in "nlvp" else "x"
        lines.append(f"{name} = " + ", ".join(there(f"vec3({name}).{axis}") for axis in axes))
    return "\n".join(lines)


@pytest.mark.parametrize("draws", [1, pytest.param(MANY_DRAWS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_finite_and_not_negative(evaluator, case, draws, capsys):
    found = faults(evaluator, case, draws)
    if found:
        pytest.fail(found, pytrace=False)
    if draws > 1:
        with capsys.disabled():
            print(f"\n{draws * SAMPLES:,} samples of {case}: none bad", end=" ")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("NaN", "uintBitsToFloat(0x7fc00000u)"),
        ("infinite", "uintBitsToFloat(0x7f800000u)"),
        ("negative", "-1e-30"),
        ("not 0 below the surface", "-1.0"),
    ],
)
def test_a_fault_is_counted_and_told(evaluator, name, value):
    found = faults(evaluator, Case("ward", f"c == 0.0 ? {value} : c"), 1)
    assert re.search(rf"\b[1-9]\d* {name}", found)
    assert len(re.findall(r"\b0 (?:NaN|infinite|negative|not 0)", found)) == len(FAULTS) - 1
    assert found.endswith("c = 0")


def test_no_function_and_no_choice_is_left_out():
    files = sorted((shader_dir() / "facerender").rglob("*.glsl"))
    library = "".join(path.read_text(encoding="utf-8") for path in files)
    functions = re.findall(r"^\w+ (fr_\w+)\(", library, re.MULTILINE)
    names = "FR_K|FR_LOBE|FR_FRESNEL|FR_MASKING"
    choices = re.findall(rf"^#define ((?:{names})_\w+) \d+$", library, re.MULTILINE)
    called = re.findall(r"\bfr_\w+", " ".join(call for _, call, _ in FUNCTIONS))
    assert set(called) == set(functions)
    assert set(choices) == {
        value for values in CHOICES.values() for value in values if not value.isdigit()
    }
