"""Tests that every public function of the shader library is finite and >= 0 for all valid inputs,
and that the BRDFs are exactly 0 below the surface.

NumPy counts the wrong values, since a shader compiler may evaluate x != x to false. The inputs
include slopes outside the domain of an approximation, which must still return a number.
"""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.test_shaders import FILES, functions
from tests.verification import cases
from tests.verification.cases import Case
from tests.verification.evaluate import Inputs
from tests.verification.many import GROUPS, Random, cases_of, faults, faults_of_draw

FEW = 2**15  # samples per draw


@pytest.fixture(scope="module")
def inputs() -> Inputs:
    return Random(0, FEW).inputs()


@pytest.mark.first_case
@pytest.mark.parametrize("group", GROUPS)
def test_finite_and_not_negative(evaluator, inputs, group):
    """Of large groups only every seventh case runs; these contain every lobe."""
    cases = list(cases_of(group).items())
    if found := faults(evaluator, dict(cases[:: 7 if len(cases) > 8 else 1]), inputs):
        pytest.fail("\n".join(found), pytrace=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_finite_and_not_negative_in_many_samples(evaluator, seed):
    """For 10^8 samples, run ``python -m benchmarks.finite``."""
    if found := faults_of_draw(evaluator, seed):
        pytest.fail("\n".join([f"seed {seed}", *found]), pytrace=False)


@pytest.mark.parametrize(
    ("name", "expression"),
    [
        ("NaN", "c == 0.0 ? uintBitsToFloat(0x7fc00000u) : c"),
        ("infinite", "c == 0.0 ? uintBitsToFloat(0x7f800000u) : c"),
        ("negative", "c == 0.0 ? -1e-30 : c"),
        ("not 0 below the surface", "fr_ward(n, l, v, m) + (c == 0.0 ? 1.0 : 0.0)"),
    ],
)
def test_wrong_values_are_counted_and_named(evaluator, inputs, name, expression):
    calls = ("c", expression, "1.0")
    tried = {call: Case(cases.include("ward"), call, {}, np.zeros(1)) for call in calls}
    message, *at = faults(evaluator, tried, inputs)
    assert message.startswith(expression)
    assert re.search(rf"\b[1-9]\d* {name}", message)
    assert len(re.findall(r"\b0 (?:NaN|infinite|negative|not 0)", message)) == 3
    assert "c = 0.0" in at


def test_no_function_is_left_out():
    expressions = [case.expression for group in GROUPS for case in cases_of(group).values()]
    called = {name for call in expressions for name in re.findall(r"fr_\w+", call)}
    assert called == {name for path in FILES for name in functions(path.read_text())}
