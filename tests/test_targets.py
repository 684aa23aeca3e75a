"""Every public function of the shader library on every target, within the bounds of
``test_shaders.py``."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.conftest import missing
from tests.targets import TARGETS, Remote
from tests.test_shaders import CASES, check


@pytest.fixture(scope="module", params=TARGETS)
def evaluate(request: pytest.FixtureRequest) -> Iterator[Remote]:
    try:
        remote = Remote(request.param)
    except Exception as error:  # glcontext raises bare Exception
        missing(f"{request.param}: {error}")
    with remote:
        yield remote


@pytest.mark.parametrize("name", CASES)
def test_function_agrees_with_float64(evaluate, name):
    case = CASES[name]()
    check(evaluate(case.include, case.expression, case.inputs), case)
