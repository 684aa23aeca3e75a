"""Tests prices (``facerender.pricing``): the table, sums of its parts, and comparisons with RADV's
compiler and this machine."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import facerender as fr
from benchmarks.prices import amd
from benchmarks.prices import table as written
from benchmarks.prices.__main__ import main
from benchmarks.prices.table import all_seconds, all_terms, compiled, cycles
from benchmarks.prices.table import parts as compiled_parts
from facerender.errors import InputError, NotMeasured
from facerender.glsl.library import term_macros
from facerender.lobes import GPower
from facerender.material import PROPERTY_MAPS
from facerender.pricing import cost
from facerender.pricing import cost as scatter
from facerender.pricing import table as prices
from facerender.pricing.cost import INPUTS, Interval
from facerender.pricing.table import (
    PARTS,
    Prices,
    load_prices,
    parts_of,
    program_of,
    samples,
    scene_with,
    variants,
)
from facerender.scene.shading import Shading
from tests.conftest import missing
from tests.meshes import with_geometry
from tests.verification.lights import PLAIN

COMPILER = pytest.mark.compiler
KEY = (PLAIN["key"],)
PRICED = {part for part in (*prices.PARTS, *scatter.PARTS) if "specular" not in part}
POINT = fr.Light(irradiance=3.0, position=(0.2, 0.3, 0.5), shadow=False)
MAPS = ("albedo_map", "normal_map", *PROPERTY_MAPS)
WHOLE = (  # scenes, and whether their lights have specular terms
    (scene_with(directional=3), False),
    (scene_with(directional=3), True),
    (scene_with(MAPS, True, directional=3), True),
    (scene_with(MAPS, True, directional=2, point=1), True),
    (scene_with(MAPS, True, point=3), True),
)


@pytest.fixture(scope="module")
def bare(head):
    """The head without its normal map."""
    return head.with_material(normal_map=None)


def test_price_is_the_sum_of_its_parts(head, bare):
    names = ("base program", "albedo map", "normal map", "property map", "ambient term")
    names += ("directional light", "point light")
    parts = {name: 10.0**power for power, name in enumerate(names)}
    terms = {
        "cook-torrance exact schlick v-cavity plain": (1e7, 1e8),
        "cook-torrance exact schlick v-cavity plain constant": (2e7, 2e8),
        "cook-torrance exact constant none plain": (4e7, 4e8),
        "ward d8": (3e7, 3e8),
    }
    table = Prices("by hand", "beans", parts, terms)
    scene = fr.Scene(head, lights=(*KEY, POINT, PLAIN["rim"]))
    one = 1.0 + 10.0 + 100.0 + 1e3 + 1e4 + 2e5 + 1e6
    for shading, total, specular in (
        (Shading(), one + 2.1e8, 2.1e8),
        (Shading(specular_lights=(1,)), one + 1e7, 1e7),
        (Shading(specular_lights=(0, 1)), one + 1.1e8, 1.1e8),
        (Shading(fresnel="constant", masking="none"), one + 8.4e8, 8.4e8),
        # The property map is still read for occlusion.
        (Shading(m=0.3), one + 4.2e8, 4.2e8),
        (Shading(m=0.3, ambient=False), one - 1e4 - 1e3 + 4.2e8, 4.2e8),
        (Shading("ward", "d8", normal_map=False), one - 100.0 + 6.3e8, 6.3e8),
        (Shading(ks=0.0), one, 0.0),
        (Shading(specular_lights=()), one, 0.0),
        (Shading(specular_lights=(), ambient=False), one - 1e4 - 1e3, 0.0),
    ):
        assert table.cost(scene, shading) == pytest.approx((total, specular), rel=1e-12)
    plain = fr.Scene(bare.with_material(m=0.3, albedo_map=None, occlusion_map=None), lights=KEY)
    assert table.cost(plain, Shading())[0] == pytest.approx(1.0 + 1e4 + 1e5 + 1e7, rel=1e-12)


def test_price_of_parts_is_weighted_by_their_faces(head):
    (part,) = head.parts
    few = replace(part, faces=part.faces[:100])
    dull = replace(head.materials[0], ks=0.0)
    mesh = with_geometry(head, parts=(part, few), materials=(head.materials[0], dull))
    table = load_prices("navi21", fr.Scene(mesh), [])
    shining, matt = (
        table.cost(fr.Scene(replace(head, materials=(each,))), Shading())
        for each in (head.materials[0], dull)
    )
    share = 100 / (100 + len(part.faces))
    expected = (1 - share) * np.array(shining) + share * np.array(matt)
    assert table.cost(fr.Scene(mesh), Shading()) == pytest.approx(expected, rel=1e-12)


def test_table_equals_the_output_of_the_command(monkeypatch, tmp_path):
    text = prices.TABLE.read_bytes()
    table = json.loads(text)
    assert set(table) == {*amd.FAMILIES, "llvmpipe"}
    for rows in table.values():
        assert set(rows) == {"source", "unit", "parts", "terms"}
        assert set(rows["parts"]) == PRICED
        assert min(rows["parts"].values()) >= 0.0  # 0: an fma adds constant ambient light
        assert set(rows["terms"]) == {*all_terms(), *all_seconds()}
        # The second lobe of the cosine power costs 0 in a further light on RDNA2.
        assert all(first > 0.0 <= further for first, further in rows["terms"].values())
        rows["terms"] = {name: tuple(both) for name, both in rows["terms"].items()}
    monkeypatch.setattr(written, "compiled", lambda family, *terms: Prices(**table[family]))
    monkeypatch.setattr(written, "measured", lambda terms, **options: Prices(**table["llvmpipe"]))
    monkeypatch.setattr(written, "TABLE", tmp_path / "prices.json")
    assert main(["table"]) == 0
    assert (tmp_path / "prices.json").read_bytes() == text


def test_auto_depends_on_the_driver(bare):
    scene = fr.Scene(bare)
    assert load_prices("auto", scene, [], software=True) == load_prices("llvmpipe", scene, [])
    assert load_prices("auto", scene, [], software=False) == load_prices("navi21", scene, [])


@pytest.fixture(
    scope="module", params=[pytest.param(each, marks=COMPILER) for each in amd.FAMILIES]
)
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


def compiled_for(family, shadings):
    """Compile the terms of shadings, and return their prices."""
    terms = [shading.term for shading in shadings]
    return compiled(family, {k: v for term in terms for k, v in variants(term).items()}, {})


def test_compiler_agrees_with_the_table(family, bare):
    scene = fr.Scene(bare.with_material(m=0.3), lights=(*KEY, PLAIN["rim"]))
    wanted = [
        Shading(),
        Shading(m=0.3, lobe=GPower(6, 0.2), masking="kelemen"),
        Shading("ward", "d8"),
        Shading(fresnel="dielectric", lobe="fitted"),
    ]
    table = load_prices(family, scene, wanted)
    same = table.source.startswith(amd.driver())  # other versions of Mesa differ
    here = compiled_for(family, wanted)
    for shading in wanted:
        cost = here.cost(scene, shading)
        assert all(0.0 <= each < np.inf for each in cost)
        assert not same or cost == pytest.approx(table.cost(scene, shading), rel=0.05)


def test_prices_of_lights_add_up_to_a_program(family, bare):
    mesh = bare.with_material(m=0.3, occlusion_map=None)
    scene = fr.Scene(mesh, lights=(PLAIN["rim"], *KEY, PLAIN["fill"]), ambient=0.0)
    factors = {"fresnel": "constant", "masking": "none"}
    wanted = [Shading(**each) for each in ({}, {"m": 0.3}, {"lobe": "d8"}, factors)]
    lit = prices.scene_with(directional=3)
    whole = cycles([prices.program_of(lit, shading) for shading in wanted], family)
    table = compiled_for(family, wanted)
    for shading, expected in zip(wanted, whole, strict=True):
        assert table.cost(scene, shading)[0] == pytest.approx(expected, rel=0.03), shading


@pytest.mark.slow
def test_prices_measured_on_this_machine(egl, bare, monkeypatch):
    monkeypatch.setattr(prices, "measured", partial(prices.measured, repeats=3))
    scene = fr.Scene(bare.with_material(m=0.3), lights=KEY)
    wanted = [Shading(), Shading("ward", "d8")]
    here = load_prices("here", scene, wanted)
    assert here.unit == "ns"
    assert here.source.startswith("measured on ")
    assert set(here.parts) == PRICED
    for shading in wanted:
        assert np.isfinite(here.cost(scene, shading)).all()  # may be negative on a busy machine


def test_measured_prices_include_the_shared_part(egl, bare, monkeypatch):
    """A term's price includes the shared part, which differs between first and further lights."""

    def times(names, first):
        return {name: Interval(i, i, i) for i, name in enumerate(names, first)}

    monkeypatch.setattr(prices, "by_slope", lambda **_: times(PARTS, 100))
    monkeypatch.setattr(cost, "by_slope", lambda terms, **_: times(terms, 1))
    monkeypatch.setattr(scatter, "by_frames", lambda repeats: dict.fromkeys(scatter.PARTS, 7.0))
    found = load_prices("here", fr.Scene(bare.with_material(m=0.3), lights=KEY), [Shading()])
    assert found.unit == "ns"
    assert found.source.startswith("measured on ")
    assert set(found.parts) == PRICED
    assert {found.parts[name] for name in scatter.PARTS} == {7.0}
    assert found.parts["base program"] == 100 + PARTS.index("base program")
    shared = [100 + PARTS.index(f"{light} specular term") for light in ("first", "further")]
    assert len(found.terms) > 1
    for i, prices_of_term in enumerate(found.terms.values(), 1):
        assert prices_of_term == (shared[0] + i, shared[1] + i)


def test_requested_terms_are_priced_as_they_are_compiled(monkeypatch, bare):
    """Terms for small slopes, and terms that a decision would restore, are priced separately."""
    asked = {}

    def spy(wanted, seconds):
        asked.update(wanted)
        return load_prices("navi21", None, [])

    monkeypatch.setattr(prices, "measured", spy)
    scene = fr.Scene(bare.with_material(m=0.15))
    load_prices("here", scene, [Shading(), Shading(lobe="d16", m=0.3)])
    assert {name: "FR_SMALL_SLOPE" in term_macros(each, 0.3) for name, each in asked.items()} == {
        "cook-torrance exact schlick v-cavity": False,
        "cook-torrance exact schlick v-cavity plain": True,
        "cook-torrance d16 schlick v-cavity": False,
        "cook-torrance d16 schlick v-cavity constant": False,
    }


@pytest.mark.parametrize(
    ("shading", "error"),
    [
        (None, 0.03),  # a sum of its inputs replaces the term
        (Shading(), 0.02),
        (Shading(lobe="fitted"), 0.02),
        (Shading("ward", "d16"), 0.02),
    ],
)
def test_parts_add_up_to_a_program(family, parts, shading, error):
    stub = "" if shading else INPUTS
    programs = [
        program_of(scene, shading, stub) if lit else program_of(scene) for scene, lit in WHOLE
    ]
    costs = compiled_parts(family, shading) if shading else parts
    estimates = [
        sum(count * costs[name] for name, count in parts_of(program).items())
        for program in programs
    ]
    assert estimates == pytest.approx(cycles(programs, family), rel=error)


def test_programs_determine_all_parts():
    matrix = np.array([list(parts_of(program).values()) for _, program in samples()])
    assert abs(np.linalg.det(matrix)) == pytest.approx(prices.FEW)


def test_bad_input_is_named(family):
    with pytest.raises(InputError, match="unknown family 'tesla'; known: navi21, vega10"):
        compiled_parts("tesla")
    with pytest.raises(InputError, match="^ERROR: .*nonsense"):
        cycles([program_of(scene_with(), stub="nonsense(m)")], family)
