"""Tests the error bounds of the BRDFs' headers by hill climbing over directions, which are unit
vectors correctly rounded to float32."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from facerender.drawing.context import Backend, create_context
from facerender.scene.shading import Term
from facerender.terms.lobe import MIN_SLOPE, lobe_entry
from tests.test_targets import opened
from tests.verification.cases import Case, Each, brdf_case, directions_and_extremes
from tests.verification.climb import VARIANTS, climb, slopes_of
from tests.verification.evaluate import Evaluator, Inputs
from tests.verification.targets import Remote

FEW, MANY = (50, 8), (1000, 60)  # starts and steps
# One target per compiler, because rounding depends on the compiler.
COMPILERS = ("GLSL 330, EGL", "GLSL 330, softpipe", "WebGL 2, Chromium", "WGSL, Vulkan")


@pytest.fixture(scope="module")
def evaluator(backend: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(backend).gl)
    yield evaluator
    evaluator.release()


@pytest.fixture(scope="module", params=COMPILERS)
def target(request: pytest.FixtureRequest) -> Iterator[Remote]:
    with opened(request.param) as remote:
        yield remote


def worst(target: Each, term: Term, f0: float, starts: int, steps: int) -> tuple[float, str]:
    def make(inputs: Inputs) -> Case:
        return brdf_case(term, inputs, f0=f0)

    first = directions_and_extremes(lobe_entry(term.lobe).end(term.entry.k))
    share, at = climb(target, make, first, slopes_of(term), starts, steps)
    return share, f"{term}, f0 = {f0}: {share:.3f} of the bound at {at}"


@pytest.mark.first_case
@pytest.mark.parametrize(("term", "f0"), VARIANTS, ids=str)
def test_bounds_hold_from_the_worst_samples_on(evaluator, term, f0):
    share, description = worst(evaluator, term, f0, *FEW)
    assert share <= 1.0, description


@pytest.mark.slow
@pytest.mark.parametrize(("term", "f0"), VARIANTS, ids=str)
def test_bounds_hold_after_a_long_climb(target, capsys, term, f0):
    share, description = worst(target, term, f0, *MANY)
    with capsys.disabled():
        print(f"\n{target.name}: {description}")
    assert share <= 1.0, description


def test_climb_finds_errors_that_random_samples_miss(evaluator):
    """The term has an artificial error with its maximum at one normal."""
    term = Term("ward")
    first = directions_and_extremes(2.0)

    def flawed(by: float, inputs: Inputs) -> Case:
        case = brdf_case(term, inputs)
        corner = "pow(max(dot(n, vec3(0.6, 0.48, 0.64)), 0.0), 200.0)"
        return replace(case, expression=f"{case.expression} * (1.0 + {by} * {corner})")

    def share(by: float) -> float:
        case = flawed(by, first)
        return float(case.share(evaluator(case.prelude, case.expression, first)).max())

    by = 0.9 * 1e-3 / share(1e-3)
    assert share(by) < 1.0
    found, at = climb(evaluator, partial(flawed, by), first, (MIN_SLOPE, 2.0), 50, 20)
    assert 1.0 < found < np.inf
    assert np.dot(at["n"], [0.6, 0.48, 0.64]) > 0.99
