"""What the parts of the host's fragment program cost is positive, in order, and adds up."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.prices import amd
from benchmarks.prices.__main__ import print_parts
from benchmarks.prices.table import cycles
from benchmarks.prices.table import parts as compiled_parts
from facerender.errors import InputError, NotMeasured
from facerender.pricing import fragment
from facerender.pricing.fragment import PARTS, parts_of, program_of, samples, scene_with
from facerender.pricing.interval import Interval
from facerender.pricing.variants import INPUTS, of_model
from facerender.scenes.material import PROPERTY_MAPS
from facerender.shading import Shading
from tests.conftest import missing

MAPS = ("albedo_map", "normal_map", *PROPERTY_MAPS)
WHOLE = (  # scenes, and whether their lights are specular
    (scene_with(directional=3), False),
    (scene_with(directional=3), True),
    (scene_with(MAPS, True, directional=3), True),
    (scene_with(MAPS, True, directional=2, point=1), True),
    (scene_with(MAPS, True, point=3), True),
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
    return compiled_parts(family)


def test_every_part_costs_something(parts):
    assert tuple(parts) == PARTS
    free = {name for name, cost in parts.items() if cost <= 0.0}
    assert free <= {"ambient term"}  # an addend of what the lights multiply and add anyway
    assert min(parts.values()) >= 0.0
    assert parts["normal map"] > parts["albedo map"] > parts["ambient term"]
    assert parts["point light"] > parts["directional light"]


def test_parts_add_up_to_a_program(family, parts):
    programs = [program_of(scene, stub=INPUTS if lit else "") for scene, lit in WHOLE]
    estimates = [fragment.estimate(program, parts) for program in programs]
    assert estimates == pytest.approx(cycles(programs, family), rel=0.03)


@pytest.mark.parametrize(
    ("model", "lobe"), [("cook-torrance", "exact"), ("cook-torrance", "fitted"), ("ward", "d16")]
)
def test_parts_with_a_term_add_up_to_a_program(family, model, lobe):
    shading = Shading(model, lobe)
    programs = [program_of(scene, shading if specular else None) for scene, specular in WHOLE]
    parts = compiled_parts(family, shading)
    estimates = [fragment.estimate(program, parts) for program in programs]
    assert estimates == pytest.approx(cycles(programs, family), rel=0.02)


@pytest.mark.parametrize("model", ["cook-torrance", "ward"])
def test_a_term_adds_to_the_parts(family, parts, model):
    (plain,) = (variant for variant in of_model(model) if variant.plain)
    term = amd.statistics({"term": plain.term}, family)["term"].inverse_throughput
    scenes = [scene_with(directional=n) for n in (1, 3)]
    compiled = cycles([program_of(each, Shading(model)) for each in scenes], family)
    one, three = (program_of(scene, stub=INPUTS) for scene in scenes)
    assert fragment.estimate(one, parts) + term == pytest.approx(compiled[0], rel=0.05)
    # The terms of a fragment share what depends on the normal, the eye and m alone.
    assert compiled[1] < fragment.estimate(three, parts) + 3 * term < 1.2 * compiled[1]


def test_programs_tell_the_parts_apart():
    matrix = np.array([list(parts_of(program).values()) for _, program in samples()])
    assert abs(np.linalg.det(matrix)) == pytest.approx(fragment.FEW)


def test_parts_are_timed(egl):
    done: list[float] = []
    measured = fragment.by_slope(egl, repeats=2, progress=done.append)
    assert tuple(measured) == PARTS
    assert done == [0.5, 1.0]
    for each in measured.values():
        assert all(map(math.isfinite, (each.low, each.value, each.high)))
    whole = {name: each.value for name, each in measured.items()}
    full = program_of(scene_with(MAPS, True, directional=3), stub=INPUTS)
    assert fragment.estimate(full, whole) > fragment.estimate(program_of(scene_with()), whole) > 0.0


def test_bad_input_is_named(family):
    with pytest.raises(InputError, match="unknown family 'tesla'; known: navi21, vega10"):
        compiled_parts("tesla")
    with pytest.raises(InputError, match="^ERROR: .*nonsense"):
        cycles([program_of(scene_with(), stub="nonsense(m)")], family)


def test_command_prints_what_can_be_measured(monkeypatch, capsys, egl):
    monkeypatch.setattr(amd, "ICD_FOLDERS", ())
    monkeypatch.setattr(fragment, "by_slope", lambda: fragment_times)
    fragment_times = {name: Interval(2.5, 2.0, 3.0) for name in PARTS}
    print_parts()
    printed = capsys.readouterr().out
    assert "here, ns\n  base program                2.50\n" in printed
    assert printed.count("not measured: ") == len(amd.FAMILIES)
