"""Tests ``facerender.plan``: it finds the cheapest shading within the budget, its texts are true,
and its files work. Brute force and the renderer provide the expected values."""

from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import asdict, replace
from itertools import product

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import lobes
from facerender.drawing import reference
from facerender.lobes import GPower
from facerender.planning import candidates as views
from facerender.planning import search
from facerender.planning.budget import ROUNDING, Budget
from facerender.planning.candidates import (
    DECISIONS,
    G_POWERS,
    TERM,
    Constants,
    candidates,
    changed,
    with_decisions,
)
from facerender.planning.search import _words
from facerender.pricing.table import load_prices
from facerender.scene.camera import turntable
from facerender.scene.detail import Planned
from facerender.scene.job import load_scene, scene_toml
from facerender.scene.shading import Shading
from tests.conftest import require_module, run
from tests.meshes import with_geometry
from tests.verification.lights import PLAIN, PLAIN_THREE
from tests.verification.subjects import Subject, brute_force

KEY = (PLAIN["key"],)
POINT = fr.Light(irradiance=3.0, position=(0.2, 0.3, 0.5), shadow=False)
COMPILER, SLOW = pytest.mark.compiler, pytest.mark.slow
CAMERAS = (fr.Camera(10.0, 5.0), fr.Camera(-30.0))  # from behind, hardly any candidate fits


@pytest.fixture(scope="module")
def small(egl):
    """A renderer with 32 x 32 pixels and one sample per pixel."""
    with fr.Renderer((32, 32), samples=1, backend=egl) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def head(coarse_head):
    return coarse_head


@pytest.fixture(scope="module")
def bare(head):
    """The head without its normal map, for half as many candidates."""
    return head.with_material(normal_map=None)


@pytest.fixture(scope="module")
def subject(bare):
    """A function that returns a named subject; without ambient light it has half the candidates."""
    varying = bare.with_material(specular_map=bare.materials[0].roughness_map)
    three = fr.Scene(bare).lights
    known = {
        "constant m": (bare.with_material(m=0.3), KEY, Shading()),
        "m and ks of maps": (varying, KEY, Shading()),
        "point light": (bare.with_material(m=0.2), (POINT,), Shading()),
        "two": (bare.with_material(m=0.3, ks=0.3), (PLAIN["rim"], *KEY), Shading()),
        "three": (bare.with_material(m=0.3, ks=0.3), three, Shading()),
        "two and a point": (bare, (PLAIN["rim"], POINT, *KEY), Shading(m=0.25)),
        "Ward": (bare.with_material(m=0.45), KEY, Shading("ward")),
        "as printed": (bare, KEY, Shading("ward-printed", m=0.3)),
        "dielectric": (bare.with_material(m=0.2), KEY, Shading(fresnel="dielectric")),
    }

    def make(name):
        mesh, lights, full = known[name]
        return Subject(name, fr.Scene(mesh, fr.Camera(-20.0), lights, ambient=0.0), full)

    return make


# --- the choice ----------------------------------------------------------------------------------


def planned(renderers, subject, budgets, kinds=("navi21",), cameras=(), within=1.0):
    """Plan for all budgets and prices, at the sizes of all renderers, and return the plans.

    Check that no candidate within the budget is cheaper.
    """
    first, *others = renderers
    sizes = [each.size for each in renderers] if others else None
    plans = [
        fr.plan(subject.scene, budget, full=subject.full, cameras=cameras or None, sizes=sizes,
                within=within, renderer=first, cost=kind)
        for budget, kind in product(budgets, kinds)
    ]  # fmt: skip
    every = list(candidates(subject.scene, subject.full, plans[0].constants))
    units = {Budget.parse(budget).unit: budget for budget in budgets}

    def brute(shadings, budget, share):
        of = [brute_force(each, subject, shadings, budget, cameras, share) for each in renderers]
        return dict(zip(shadings, map(max, *of) if others else of[0], strict=True))

    errors = {unit: brute(every, budget, within) for unit, budget in units.items()}
    for plan, (budget, kind) in zip(plans, product(budgets, kinds), strict=True):
        of, limit = errors[plan.budget.unit], plan.budget.limit - ROUNDING[plan.budget.unit]
        prices = load_prices(kind, subject.scene, [])
        fits = [each for each in every if of[each] <= limit]
        cheapest = min(prices.cost(subject.scene, each)[0] for each in fits)
        # With FLIP the search does not try all candidates.
        assert plan.cost.total == cheapest or plan.budget.unit == "flip", (budget, kind)
        assert of[plan.shading] <= limit
        assert subject.full.term.m in (None, plan.shading.term.m)  # given values stay
        assert plan.error.within == pytest.approx(of[plan.shading], rel=1e-9, abs=1e-12)
        worst = brute([plan.shading], budget, 1.0)[plan.shading]
        assert plan.error.maximum == pytest.approx(worst, rel=1e-9, abs=1e-12)
    return plans


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "budgets", "kinds"),
    [
        ("constant m", ("0.5/255", "4/255", "3%"), ["llvmpipe", "vega10"]),
        ("m and ks of maps", ("4/255",), ["navi21"]),
        ("point light", ("1/255", "3%"), ["vega10"]),
        ("two", ("0.5/255", "4/255"), ["navi21"]),
        pytest.param("three", ("0.5/255", "4/255"), ["navi21"], marks=SLOW),
        pytest.param("two and a point", ("1/255",), ["llvmpipe", "navi21"], marks=SLOW),
        ("Ward", ("1/255", "4/255"), ["navi21"]),
        ("as printed", ("1/255", "0.02 flip"), ["llvmpipe"]),
        ("dielectric", ("1/255", "3%"), ["navi21"]),
    ],
)
def test_no_fitting_candidate_is_cheaper(name, budgets, kinds, small, subject):
    if "flip" in budgets[-1]:
        require_module("flip_evaluator")
    plans = planned([small], subject(name), budgets, kinds)
    assert any(plan.shading != plan.full for plan in plans)  # otherwise nothing is tested


@pytest.mark.slow
def test_plans_fit_all_cameras(small, subject, monkeypatch):
    monkeypatch.setattr(search, "_SPREAD", 1)  # with few test pixels, many candidates remain
    monkeypatch.setattr(search, "_WORST", 1)
    planned([small], subject("constant m"), ["1/255"], cameras=turntable(count=3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "budgets", "within", "cameras"),
    [
        ("constant m", ("1/255", "3%"), 0.95, ()),
        ("m and ks of maps", ("1/255",), 0.9, ()),
        pytest.param("three", ("0.5/255", "2/255"), 0.98, (), marks=SLOW),
        ("point light", ("0.5/255", "2/255"), 0.9, CAMERAS),  # the fraction applies to each camera
        ("as printed", ("0.05 flip",), 0.6, ()),
    ],
)
def test_no_candidate_that_fits_a_fraction_of_pixels_is_cheaper(
    name, budgets, within, cameras, small, subject, monkeypatch
):
    if "flip" in budgets[-1]:
        require_module("flip_evaluator")
    monkeypatch.setattr(search, "_SPREAD", 8)  # most pixels are not test pixels
    monkeypatch.setattr(search, "_WORST", 4)
    plans = planned([small], subject(name), budgets, cameras=cameras, within=within)
    assert all(plan.error.within <= plan.budget.limit for plan in plans)
    assert any(plan.error.maximum > plan.budget.limit for plan in plans)  # otherwise all pixels fit


@pytest.mark.slow
def test_plans_fit_all_sizes(small, egl, subject):
    at = subject("point light")
    with fr.Renderer((24, 18), samples=1, backend=egl) as other:
        (plan,) = planned([small, other], at, ["0.55/255"])
        (share,) = planned([small, other], at, ["0.5/255"], cameras=CAMERAS, within=0.98)
        alone = [fr.plan(at.scene, "0.55/255", cost="navi21", renderer=each)
                 for each in (small, other)]  # fmt: skip
        drawing = {small.size: small, other.size: other}[share.error.size]
        camera = CAMERAS[share.error.camera]
        (worst,) = brute_force(drawing, at, [share.shading], cameras=[camera])
    assert share.error.maximum == pytest.approx(worst, rel=1e-9)
    assert plan.sizes == ((32, 32), (24, 18))
    assert share.sizes == plan.sizes
    assert "1 camera, 32 x 32, 24 x 18 pixels; no guarantee" in plan.explain()
    for found, camera in ((plan, ""), (share, f" of camera {share.error.camera}")):
        width, height = found.error.size
        assert found.error_map.shape == (height, width)
        x, y = found.error.pixel
        assert found.error_map[y, x] == found.error_map.max() == found.error.maximum
        assert f"at pixel ({x}, {y}){camera} of {width} x {height}; " in found.explain()
    assert plan.cost.total > min(each.cost.total for each in alone)  # both sizes matter


def test_every_term_is_a_candidate(bare):
    scene = fr.Scene(bare.with_material(m=0.15), lights=KEY)
    both = {"cook-torrance", "ward"}
    for full, models, fresnel in (
        (Shading(), both, {"schlick", "constant"}),
        (Shading(fresnel="dielectric"), both, {"schlick", "constant", "dielectric"}),
        (Shading(fresnel="constant"), both, {"constant"}),
        (Shading("ward-printed"), {"ward-printed"}, set()),
    ):
        found = list(candidates(scene, full, Constants(0.15, 1.0, (0,))))
        assert {each.term.model for each in found} == models
        used = {each.term.lobe for each in found}
        assert {each for each in used if isinstance(each, str)} == {*lobes.NAMES}
        assert {each.g for each in used if isinstance(each, GPower)} == {*G_POWERS}
        assert {each.term.small_slope for each in found} == {None, False}
        assert {each.term.m for each in found} == {None, 0.15}
        factors = {
            (c.term.fresnel, c.term.masking) for c in found if c.term.model == "cook-torrance"
        }
        assert factors == set(product(fresnel, ("v-cavity", "kelemen", "none")))


def test_unlit_pixels_do_not_matter(small, subject):
    scene = subject("constant m").scene
    scene = replace(scene, lights=(*KEY, fr.Light(irradiance=0.0)))
    plan = fr.plan(scene, "0.5/255", cost="auto", renderer=small)
    assert plan.shading.specular_lights == (0,)


@pytest.mark.first_case
@pytest.mark.parametrize("budget", ["0", "0 flip", "0.01/255", "1e-9%"])
def test_a_budget_below_rounding_gives_the_full_shading(budget, small, subject):
    if "flip" in str(budget):
        require_module("flip_evaluator")
    dielectric = subject("dielectric")
    plan = fr.plan(dielectric.scene, budget, full=dielectric.full, renderer=small)
    assert plan.shading == dielectric.full
    assert (plan.error.maximum, plan.error.percentile) == (0.0, 0.0)
    assert plan.cost.relative == 1.0
    assert re.search(r"^shading +exact: nothing cheaper fits$", plan.explain(), re.MULTILINE)


@pytest.mark.slow
def test_a_huge_budget_drops_every_highlight(small, subject):
    scene = replace(subject("three").scene, lights=PLAIN_THREE)
    cost = fr.plan(scene, "1e9%", cost="auto", renderer=small).cost
    assert cost.specular == 0.0
    assert cost.total <= cost.full_total - cost.full_specular * (1 - 1e-12)


@pytest.mark.slow
def test_smallest_error_breaks_ties_of_cost(small, bare):
    matt = fr.Scene(bare.with_material(ks=0.0), lights=PLAIN_THREE)
    plan = fr.plan(matt, "1e9%", cost="auto", renderer=small)
    assert plan.shading == Shading(ambient=False)


@pytest.mark.slow
def test_errors_in_multisampled_images_count(egl, subject, monkeypatch):
    """A change that is visible only between pixel centres is ruled out by the drawn image."""
    draw = views.draw

    def with_a_flaw(place, shading, detail):
        image = draw(place, shading, detail)
        image[10, 10] += 0.5 * (shading.term.fresnel == "constant")
        return image

    at = subject("constant m")
    with fr.Renderer((64, 64), samples=4, backend=egl) as renderer:
        sound = fr.plan(at.scene, "2/255", cost="navi21", renderer=renderer)
        monkeypatch.setattr(views, "draw", with_a_flaw)
        flawed = fr.plan(at.scene, "2/255", cost="navi21", renderer=renderer)
        images = [renderer.render(at.scene, each).linear[..., :3].astype(float)
                  for each in (sound.shading, sound.full)]  # fmt: skip
    assert sound.error.drawn == pytest.approx(Budget(1.0).errors(*images).max())
    assert 0.0 < sound.error.drawn <= 2 / 255
    assert "as rendered" in sound.explain()
    assert sound.shading.term.fresnel == "constant" != flawed.shading.term.fresnel
    assert sound.cost.total < flawed.cost.total
    assert flawed.tried < 10  # a term that failed once is not tried again


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("budget", "material", "lights", "exposure"),
    [
        ("0.5/255", {"m": 0.3}, KEY, 0.0),
        pytest.param(
            *("4/255", {"m": 0.3, "ks": 0.3}, (*KEY, PLAIN["rim"], POINT), 0.0), marks=SLOW
        ),
        ("3/255", {}, (*KEY, POINT), 1.0),
        ("2%", {"m": 0.12}, KEY, -1.0),
        pytest.param("30/255", {"m": 0.12}, (*KEY, POINT), 2.0, marks=SLOW),
    ],
)
def test_errors_agree_with_the_reference_and_the_renderer(
    budget, material, lights, exposure, small, head
):
    scene = fr.Scene(head.with_material(**material), lights=lights)
    options = {"cameras": CAMERAS, "exposure": exposure, "cost": "auto"}
    plan = fr.plan(scene, budget, renderer=small, **options)
    assert 0.0 < plan.error.maximum <= plan.budget.limit
    maps, covered = [], []
    for camera in CAMERAS:
        seen = replace(scene, camera=camera)
        drawn = [small.render(seen, each).linear for each in (plan.shading, plan.full)]
        covered.append(drawn[1][..., 3] > 0.0)
        errors = plan.budget.errors(*(each[..., :3].astype(float) for each in drawn))
        assert errors[covered[-1]].max() <= plan.budget.limit
        shaded = [
            reference.shade(small.gbuffer(seen, each), seen, each)
            for each in (plan.shading, plan.full)
        ]
        maps.append(np.where(covered[-1], plan.budget.errors(*shaded), 0.0))
    error = plan.error
    assert error.maximum == pytest.approx(np.max(maps), rel=1e-9)
    seen = np.array(maps)[np.array(covered)]
    assert error.percentile == pytest.approx(np.quantile(seen, 0.999), rel=1e-9)
    x, y = error.pixel
    assert maps[error.camera][y, x] == np.max(maps)
    np.testing.assert_allclose(plan.error_map, maps[error.camera], rtol=1e-9, atol=1e-12)
    assert (plan.cameras, plan.sizes, plan.samples) == (CAMERAS, ((32, 32),), 1)
    assert (plan.budget.exposure, error.size, error.within) == (exposure, (32, 32), error.maximum)


# --- invalid input -------------------------------------------------------------------------------


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"lights": ()}, {}, "the scene has no lights, so there is no shading to plan: add a "),
        ({}, {"full": Shading(lobe="d8")}, "a plan chooses the lobe: omit d8"),
        ({}, {"full": Shading(lobe=GPower(4, 0.3))}, r"omit g-power 4 \(0.3/m\^2\)"),
        ({}, {"cost": "voodoo"}, "unknown cost 'voodoo'; known: frame, auto, .* here"),
        ({}, {"cameras": ()}, "the cameras see nothing of head.glb"),
        (
            {"camera": fr.Camera(position=(0, 0, 5), target=(0, 0, 9))},
            {},
            "the cameras see nothing of head.glb",
        ),
        ({}, {"full": Shading(specular_lights=(0, 7))}, "specular_lights names light 7"),
        ({}, {"sizes": [(0, 8)]}, "size 0 x 8: give 1 to 16384 pixels a side"),
    ],
)
def test_invalid_plans_are_refused(changes, options, message, small, bare):
    settings = {"budget": "1/255", "renderer": small, **options}
    with pytest.raises(fr.InputError, match=message) as error:
        fr.plan(replace(fr.Scene(bare), **changes), settings.pop("budget"), **settings)
    assert "\n" not in str(error.value)


def test_cameras_that_see_nothing_are_ignored(small, subject):
    away = fr.Camera(position=(0.0, 0.0, 5.0), target=(0.0, 0.0, 9.0))
    scene = subject("constant m").scene
    both, one = (
        fr.plan(scene, "1/255", cameras=each, cost="auto", renderer=small)
        for each in ((away, fr.Camera()), (fr.Camera(),))
    )
    assert both.shading == one.shading
    assert both.error == replace(one.error, camera=1)


# --- texts and files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plans(small, head, bare, subject):
    """Plans with different shadings."""
    mesh = head.with_material(m=0.3)
    scenes = (
        (subject("two").scene, "0.5/255"),
        (fr.Scene(bare.with_material(m=0.3), lights=(*KEY, PLAIN["rim"])), "8/255"),
        (subject("constant m").scene, "0.5/255"),
        (fr.Scene(mesh, lights=KEY), "12/255"),
        (fr.Scene(bare.with_material(ks=0.3), lights=(PLAIN["rim"],)), "2/255"),  # constant m
        (fr.Scene(bare, lights=(POINT, *KEY)), "2/255"),
        (fr.Scene(bare, lights=KEY), "0"),
        (fr.Scene(mesh.with_material(ks=0.1), lights=KEY, ambient=0.0), "30%"),
    )
    found = [fr.plan(scene, budget, cost="auto", renderer=small) for scene, budget in scenes]
    assert len({plan.shading for plan in found}) > 6
    assert any(isinstance(plan.shading.term.lobe, GPower) for plan in found)
    assert any(plan.shading.term.model == "ward" for plan in found)
    assert any(plan.shading == plan.full for plan in found)
    return found


def test_default_lights_have_names(head):
    scene = fr.Scene(head)
    assert _words(scene, fr.Shading(), ["shadows"]) == "of key, rim, fill"
    lights = (fr.Light(1.0), replace(scene.lights[1], radius=0.0))
    assert _words(replace(scene, lights=lights), fr.Shading(), ["shadows"]) == "of light 0, rim"


@pytest.mark.slow
def test_every_decision_has_a_line(plans):
    for plan in plans:
        names = [each.name for each in plan.decisions]
        assert names == [name for name in DECISIONS if name in names]
        exact = ["shading"] * (plan.shading == plan.full)
        lines = dict(re.split(" {2,}", line, maxsplit=1) for line in plan.explain().splitlines())
        shown = names if plan.budget.limit > ROUNDING[plan.budget.unit] else []
        elsewhere = ["elsewhere"] * (plan.shading != plan.full)
        assert list(lines) == ["budget", "basis", *elsewhere, *shown, *exact, "error", "cost"]
        differs = changed(plan.shading, plan.full)
        implied = set(TERM[1:]) if "model" in differs else set()
        assert {each.name for each in plan.decisions if each.changed} == set(differs) - implied
        for each in plan.decisions:
            assert lines.get(each.name, each.text) == each.text
            assert each.text.startswith(each.chosen)
            assert each.other == "none" or each.other in each.text
            assert each.saving > 0.0 or each.changed
            verb, number = re.search(r"(saves?|costs) (\d+) %", each.text).groups()
            percent = -int(number) if verb == "costs" else int(number)
            whole = each.name in ("normal map", "ambient")
            part = plan.cost.full_total if whole else plan.cost.full_specular
            assert percent == round(100 * each.saving * plan.cost.full_total / part)
            assert plan.budget.text(each.error) in each.text


@pytest.mark.slow
def test_decisions_state_their_error_and_saving(plans, small):
    for plan in plans:
        prices = load_prices("auto", plan.scene, [], software=True)
        every = list(candidates(plan.scene, plan.full, plan.constants))
        unit = "1%" if plan.budget.unit == "relative" else "1/255"

        def cost(shading, of=prices, scene=plan.scene):
            return of.cost(scene, shading)[0]

        def errors(shadings, subject=Subject("", plan.scene), unit=unit):
            return brute_force(small, subject, shadings, unit)

        assert plan.cost.total == cost(plan.shading)
        for each in plan.decisions:
            names = TERM if each.name == "model" and each.changed else (each.name,)
            if each.changed:
                base = plan.full.replace(m=plan.shading.term.m) if "lobe" in names else plan.full
                expected = errors([with_decisions(base, plan.shading, names)])
                assert each.error == pytest.approx(expected[0], rel=1e-9, abs=1e-12)
                saved = cost(with_decisions(plan.shading, plan.full, names)) - plan.cost.total
                assert each.saving == pytest.approx(saved / plan.cost.full_total)
            else:  # every cheaper choice is over the budget; the error is the smallest of them
                others = [
                    other
                    for other in every
                    if changed(other, plan.shading) == [each.name] and cost(other) < plan.cost.total
                ]
                limit = plan.budget.limit - ROUNDING[plan.budget.unit]
                assert limit < each.error == pytest.approx(min(errors(others)), rel=1e-9)


def test_as_dict_can_be_json(plans):
    for plan in plans:
        found = json.loads(json.dumps(plan.as_dict(), allow_nan=False))
        assert Shading.from_dict(found["shading"]) == plan.shading
        assert found["text"] == plan.explain()
        assert found["budget"] == asdict(plan.budget)
        assert found["error"]["maximum"] == plan.error.maximum
        assert found["cost"]["relative"] == plan.cost.total / plan.cost.full_total
        assert [each["text"] for each in found["decisions"]] == [d.text for d in plan.decisions]
        assert [fr.Camera(**each) for each in found["cameras"]] == list(plan.cameras)
        assert 0 <= found["tried"] <= found["candidates"]


@pytest.mark.first_case
@pytest.mark.parametrize("target", ["330", "es300", pytest.param("vulkan", marks=COMPILER)])
def test_shaders_compile(target, plans, tmp_path):
    for number, plan in enumerate(plans):
        text = plan.shader(target)
        assert text.isascii()
        assert text.splitlines()[0].startswith("#version")
        assert [f"// {line}" for line in plan.explain().splitlines()] == [
            line for line in text.splitlines()[1:] if line.startswith("// ")
        ][: len(plan.explain().splitlines())]
        call = "fr_cook_torrance(n, n, n, 0.9, 0.028)"
        if plan.shading.term.model != "cook-torrance":
            call = f"fr_{plan.shading.term.model.replace('-', '_')}(n, n, n, 0.9)"
        if plan.shading.term.m is not None:
            assert f"#define FR_SLOPE(m) {plan.shading.term.m!r}\n" in text
        path = tmp_path / f"{number}.frag"
        main = f"void main() {{ vec3 n = vec3(0.0, 0.0, 1.0); result = vec4({call}); }}"
        output = "layout(location = 0) out" if target == "vulkan" else "out"
        path.write_text(f"{text}\n{output} vec4 result;\n{main}\n")
        options = ["-V", "-o", path.with_suffix(".spv")] if target == "vulkan" else []
        run(["glslangValidator", *options, path])


def test_shader_without_a_target_has_no_version(plans):
    text = plans[0].shader()
    assert "#version" not in text
    assert text.startswith("// budget ")
    assert text.isascii()
    with pytest.raises(fr.InputError, match="unknown target 'cuda'"):
        plans[0].shader("cuda")


def test_error_map(plans, tmp_path):
    path = tmp_path / "error.png"
    for plan in plans:
        plan.save_error_map(path)
        with Image.open(path) as image:
            pixels = np.asarray(image).astype(int)
            comment = image.info["Comment"]
        assert pixels.shape == (32, 32, 3)
        assert f"white is {plan.budget.text(plan.budget.limit)}" in comment
        assert plan.budget.text(plan.error.maximum) in comment
        x, y = plan.error.pixel
        brightness = pixels.sum(axis=-1)
        assert brightness[y, x] == brightness.max()
        assert not brightness[plan.error_map == 0.0].any()
        assert (np.diff(brightness.ravel()[np.argsort(plan.error_map, axis=None)]) >= -1).all()


def test_texts_have_the_error_of_the_fraction_and_the_worst(small, subject, tmp_path):
    scene, options = subject("constant m").scene, {"within": "95.1%", "cost": "navi21"}
    plan = fr.plan(scene, "1/255", renderer=small, **options)
    text, error = plan.budget.text, plan.error
    assert error.maximum > plan.budget.limit
    lines = dict(re.split(" {2,}", line, maxsplit=1) for line in plan.explain().splitlines())
    assert lines["budget"].startswith("1/255 for 95.1 % of the pixels, of which rounding ")
    assert f"95.1 % of the pixels within {text(error.within)}; " in lines["error"]
    assert f" up to {text(error.maximum)}, at pixel " in lines["error"]
    worse = replace(plan, error=replace(error, drawn=1.0, drawn_within=1.1 / 255))
    assert "  budget not met: 95.1 % of the pixels within 1.1/255; " in worse.explain()
    found = json.loads(json.dumps(plan.as_dict()))
    assert found["budget"]["within"] == 0.951
    assert (found["error"]["within"], found["error"]["maximum"]) == (error.within, error.maximum)
    plan.save_error_map(tmp_path / "error.png")
    with Image.open(tmp_path / "error.png") as image:
        green = (np.asarray(image) == (0, 255, 120)).all(axis=-1)
    np.testing.assert_array_equal(green, plan.error_map > plan.budget.limit)
    assert green.any()


# --- scene files ---------------------------------------------------------------------------------

FILES = {
    "everything": (
        fr.Camera(30.0, -10.0, 40.0, 1.5, (0.01, 0.0, 0.02)),
        (POINT, fr.Light(10.0, 20.0, (1.0, 0.5, 1e-5)), PLAIN["rim"]),
        {"ambient": (0.1, 0.0, 0.2), "background": None},
        Shading(
            lobe=GPower(6, 0.27425, -1.5e-5),
            fresnel="constant",
            masking="kelemen",
            m=0.25,
            ks=0.5,
            normal_map=False,
            ambient=False,
            specular_lights=(2, 0),
        ),
    ),
    "small slopes": (fr.Camera(), KEY, {"ambient": 0.0}, Shading("ward", small_slope=False)),
    "no highlight": (fr.Camera(), KEY, {}, Shading(specular_lights=(), outside="exact")),
    "named lobe": (fr.Camera(), KEY, {"background": (1, 0, 0.5)}, Shading(lobe="fitted-fine")),
}


@pytest.mark.parametrize("name", FILES)
def test_a_scene_file_gives_the_same_image(name, small, head, tmp_path):
    camera, lights, rest, shading = FILES[name]
    mesh = head.with_material(f0=0.04, kd=0.9)
    scene = fr.Scene(mesh, camera, lights, **rest)
    path = tmp_path / "scene.toml"
    path.write_text(scene_toml(scene, shading), encoding="utf-8")
    found = load_scene(path)
    again = Shading.from_dict(found.pop("shading"))
    assert again == shading
    material = found.pop("material")
    assert material["f0"] == 0.04
    assert material["roughness_factor"] == 1.0
    assert "m" not in material  # the head's roughness map replaces it
    other = fr.Scene(head.with_material(**material), **found)
    for field in dataclasses.fields(scene):
        if field.name != "mesh":
            assert getattr(other, field.name) == getattr(scene, field.name)
    np.testing.assert_array_equal(
        small.render(other, again).linear, small.render(scene, shading).linear
    )


def test_scene_file_of_a_plan(plans, tmp_path):
    for plan in plans:
        path = tmp_path / "scene.toml"
        path.write_text(plan.scene_toml(), encoding="utf-8")
        found = load_scene(path)
        assert Shading.from_dict(found["shading"]) == plan.shading
        assert found["lights"] == plan.scene.lights
        changes = plan.shading != plan.full  # the full shading fits any size
        assert found.get("planned") == (Planned(((32, 32),), 1) if changes else None)
        for line in plan.explain().splitlines():
            assert f"# {line}\n" in plan.scene_toml()


def test_scene_file_omits_factors_that_differ_between_parts(head, tmp_path):
    (part,) = head.parts
    mesh = with_geometry(head, parts=(part, part), materials=(
        replace(head.materials[0], ks=0.1), head.materials[0]))  # fmt: skip
    path = tmp_path / "scene.toml"
    path.write_text(scene_toml(fr.Scene(mesh), Shading()))
    material = load_scene(path)["material"]
    assert "ks" not in material
    assert material["f0"] == 0.028


def test_turntable():
    camera = fr.Camera(10.0, 20.0, 30.0, 2.0, (0.0, 0.1, 0.0))
    around = turntable(camera, 5)
    assert [each.azimuth for each in around] == pytest.approx([10.0, 82.0, 154.0, 226.0, 298.0])
    for each in around:
        assert each == replace(camera, azimuth=each.azimuth)
    assert turntable(fr.Camera(position=(1.0, 2.0, 3.0)), 1) == (fr.Camera(),)
    assert len(turntable()) == 8
