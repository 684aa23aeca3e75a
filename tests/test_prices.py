"""Prices: the table, what it adds up to, and what RADV and this machine say of it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from benchmarks.prices import amd
from benchmarks.prices import table as written
from benchmarks.prices.__main__ import main
from benchmarks.prices.table import all_seconds, all_terms, compiled, cycles
from facerender.drawing.resolve import Lighting, resolve
from facerender.errors import NotMeasured
from facerender.glsl.code import term_macros
from facerender.lobes import GPower
from facerender.planning.candidates import Constants, candidates
from facerender.pricing import fragment, scatter
from facerender.pricing import table as prices
from facerender.pricing.table import Prices, load_prices, variants
from facerender.scenes.light import LIGHTS
from facerender.shading import Shading
from tests.conftest import missing

KEY = (LIGHTS["key"],)
PARTS = {part for part in (*fragment.PARTS, *scatter.PARTS) if "specular" not in part}
POINT = fr.Light(irradiance=3.0, position=(0.2, 0.3, 0.5))


@pytest.fixture(scope="module")
def bare(head):
    """The head without its normal map."""
    return head.with_material(normal_map=None)


def test_every_candidate_has_a_price(head, bare):
    """In one table, and so in all: they list the same terms, see below."""
    for mesh in (bare, head.with_material(m=0.05), bare.with_material(m=0.9)):
        for full in (Shading(), Shading("ward-printed"), Shading(fresnel="dielectric")):
            scene = fr.Scene(mesh, lights=(*KEY, POINT))
            listed = list(candidates(scene, full, Constants(0.3, 1.0, (0, 1), (1, 0))))
            table = load_prices("navi21", scene, listed)
            for shading in listed:
                total, specular = table.cost(scene, shading)
                assert 0.0 <= specular < total < math.inf


def test_a_price_adds_up_by_hand(head, bare):
    parts = {
        "base program": 1.0,
        "albedo map": 10.0,
        "normal map": 100.0,
        "property map": 1e3,
        "ambient term": 1e4,
        "directional light": 1e5,
        "point light": 1e6,
    }
    terms = {
        "cook-torrance exact schlick v-cavity plain": (1e7, 1e8),
        "cook-torrance exact schlick v-cavity plain constant": (2e7, 2e8),
        "cook-torrance exact constant none plain": (4e7, 4e8),
        "ward d8": (3e7, 3e8),
    }
    table = Prices("by hand", "beans", parts, terms)
    scene = fr.Scene(head, lights=(*KEY, POINT, LIGHTS["rim"]))
    one = 1.0 + 10.0 + 100.0 + 1e3 + 1e4 + 2e5 + 1e6
    for shading, total, specular in (
        (Shading(), one + 2.1e8, 2.1e8),
        (Shading(specular_lights=(1,)), one + 1e7, 1e7),
        # one whole light and two frontal ones, whichever stands first
        (Shading(frontal_lights=(1, 2)), one + 8.1e8, 8.1e8),
        (Shading(frontal_lights=(0, 1)), one + 8.1e8, 8.1e8),
        (Shading(frontal_lights=(0, 1, 2)), one + 8.4e8, 8.4e8),
        (Shading(specular_lights=(0, 1), frontal_lights=(2, 0)), one + 4.1e8, 4.1e8),
        # of the property map the occlusion is left
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


def test_the_price_of_parts_is_weighted_by_their_faces(head):
    (part,) = head.parts
    few = replace(part, faces=part.faces[:100])
    dull = replace(head.materials[0], ks=0.0)
    mesh = replace(head, parts=(part, few), materials=(head.materials[0], dull))
    table = load_prices("navi21", fr.Scene(mesh), [])
    shining, matt = (
        table.cost(fr.Scene(replace(head, materials=(each,))), Shading())
        for each in (head.materials[0], dull)
    )
    share = 100 / (100 + len(part.faces))
    expected = (1 - share) * np.array(shining) + share * np.array(matt)
    assert table.cost(fr.Scene(mesh), Shading()) == pytest.approx(expected, rel=1e-12)


def test_the_table_is_what_the_command_writes(monkeypatch, tmp_path):
    text = prices.TABLE.read_bytes()
    table = json.loads(text)
    assert set(table) == {*amd.FAMILIES, "llvmpipe"}
    for rows in table.values():
        assert set(rows) == {"source", "unit", "parts", "terms"}
        assert set(rows["parts"]) == PARTS
        assert min(rows["parts"].values()) >= 0.0  # constant ambient light is an addend of an fma
        assert set(rows["terms"]) == {*all_terms(), *all_seconds()}
        # 0: the second lobe of the cosine power, in a further light on RDNA2
        assert all(first > 0.0 <= further for first, further in rows["terms"].values())
        rows["terms"] = {name: tuple(both) for name, both in rows["terms"].items()}
    monkeypatch.setattr(written, "compiled", lambda family, *terms: Prices(**table[family]))
    monkeypatch.setattr(written, "measured", lambda terms, **options: Prices(**table["llvmpipe"]))
    monkeypatch.setattr(written, "TABLE", tmp_path / "prices.json")
    assert main(["table"]) == 0
    assert (tmp_path / "prices.json").read_bytes() == text


def test_auto_is_of_who_draws(bare):
    scene = fr.Scene(bare)
    assert load_prices("auto", scene, [], software=True) == load_prices("llvmpipe", scene, [])
    assert load_prices("auto", scene, [], software=False) == load_prices("navi21", scene, [])


@pytest.fixture
def radv():
    try:
        amd.spirv(comp="#version 450\nvoid main() {}\n")
        return amd.driver()
    except NotMeasured as error:
        missing(str(error))


def compiled_for(scene, family, shadings):
    """Prices of the terms of some shadings, compiled here."""
    terms = [term for each in shadings for term in Lighting.of(scene, each).terms]
    return compiled(family, {k: v for term in terms for k, v in variants(term).items()}, {})


def test_the_compiler_agrees_with_the_table(radv, bare):
    scene = fr.Scene(bare.with_material(m=0.3), lights=(*KEY, LIGHTS["rim"]))
    wanted = [
        Shading(),
        Shading(m=0.3, lobe=GPower(6, 0.2), masking="kelemen"),
        Shading("ward", "d8"),
        Shading(fresnel="dielectric", lobe="fitted", frontal_lights=(1,)),
    ]
    table = load_prices("navi21", scene, wanted)
    same = table.source.startswith(radv)  # another Mesa's compiler counts otherwise
    here = compiled_for(scene, "navi21", wanted)
    for shading in wanted:
        cost = here.cost(scene, shading)
        assert all(0.0 <= each < np.inf for each in cost)
        assert not same or cost == pytest.approx(table.cost(scene, shading), rel=0.05)


@pytest.mark.parametrize("family", amd.FAMILIES)
def test_prices_of_frontal_lights_add_up_to_a_program(radv, family, bare):
    mesh = bare.with_material(m=0.3, occlusion_map=None)
    scene = fr.Scene(mesh, lights=(LIGHTS["rim"], *KEY, LIGHTS["fill"]), ambient=0.0)
    other = Shading(fresnel="dielectric", lobe="d8")
    wanted = [
        *(Shading(frontal_lights=frontal) for frontal in ((1,), (1, 2), (0, 1, 2))),
        *(each.replace(frontal_lights=(1, 2)) for each in (Shading(m=0.3), other)),
        other.replace(frontal_lights=(1,)),
    ]
    lit = fragment.scene_with(directional=3)
    whole = cycles([fragment.program_of(lit, shading) for shading in wanted], family)
    table = compiled_for(scene, family, wanted)
    for shading, expected in zip(wanted, whole, strict=True):
        assert table.cost(scene, shading)[0] == pytest.approx(expected, rel=0.03), shading


def test_prices_of_this_machine(egl, bare, monkeypatch):
    monkeypatch.setattr(prices, "measured", partial(prices.measured, repeats=3))
    scene = fr.Scene(bare.with_material(m=0.3), lights=KEY)
    wanted = [Shading(), Shading("ward", "d8")]
    here = load_prices("here", scene, wanted)
    assert here.unit == "ns"
    assert here.source.startswith("measured on ")
    assert set(here.parts) == PARTS
    for shading in wanted:
        assert np.isfinite(here.cost(scene, shading)).all()  # on a busy machine even negative


def test_measured_prices_serve_a_whole_plan(egl, bare, tmp_path, monkeypatch):
    """A constant in place of a map may have lobes in its domain that the map's slopes leave."""
    wanted_terms = []

    def priced(wanted, **_):
        wanted_terms.extend(wanted)
        table = load_prices("navi21", None, [])
        return replace(table, terms={name: table.terms[name] for name in wanted})

    monkeypatch.setattr(prices, "measured", priced)
    Image.fromarray(np.repeat(np.uint8([[20, 250]]), 4, axis=0)).save(tmp_path / "rough.png")
    rough = fr.Texture.open(tmp_path / "rough.png")
    scene = fr.Scene(bare.with_material(roughness_map=rough, ks=0.05), lights=KEY)
    assert resolve(scene, Shading()).slopes[0][1] > 0.9
    with fr.Renderer((32, 32), samples=1, backend=egl) as renderer:
        for budget in ("2/255", "10/255", "20/255", "40/255"):
            plan = fr.plan(scene, budget, renderer=renderer, cost="here")
            assert plan.cost.total <= plan.cost.full_total
    assert wanted_terms


def test_requested_terms_are_priced_as_they_are_compiled(monkeypatch, bare):
    """Small slopes as such, and what a decision is taken back to."""
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
