"""Every public function of the shader library is finite and >= 0 wherever it may be called, and the
BRDFs are exactly 0 below the surface.

The results are counted in NumPy, as a compiler may take x != x for false. Slopes at which an
approximation has no meaning are among the inputs: it must still give a number.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from facerender import resolve_includes, shader_dir
from facerender.drawing.context import Backend, create_context
from facerender.drawing.evaluate import Evaluator, Inputs
from facerender.terms import FRESNEL, LOBES, MASKING

FEW, MANY = 2**18, 2**20  # samples of one draw
MANY_DRAWS = -(-(10**8) // MANY)

CHOICES = {  # FR_K is of this test alone: the argument k
    "FR_K": ("FR_K_COOK_TORRANCE", "FR_K_WARD"),
    "FR_LOBE": (*(lobe.macro for lobe in LOBES.values()), "FR_LOBE_G_POWER"),
    "FR_SMALL_SLOPE": ("0", "1"),
    "FR_FRESNEL": tuple(term.macro for term in FRESNEL.values()),
    "FR_MASKING": tuple(term.macro for term in MASKING.values()),
}
COOK_TORRANCE = "fr_cook_torrance(n, l, v, m, f0)"
FRONTAL = "fr_cook_torrance_terms(n, l, v, m, f0, FR_LOBE, FR_FRESNEL_CONSTANT, FR_MASKING_NONE)"
OTHER = FRONTAL.replace("CONSTANT", "DIELECTRIC").replace("NONE", "KELEMEN")
LAID = "p.y + p.z, 1.0, p.y, p.z"  # n_dot_h, h_dot_h, n_dot_l, n_dot_v
FUNCTIONS = (  # a file, a float of the inputs below, the choices on which it depends
    ("cook_torrance", COOK_TORRANCE, "FR_LOBE FR_FRESNEL"),
    ("cook_torrance", COOK_TORRANCE, "FR_LOBE FR_MASKING"),
    ("cook_torrance", COOK_TORRANCE, "FR_SMALL_SLOPE FR_MASKING"),
    ("cook_torrance", FRONTAL, "FR_LOBE"),
    ("cook_torrance", FRONTAL.replace("FR_LOBE", "FR_DEFAULT_LOBE"), "FR_SMALL_SLOPE"),
    ("cook_torrance", OTHER.replace("FR_LOBE", "FR_DEFAULT_LOBE"), ""),
    ("ward", "fr_ward(n, l, v, m)", "FR_LOBE"),
    ("ward", "fr_ward(n, l, v, m)", "FR_SMALL_SLOPE"),
    ("ward", "fr_ward_terms(n, l, v, m, FR_LOBE)", "FR_LOBE"),
    ("ward_printed", "fr_ward_printed(n, l, v, m)", "FR_LOBE"),
    ("ward_printed", "fr_ward_printed_terms(n, l, v, m, FR_LOBE)", "FR_LOBE"),
    ("half_vector", "fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).x", "FR_SMALL_SLOPE"),
    ("half_vector", "fr_half_vector(n, l + v, dot(n, l) + dot(n, v)).y", "FR_SMALL_SLOPE"),
    ("lobe", "fr_lobe(c, m, FR_K)", "FR_LOBE FR_K"),
    ("lobe", "fr_lobe_of(c, m, FR_K, FR_LOBE)", "FR_LOBE FR_K"),
    ("lobe/exact", "fr_slope_factor(tan2)", ""),
    ("lobe/exact", "fr_lobe_exact_tan2(tan2, m, FR_K)", "FR_K"),
    ("lobe/g_power", "fr_lobe_clamped_power(c, tan2, 1)", ""),
    ("lobe/g_power", "fr_lobe_clamped_power(c, tan2, 31)", ""),
    *((lobe.file, re.sub(r"\bk\b", "FR_K", lobe.call), "FR_K") for lobe in LOBES.values()),
    ("lobe/fitted", "length(fr_lobe_fitted_coefficients(m, FR_K) * m * m)", "FR_K"),
    ("lobe/fitted", "length(fr_lobe_fitted_fine_coefficients(m, FR_K) * m * m * m)", "FR_K"),
    ("fresnel", "fr_fresnel(f0, c)", "FR_FRESNEL"),
    *(("fresnel", f"fr_fresnel_of(f0, c, {term.macro})", "") for term in FRESNEL.values()),
    *(("fresnel", term.call.replace("v_dot_h", "c"), "") for term in FRESNEL.values()),
    ("masking", "fr_masking_v_cavity(c, p.x, p.y, p.z)", ""),
    ("masking", "fr_masking_kelemen(max(p.x, 0.5 * (p.y + p.z)), p.y, p.z)", ""),
    *(("masking", f"fr_masking_of({LAID}, {term.macro}).x", "") for term in MASKING.values()),
    ("masking", f"fr_masking_v_cavity_ratio({LAID}).y", ""),
)

BRDF = re.compile(r"\bfr_\w+\(n, l, v, m\b")


class Case(NamedTuple):
    file: str
    expression: str
    defines: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join([self.expression, *self.defines])


def cases() -> Iterator[Case]:
    for file, expression, choices in FUNCTIONS:
        for values in product(*(CHOICES[name] for name in choices.split())):
            chosen = dict(zip(choices.split(), values, strict=True))
            call = expression.replace("FR_K", chosen.pop("FR_K", ""))
            yield Case(file, call, tuple(f"{name} {value}" for name, value in chosen.items()))


PROGRAMS: dict[tuple[str, ...], list[Case]] = {}  # by what they define
for _case in cases():
    PROGRAMS.setdefault(_case.defines, []).append(_case)


class Random:
    """Inputs of the shader functions, in float32, dense where formulas break."""

    def __init__(self, seed: int, count: int) -> None:
        self.random, self.count = np.random.default_rng(seed), count

    def pick(self, count: int) -> NDArray[np.int64]:
        return self.random.integers(count, size=self.count)

    def often(self, one_of: int) -> NDArray[np.bool_]:
        """True for one of so many."""
        return self.pick(one_of) == 0

    def even(self) -> NDArray[np.float32]:
        """[0, 1)"""
        return self.random.random(self.count, dtype=np.float32)

    def small(self) -> NDArray[np.float32]:
        """(0, 1]: log-uniform down to a bound that is drawn too; a third lies below 1e-12."""
        return np.exp2(-126 * self.even() * self.even())

    def cosine(self) -> NDArray[np.float32]:
        """[0, 1] and an ulp more: uniform, log-uniform towards 0, towards 1, and the ends."""
        kind, tiny = self.pick(8), self.small()
        ends = np.float32([0.0, 1.0, 1.00000012])[self.pick(3)]
        return np.select([kind < 3, kind < 5, kind < 7], [self.even(), tiny, 1 - tiny], ends)

    def direction(self) -> NDArray[np.float32]:
        """A unit vector: a quarter points below z = 0, many lie in that plane or along an axis."""
        z = np.minimum(self.cosine(), 1)
        r = np.sqrt((1 - z) * (1 + z))
        turn = np.where(self.often(4), 0, np.float32(2.0 * np.pi) * self.even())
        return np.stack([r * np.cos(turn), r * np.sin(turn), np.where(self.often(4), -z, z)], -1)

    def stretched(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        by = np.where(self.often(2), 0, np.float32(1e-6) * (2 * self.even() - 1))
        return x * (1 + by)[:, None]

    def inputs(self) -> dict[str, NDArray[np.float32]]:
        """Unit vectors n, l and v; p in (0, 1] for products of them; m, f0, tan2 and c."""
        light, eye = self.direction(), self.direction()
        kind = self.pick(4)[:, None]
        mirrored = light * np.float32([-1, -1, 1])
        eye = np.select([kind == 1, kind == 2, kind == 3], [mirrored, light, -light], eye)
        shifted = unit(eye + self.small()[:, None] / 2 * self.direction())
        eye = np.where(self.often(2)[:, None], shifted, eye)

        up = np.where(self.often(2)[:, None], np.float32([0, 0, 1]), self.direction())
        axes = np.float32([[0, 1, 0], [1, 0, 0]])
        across = unit(np.cross(axes[(np.abs(up[:, 0]) < 0.5).astype(int)], up))
        frame = np.stack([across, np.cross(up, across), up], -1)
        n = self.stretched(up)
        l, v = (self.stretched(np.einsum("nij,nj->ni", frame, x)) for x in (light, eye))

        m = np.clip(2 * np.exp2(np.float32(-14.3) * self.even()), np.float32(1e-4), 2)
        m = np.where(self.often(8), np.float32([1e-4, 2.0])[self.pick(2)], m)
        reflectances = np.float32([0.0, 1e-8, 0.028, 0.99999994])
        f0 = np.where(self.often(2), reflectances[self.pick(4)], np.float32(0.999) * self.even())
        p = np.stack([self.cosine(), self.cosine(), self.cosine()], -1).clip(np.float32(1e-37))
        kind, tan2 = self.pick(8), self.small()
        tan2 = np.select([kind == 0, kind > 4], [np.float32(0), 1 / tan2], tan2)
        return {"n": n, "l": l, "v": v, "p": p, "m": m, "f0": f0, "tan2": tan2, "c": self.cosine()}


def unit(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def faults(evaluator: Evaluator, cases: Sequence[Case], inputs: Inputs) -> list[str]:
    """Tell what is wrong with the values of cases that define the same, and the inputs of the first
    value that is."""
    lines = [f"#define {define}" for define in cases[0].defines]
    lines += [f'#include "facerender/{file}.glsl"' for file in dict.fromkeys(c.file for c in cases)]
    prelude = resolve_includes("\n".join([*lines, ""]))
    expressions = [case.expression for case in cases]
    used = set(re.findall(r"\w+", " ".join(expressions)))
    values = evaluator.each(prelude, expressions, {k: x for k, x in inputs.items() if k in used})
    below = np.minimum(*((inputs["n"] * inputs[name]).sum(axis=-1) for name in "lv")) <= 0.0
    told = []
    for case, found in zip(cases, values, strict=True):
        lit = below & (found != 0.0) & bool(BRDF.search(case.expression))
        wrong = lit | ~((found >= 0.0) & (found < np.inf))
        if wrong.any():
            first = wrong.argmax()
            bad = {
                "NaN": np.isnan(found),
                "infinite": np.isinf(found),
                "negative": found < 0.0,
                "not 0 below the surface": lit,
            }
            counts = ", ".join(f"{where.sum()} {name}" for name, where in bad.items())
            told.append(f"{case}: {counts} in {len(found)} samples; first: {found[first]:.9g} at")
            for name in re.findall(r"\b(?:[nlvpmc]|f0|tan2)\b", case.expression):
                told.append(f"{name} = {inputs[name][first].tolist()}")
    return told


@pytest.fixture(scope="module")
def evaluator(egl: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(egl).gl)
    yield evaluator
    evaluator.release()


@pytest.fixture(scope="module")
def inputs() -> Inputs:
    return Random(0, FEW).inputs()


@pytest.mark.parametrize("defines", PROGRAMS, ids=lambda defines: " ".join(defines) or "all others")
def test_finite_and_not_negative(evaluator, inputs, defines):
    if found := faults(evaluator, PROGRAMS[defines], inputs):
        pytest.fail("\n".join(found), pytrace=False)


@pytest.mark.slow
def test_finite_and_not_negative_in_many_samples(evaluator, capsys):
    for seed in range(MANY_DRAWS):
        inputs = Random(seed, MANY).inputs()
        for cases in PROGRAMS.values():
            if found := faults(evaluator, cases, inputs):
                pytest.fail("\n".join([f"seed {seed}", *found]), pytrace=False)
    count = sum(map(len, PROGRAMS.values()))
    with capsys.disabled():
        print(f"\n{MANY_DRAWS * MANY:,} samples of each of {count} expressions: none bad")


@pytest.mark.parametrize(
    ("name", "expression"),
    [
        ("NaN", "c == 0.0 ? uintBitsToFloat(0x7fc00000u) : c"),
        ("infinite", "c == 0.0 ? uintBitsToFloat(0x7f800000u) : c"),
        ("negative", "c == 0.0 ? -1e-30 : c"),
        ("not 0 below the surface", "fr_ward(n, l, v, m) + (c == 0.0 ? 1.0 : 0.0)"),
    ],
)
def test_a_fault_is_counted_and_told(evaluator, inputs, name, expression):
    cases = [Case("ward", "c"), Case("ward", expression), Case("ward", "1.0")]
    told, *at = faults(evaluator, cases, inputs)
    assert told.startswith(expression)
    assert re.search(rf"\b[1-9]\d* {name}", told)
    assert len(re.findall(r"\b0 (?:NaN|infinite|negative|not 0)", told)) == 3
    assert "c = 0.0" in at


def test_no_function_and_no_choice_is_left_out():
    files = sorted((shader_dir() / "facerender").rglob("*.glsl"))
    library = "".join(path.read_text(encoding="utf-8") for path in files)
    functions = re.findall(r"^\w+ (fr_\w+)\(", library, re.MULTILINE)
    names = "FR_K|FR_LOBE|FR_FRESNEL|FR_MASKING"
    choices = re.findall(rf"^#define ((?:{names})_\w+) \d+$", library, re.MULTILINE)
    called = re.findall(r"\bfr_\w+", " ".join(call for _, call, _ in FUNCTIONS))
    assert set(called) == set(functions)
    choices = [name for name in choices if name not in ("FR_LOBE_OWN", "FR_LOBE_EVERY")]
    assert set(choices) == {
        value for values in CHOICES.values() for value in values if not value.isdigit()
    }
