"""Tests every public function of the shader library on every target against its cases
(``tests/verification/cases.py``)."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.conftest import missing
from tests.test_shaders import FILES, functions
from tests.verification.cases import GROUPS, cases_of, evaluated
from tests.verification.targets import TARGETS, Remote

MARKS = {"GLSL 330, OSMesa": "osmesa", "WebGL 2, Chromium": "browser"}


def marked(name: str) -> object:
    """Return a target as a pytest parameter; all but the first have a marker."""
    marks = [] if name == next(iter(TARGETS)) else [getattr(pytest.mark, MARKS.get(name, "slow"))]
    return pytest.param(name, marks=marks)


def opened(name: str) -> Remote:
    try:
        return Remote(name)
    except Exception as error:  # glcontext raises Exception itself
        missing(f"{name}: {error}")


@pytest.fixture(scope="module", params=map(marked, TARGETS))
def target(request: pytest.FixtureRequest) -> Iterator[Remote]:
    with pytest.MonkeyPatch.context() as patch:
        if request.param == next(iter(TARGETS)):  # without optimisation, llvmpipe compiles twice
            patch.setenv("GALLIVM_PERF", "nopt")  # as fast; the other targets do optimise
        remote = opened(request.param)
    with remote:
        yield remote


@pytest.mark.first_case
@pytest.mark.parametrize("group", GROUPS)
def test_functions_agree_with_float64(target, group):
    cases = cases_of(group)
    results = evaluated(cases, target)
    faults = {name: case.fault(results[name]) for name, case in cases.items()}
    messages = [f"{name}: {fault}" for name, fault in faults.items() if fault]
    if messages:
        pytest.fail("\n".join(messages), pytrace=False)


@pytest.mark.slow
def test_every_function_is_tested():
    defined = {name for path in FILES for name in functions(path.read_text())}
    expressions = [case.expression for group in GROUPS for case in cases_of(group).values()]
    called = {name for call in expressions for name in re.findall(r"fr_\w+", call)}
    assert called == defined
