"""Tests materials with two lobes: values, the mask, domains, programs and prices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from benchmarks.prices import amd
from facerender import InputError, brdf
from facerender.drawing.prepare import resolve
from facerender.planning.candidates import Constants, candidates
from facerender.pricing.table import load_prices
from facerender.texture.texture import Texture
from tests.conftest import missing
from tests.test_reference import SWEAT, programs_of, ramp
from tests.verification.lights import PLAIN_THREE

SKIN = {"second_slope": 1.7, "lobe_weight": 0.85}


def grey(level: int) -> Texture:
    return Texture(lambda: Image.new("L", (4, 4), level), f"grey {level}")


@pytest.mark.first_case
@pytest.mark.parametrize("off", [{"second_slope": 0.5}, {"lobe_weight": 0.5}])
def test_unused_second_lobe_is_not_compiled(renderer, head, off):
    def programs(mesh):
        return programs_of(fr.Scene(mesh), fr.Shading())

    plain = programs(head)
    with pytest.warns(fr.FacerenderWarning, match=f"{next(iter(off))} has no effect on head.glb"):
        single, mapped = (head.with_material(**off, **own) for own in ({}, {"lobe_map": ramp()}))
    assert programs(mapped) == plain
    one, other = (fr.Scene(each) for each in (head, single))
    np.testing.assert_array_equal(renderer.render(one).linear, renderer.render(other).linear)
    assert renderer.gbuffer(one).second_m is None


def test_a_lobe_map_without_lobes_causes_a_warning(head):
    job = fr.Job(fr.MeshFile(lobe_map="sweat.png"))
    with pytest.warns(fr.FacerenderWarning, match="lobe_map has no effect on head.glb"):
        job.scene(head)
    replace(job, material=SWEAT).scene(head)


@pytest.mark.slow
def test_lobe_map_scales_the_second_lobe(renderer, head):
    def specular(**material):
        return renderer.render(fr.Scene(head.with_material(**material)), only="specular").linear

    whole, none = (specular(**SWEAT, lobe_map=grey(level)) for level in (255, 0))
    np.testing.assert_allclose(whole, specular(**SWEAT), atol=1e-5)
    np.testing.assert_allclose(none, specular(), atol=1e-5)
    half = specular(**SWEAT, lobe_map=grey(51))  # 0.2 of the second lobe's 0.7
    np.testing.assert_allclose(half, 0.8 * none + 0.2 * whole, atol=1e-4)


def test_both_slopes_must_be_in_the_domain(renderer, head):
    as_they_are = fr.Shading(lobe="d8", slope_filter=False)
    mesh = head.with_material(m=0.3, second_slope=3.0, lobe_weight=0.5)
    assert resolve(fr.Scene(mesh, lights=PLAIN_THREE), as_they_are).appearance.slopes[
        0
    ] == pytest.approx((0.3, 0.9))
    with pytest.raises(InputError, match=r"m = 0.9 is outside the domain of lobe d8"):
        renderer.render(fr.Scene(mesh, lights=PLAIN_THREE), as_they_are)
    frame = renderer.render(
        fr.Scene(mesh, lights=PLAIN_THREE), fr.Shading(lobe="d8", outside="exact")
    )
    assert frame.metadata["lobe of each part"].startswith("exact")
    sharp = head.with_material(second_slope=0.3, lobe_weight=0.5)
    low, high = resolve(fr.Scene(head, lights=PLAIN_THREE), as_they_are).appearance.slopes[0]
    assert resolve(fr.Scene(sharp, lights=PLAIN_THREE), as_they_are).appearance.slopes[
        0
    ] == pytest.approx((0.3 * low, high))


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (
            {"m": 0.5, "second_slope": 5.0, "lobe_weight": 0.5},
            r"m times second_slope = 2.5 is outside \[0.0001, 2\]",
        ),
        ({"lobe_map": "mask.png"}, r"lobe_map = 'mask.png': give facerender.Texture.open"),
    ],
)
def test_values_outside_their_domain(head, material, message):
    with pytest.raises(InputError, match=message):
        head.with_material(**material)


def test_two_lobes_are_a_weighted_sum():
    n = v = (0.0, 0.0, 1.0)
    l = np.array([(0.6, 0.0, 0.8), (0.1, -0.1, 0.98**0.5)])
    first, second = (brdf.cook_torrance(n, l, v, m, 0.028) for m in (0.3, 0.12))
    two = brdf.cook_torrance_two(n, l, v, 0.3, 0.12, (0.25, 1.0), 0.028)
    np.testing.assert_allclose(two, (0.25, 1.0) * first + (0.75, 0.0) * second, rtol=1e-15)
    with pytest.raises(InputError, match=r"weight = 1.5 is outside \[0, 1\]"):
        brdf.cook_torrance_two(n, l, v, 0.3, 0.12, 1.5, 0.028)


@pytest.mark.compiler
def test_cycles_on_rdna2():
    files = ("cook_torrance", "cook_torrance_two")
    prelude = "".join(f'#include "facerender/{name}.glsl"\n' for name in files)
    terms = {
        "one": (prelude, "fr_cook_torrance(n, l, v, m, f0)"),
        "two": (prelude, "fr_cook_torrance_two(n, l, v, m, n.x * m, l.x * v.x, f0)"),
    }
    try:
        cost = amd.statistics(terms, "navi21")
    except amd.NotMeasured as error:
        missing(str(error))
    assert cost["two"].inverse_throughput <= 1.3 * cost["one"].inverse_throughput


@pytest.mark.slow
def test_second_lobe_has_a_price(head):
    lights = fr.Scene(head).lights
    one, two = (fr.Scene(each, lights=lights) for each in (head, head.with_material(**SKIN)))
    constants = Constants(0.3, 1.0, (0, 1, 2), (0, 1, 2), (0.32,))
    some = [*candidates(two, fr.Shading(), constants)][::37]
    for kind in ("navi21", "vega10", "llvmpipe"):
        prices = load_prices(kind, two, [])
        for shading in some:
            dear, cheap = prices.cost(two, shading)[0], prices.cost(one, shading)[0]
            if shading.two_lobes and shading.specular_lights != ():
                assert dear > cheap
            else:
                assert dear == cheap
