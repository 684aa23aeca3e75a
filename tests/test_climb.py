"""Hill-climbing finds no directions, correctly rounded unit vectors, that pass the bounds that the
BRDFs' headers state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from facerender.drawing.context import Backend, create_context
from facerender.drawing.evaluate import Evaluator, Inputs
from facerender.shading import Term
from facerender.terms import FRESNEL, MASKING, MODELS, lobe_entry
from facerender.terms.lobe import MIN_SLOPE
from trials.cases import ALL_LOBES, F0, Case, brdf_case, directions_and_extremes
from trials.climb import climb

COOK_TORRANCE = Term("cook-torrance")
VARIANTS = [
    *(
        (Term(model, lobe, small_slope=small), F0)
        for model in MODELS
        for lobe in ALL_LOBES
        for small in ((True, False) if lobe == "exact" else (True,))
    ),
    *(
        (replace(COOK_TORRANCE, masking=name, lobe=x), F0)
        for name in MASKING
        for x in ("exact", "d16")
    ),
    *((replace(COOK_TORRANCE, fresnel=name), F0) for name in FRESNEL),
    # 1 - V.H counts where f0 does not
    *((replace(COOK_TORRANCE, lobe=x), f0) for x in ("exact", "d8") for f0 in (0.0, 1e-8)),
]
FEW, MANY = (50, 8), (1000, 60)  # starts and steps


@pytest.fixture(scope="module")
def evaluator(backend: Backend) -> Iterator[Evaluator]:
    evaluator = Evaluator(create_context(backend).gl)
    yield evaluator
    evaluator.release()


def worst(
    evaluator: Evaluator, term: Term, f0: float, starts: int, steps: int
) -> tuple[float, str]:
    end = lobe_entry(term.lobe).end(term.entry.k)

    def make(inputs: Inputs) -> Case:
        return brdf_case(term, inputs, f0=f0)

    first = directions_and_extremes(end)
    share, at = climb(evaluator, make, first, (MIN_SLOPE, 0.999 * end), starts, steps)
    return share, f"{term}, f0 = {f0}: {share:.3f} of the bound at {at}"


@pytest.mark.parametrize(("term", "f0"), VARIANTS, ids=str)
def test_bounds_hold_from_the_worst_samples_on(evaluator, term, f0):
    share, told = worst(evaluator, term, f0, *FEW)
    assert share <= 1.0, told


@pytest.mark.slow
@pytest.mark.parametrize(("term", "f0"), VARIANTS, ids=str)
def test_bounds_hold_after_a_long_climb(evaluator, capsys, term, f0):
    share, told = worst(evaluator, term, f0, *MANY)
    with capsys.disabled():
        print(f"\n{told}")
    assert share <= 1.0, told


def test_a_climb_finds_what_random_samples_miss(evaluator):
    """Of a term with a flaw that is largest for one normal."""
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
