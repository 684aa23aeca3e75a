"""What the parts of the host's fragment program cost is positive, in order, and adds up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from facerender.errors import InputError, NotMeasured
from facerender.pricing import amd, fragment
from facerender.pricing.fragment import PARTS, PROGRAMS, Program
from facerender.pricing.variants import terms
from facerender.shading import Model, Shading
from tests.conftest import missing

FULL = {"albedo_map": True, "normal_map": True, "property_map": True, "ambient": True}
WHOLE = (
    Program(directional_lights=3),
    Program(directional_lights=3, directional_specular=3),
    Program(**FULL, directional_lights=3, directional_specular=3),
    Program(**FULL, directional_lights=2, point_lights=1, directional_specular=2, point_specular=1),
    Program(**FULL, directional_lights=0, point_lights=3, point_specular=3),
)


@pytest.fixture(scope="module", params=amd.FAMILIES)
def family(request):
    try:
        amd.spirv(comp="#version 450\nvoid main() {}\n")
        amd.driver()
    except NotMeasured as error:
        missing(str(error))
    return request.param


@pytest.fixture(scope="module")
def parts(family):
    return fragment.by_compiler(family)


def test_every_part_costs_something(parts):
    assert tuple(parts) == PARTS
    assert min(parts.values()) > 0.0
    assert parts["normal map"] > parts["albedo map"] > parts["ambient term"]
    assert parts["point light"] > parts["directional light"]


def test_parts_add_up_to_a_program(family, parts):
    compiled = fragment.cycles([(program, fragment.STUB) for program in WHOLE], family)
    estimates = [fragment.estimate(program, parts) for program in WHOLE]
    assert estimates == pytest.approx(compiled, rel=0.03)


@pytest.mark.parametrize(
    ("model", "lobe"), [("cook-torrance", "exact"), ("cook-torrance", "fitted"), ("ward", "d16")]
)
def test_parts_with_a_term_add_up_to_a_program(family, model, lobe):
    brdf = Shading(model, lobe).glsl(0.2)
    compiled = fragment.cycles([(program, brdf) for program in WHOLE], family)
    parts = fragment.by_compiler(family, brdf)
    estimates = [fragment.estimate(program, parts) for program in WHOLE]
    assert estimates == pytest.approx(compiled, rel=0.02)


@pytest.mark.parametrize("model", ["cook-torrance", "ward"])
def test_a_term_adds_to_the_parts(family, parts, model: Model):
    name = "exact, m >= 0.2"
    term = amd.statistics({name: terms(model)[name]}, family)[name].inverse_throughput
    brdf = Shading(model).glsl(0.2)
    one, three = (Program(directional_lights=n, directional_specular=n) for n in (1, 3))
    compiled = fragment.cycles([(one, brdf), (three, brdf)], family)
    assert fragment.estimate(one, parts) + term == pytest.approx(compiled[0], rel=0.05)
    # The terms of a fragment share what depends on the normal, the eye and m alone.
    assert compiled[1] < fragment.estimate(three, parts) + 3 * term < 1.2 * compiled[1]


def test_programs_tell_the_parts_apart():
    matrix = np.array([list(program.parts.values()) for program in PROGRAMS])
    assert abs(np.linalg.det(matrix)) == pytest.approx(1.0)


def test_parts_are_timed(egl):
    done: list[float] = []
    measured = fragment.by_slope(egl, repeats=2, progress=done.append)
    assert tuple(measured) == PARTS
    assert done == [0.5, 1.0]
    for each in measured.values():
        assert all(map(math.isfinite, (each.low, each.value, each.high)))
    whole = {name: each.value for name, each in measured.items()}
    full = Program(**FULL, directional_lights=3, directional_specular=3)
    assert fragment.estimate(full, whole) > fragment.estimate(Program(), whole) > 0.0


def test_bad_input_is_named(family):
    with pytest.raises(InputError, match="unknown family 'tesla'; known: navi21, vega10"):
        fragment.by_compiler("tesla")
    with pytest.raises(InputError, match="^ERROR: .*nonsense"):
        fragment.by_compiler(family, "#define SPECULAR_BRDF(n, l, v, m, f0) nonsense(m)\n")


def test_command_prints_what_can_be_measured(monkeypatch, capsys, egl):
    monkeypatch.setattr(amd, "ICD_FOLDERS", ())
    monkeypatch.setattr(fragment, "by_slope", lambda: fragment_times)
    fragment_times = {name: fragment.Interval(2.5, 2.0, 3.0) for name in PARTS}
    fragment.main()
    printed = capsys.readouterr().out
    assert "here, ns\n  base program                2.50\n" in printed
    assert printed.count("not measured: ") == len(amd.FAMILIES)
