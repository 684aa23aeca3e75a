"""Tests plans of whole frames: samples and triangles are reduced as far as the budget allows, the
images are within it, and savings add up. No test depends on a measured time."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from functools import cache, partial
from itertools import product

import numpy as np
import pytest

import facerender as fr
from benchmarks.data import ratio
from facerender.drawing.context import Context
from facerender.drawing.prepare import simplify
from facerender.images.image import linear_to_srgb
from facerender.planning import search
from facerender.planning.budget import Budget
from facerender.planning.candidates import Constants, DrawnViews, Viewpoint, changed
from facerender.planning.search import Choice, details
from facerender.pricing import cost as pricing
from facerender.pricing.cost import Interval, Line, relative
from facerender.scene.detail import LevelOfDetail, Planned
from facerender.scene.job import load_scene
from tests.awkward_files import MINI_HEAD
from tests.verification.lights import PLAIN

SIZES = [(48, 48), (64, 40)]
CAMERAS = (fr.Camera(20.0), fr.Camera(-40.0, 10.0))
KEY = "key,radius=0,no-shadow"
FACE = (MINI_HEAD, "--double-sided", "--size", "48", "--light", KEY, "--m", "0.3")
WIDE = "200/255"
GAIN = Interval(0.5, 0.4, 0.625)


@pytest.fixture(scope="module", autouse=True)
def one_repeat():
    """Measure frames only once, since no test depends on measured times, and limit the driver's
    multisampling to four samples, as ``four_samples`` does."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Context, "most_samples", 4)
        patched.setattr(search, "_REPEATS", 1)
        patched.setattr(search, "relative_time", lambda *_: GAIN)
        patched.setattr("facerender.commands.plan._SILENT", math.inf)
        yield


@pytest.fixture(scope="module")
def drawing(egl):
    """A renderer with 48 x 48 pixels and four samples per pixel."""
    with fr.Renderer((48, 48), samples=4, backend=egl) as renderer:
        yield renderer


@pytest.fixture(scope="module")
def scene():
    mesh = fr.load_mesh(MINI_HEAD, double_sided=True).with_material(m=0.3)
    return fr.Scene(mesh, lights=(PLAIN["key"],))


@pytest.fixture(scope="module")
def planned(drawing, scene):
    """A function that plans for a budget; it caches its results."""
    return cache(partial(fr.plan, scene, renderer=drawing))


@pytest.fixture(scope="module")
def wide(planned):
    return planned(WIDE)


def frame(renderer, scene, detail, shading=fr.Shading()):
    """Draw a frame with a level of detail by the public functions; return the linear image."""
    if detail.triangles is not None:
        scene = replace(scene, mesh=fr.simplified(scene.mesh, detail.triangles))
    if detail.cull_back_faces:
        scene = replace(scene, mesh=scene.mesh.with_material(double_sided=False))
    return renderer.render(scene, shading, **detail.values).linear


def error(renderer, scene, detail, shading=fr.Shading(), within=1.0):
    """Return two errors of the displayed image: at the quantile ``within`` of the covered pixels,
    and the largest."""
    images = frame(renderer, scene, LevelOfDetail(4, None)), frame(renderer, scene, detail, shading)
    full, own = (linear_to_srgb(each[..., :3].astype(np.float64)) for each in images)
    errors = np.sort(np.abs(own - full).max(axis=-1), axis=None)
    covered = np.count_nonzero(images[0][..., 3])
    return errors[-1 - (covered - math.ceil(within * covered))], errors[-1]


def lines_of(plan):
    return dict(re.split(" {2,}", line, maxsplit=1) for line in plan.explain().splitlines())


# --- the choice ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("budget", "within"), [("0", 1.0), ("0.01/255", 0.05)])
def test_a_budget_below_rounding_draws_the_full_frame(budget, within, drawing, scene, cli):
    plan = fr.plan(scene, budget, within=within, renderer=drawing)
    assert (plan.detail, plan.shading) == (LevelOfDetail(4, None), plan.full)
    assert plan.cost.relative == 1.0
    assert not any(each.changed for each in plan.decisions)
    np.testing.assert_array_equal(
        frame(drawing, scene, plan.detail, plan.shading), drawing.render(scene).linear
    )
    pinned = cli.folder / "full.toml"
    pinned.write_text(plan.scene_toml())
    assert "planned" not in load_scene(pinned)  # valid for any size
    np.testing.assert_array_equal(
        cli.render("--scene", pinned, "--m", "0.3"), drawing.render(scene).srgb8()
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("budget", "within"),
    [(WIDE, 1.0), ("60/255", 0.8), pytest.param("20/255", 0.6, marks=pytest.mark.slow)],
)
def test_drawn_error_is_within_a_wide_budget(budget, within, drawing, egl, scene):
    options = {"cameras": CAMERAS, "sizes": SIZES, "within": within, "renderer": drawing}
    plan = fr.plan(scene, budget, **options)
    assert plan.detail.samples == 1
    assert plan.detail.triangles < 6722
    errors = []
    for size, camera in product(SIZES, CAMERAS):
        with fr.Renderer(size, samples=4, backend=egl) as renderer:
            seen = replace(scene, camera=camera)
            errors.append(error(renderer, seen, plan.detail, plan.shading, within))
    at_share, worst = np.max(errors, axis=0)
    assert 0.0 < at_share <= plan.budget.limit
    assert (at_share < worst) == (within < 1.0)
    assert plan.error.drawn_within == pytest.approx(at_share, rel=1e-6)
    assert plan.error.drawn == pytest.approx(worst, rel=1e-6)
    assert plan.error_map.max() == pytest.approx(worst, rel=1e-6)


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("budget", "options"), [("4/255", {}), ("60/255", {}), ("10/255", {"within": 0.9})]
)
def test_coarser_frames_are_over_the_budget(budget, options, drawing, scene, planned):
    """Coarser frames have one sample, or half of the triangles, at least 500."""
    plan, within = planned(budget, **options), options.get("within", 1.0)
    unchanged = {each.name: each for each in plan.decisions if not each.changed}
    refused = []
    if plan.detail.samples > 1:
        refused.append(("samples", replace(plan.detail, samples=1, triangles=None)))
    half = (plan.detail.triangles or 6722) // 2
    if half >= 500:
        refused.append(("triangles", replace(plan.detail, triangles=half)))
    assert refused
    for name, detail in refused:
        at_share, _ = error(drawing, scene, detail, within=within)
        assert at_share > plan.budget.limit, detail
        if name in unchanged:
            assert unchanged[name].error == pytest.approx(at_share, rel=1e-6)
            assert unchanged[name].other == str(getattr(detail, name))
    at_share, _ = error(drawing, scene, plan.detail, within=within)
    assert at_share <= plan.budget.limit


@pytest.mark.slow
def test_fewest_samples_within_the_budget_are_chosen(egl, scene):
    """8 samples, the mean of shifted images, are reduced to 4 or 1."""
    with fr.Renderer((48, 48), samples=8, backend=egl) as renderer:
        for budget, samples in (("1/255", 8), ("100/255", 4), ("254/255", 1)):
            assert fr.plan(scene, budget, renderer=renderer).detail.samples == samples


@pytest.mark.slow
def test_per_pixel_shading_is_chosen_where_one_sample_fails(cli, drawing, scene):
    within = 0.95
    once = LevelOfDetail(4, None, shading_rate="pixel")
    errors = [
        error(drawing, scene, each, within=within)[0] for each in (once, LevelOfDetail(1, None))
    ]
    assert 0.0 < 1.5 * errors[0] < errors[1]
    arguments = {"within": within, "renderer": drawing}
    fine = fr.plan(scene, 0.9 * errors[0], **arguments)
    assert fine.detail.samples == 4
    assert fine.detail.shading_rate == "sample"
    (told,) = (each for each in fine.decisions if each.name == "shading_rate")
    refused, _ = error(
        drawing, scene, replace(once, cull_back_faces=fine.detail.cull_back_faces), within=within
    )
    assert told.text == f"sample: pixel would cause an error of {fine.budget.text(refused)}"

    plan = fr.plan(scene, 1.4 * errors[0], **arguments)
    assert (plan.detail.samples, plan.detail.shading_rate) == (4, "pixel")
    (told,) = (each for each in plan.decisions if each.name == "shading_rate")
    assert lines_of(plan)["shading_rate"] == told.text
    assert told.text.startswith(
        f"pixel instead of sample: error {plan.budget.text(errors[0])} on its own, "
    )
    at_share, _ = error(drawing, scene, plan.detail, plan.shading, within)
    assert at_share == pytest.approx(plan.error.drawn_within, rel=1e-6)
    assert errors[0] / 2.0 < at_share <= plan.budget.limit

    pinned = cli.folder / "once.toml"
    pinned.write_text(plan.scene_toml())
    assert load_scene(pinned)["planned"].detail == plan.detail
    image = cli.render("--scene", pinned)
    drawn = plan.detail.of(scene)
    for each in ("pixel", "sample"):
        own = drawing.render(drawn, plan.shading, shading_rate=each).srgb8()
        assert (own == image).all() == (each == "pixel")


def test_one_sample_stays_one(egl, scene):
    with fr.Renderer((48, 48), samples=1, backend=egl) as renderer:
        plan = fr.plan(scene, WIDE, renderer=renderer)
    assert plan.detail.samples == 1
    assert plan.detail.triangles < 6722
    assert "samples" not in lines_of(plan)
    assert plan.error.drawn <= plan.budget.limit


def test_without_meshoptimizer_triangles_stay(drawing, no_meshoptimizer, tmp_path):
    # This mesh has no simplified mesh yet.
    mesh = fr.load_mesh(MINI_HEAD, double_sided=True).with_material(m=0.3)
    scene = fr.Scene(mesh, lights=(PLAIN["key"],))
    plan = fr.plan(scene, WIDE, renderer=drawing)
    assert plan.detail == LevelOfDetail(1, None, cull_back_faces=True)
    assert "triangles" not in lines_of(plan)
    (tmp_path / "scene.toml").write_text(plan.scene_toml())
    planned = load_scene(tmp_path / "scene.toml")["planned"]
    assert planned == Planned(((48, 48),), 4, drawn_samples=1, cull_back_faces=True)
    assert not planned.covers((48, 48), 1)  # culling may change the surface at a pixel's centre


@pytest.mark.parametrize("cost", ["auto", "navi21"])
def test_fragment_prices_leave_samples_and_triangles(cost, drawing, scene):
    plan = fr.plan(scene, WIDE, cost=cost, renderer=drawing)
    assert plan.detail is None
    assert not {"samples", "triangles"} & set(lines_of(plan))
    assert "a fragment" in lines_of(plan)["cost"]
    assert "drawn_samples" not in plan.scene_toml()


# --- output --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_scene_file_draws_the_planned_frame(cli, drawing, scene, wide):
    pinned = cli.folder / "pinned.toml"
    status, out, err = cli.run("plan", *FACE, "--budget", WIDE, "--save-scene", pinned)
    assert (status, err) == (0, "")
    assert re.search(r"^samples +1 instead of 4: error .* of the frame time$", out, re.MULTILINE)
    assert re.search(r"^cost +0.40 to 0.62 of the full frame in 80 %", out, re.MULTILINE)
    found = load_scene(pinned)
    assert found["planned"] == Planned(
        ((48, 48),), 4, 1, wide.detail.triangles, cull_back_faces=True
    )
    assert fr.Shading.from_dict(found["shading"]) == wide.shading
    image = cli.render("--scene", pinned)
    drawn = drawing.render(wide.detail.of(scene), wide.shading, samples=1).srgb8()
    np.testing.assert_array_equal(image, drawn)
    for detail in (replace(wide.detail, samples=4), replace(wide.detail, triangles=None)):
        other = drawing.render(detail.of(scene), wide.shading, samples=detail.samples).srgb8()
        assert (other != drawn).any()


def test_plan_as_json(wide):
    found = json.loads(json.dumps(wide.as_dict(), allow_nan=False))
    assert LevelOfDetail(**found["detail"]) == wide.detail
    cost = found["cost"]
    assert (cost["unit"], cost["saves"]) == ("ms a frame", True)
    assert (cost["relative"], cost["interval"]) == (0.5, [0.4, 0.625])
    assert cost["total"] == pytest.approx(0.5 * cost["full_total"])


# --- cost ----------------------------------------------------------------------------------------


def test_a_line_of_costs():
    line = Line.through((10.0, 5.0), (5.0, 4.0))
    assert (line.fixed, line.slope) == pytest.approx((3.0, 0.2))
    assert line.cost(10.0, 2.0) == pytest.approx((5.0, 0.4))
    assert line.cost(5.0, 0.0) == pytest.approx((4.0, 0.0))
    flat = Line(5.0, 0.0)
    assert Line.through((10.0, 5.0), (5.0, 6.0)) == flat  # the lower price was slower
    assert Line.through((10.0, 5.0), (10.0, 4.0)) == flat  # equal prices
    assert Line.through((10.0, 5.0), (9.0, 4.0)) == Line(0.0, 0.5)  # steeper: from 0


@pytest.fixture
def coarse(drawing, scene):
    """The choice of a plan, and its drawn views with fewer samples and triangles."""
    full, budget = fr.Shading(), Budget.parse(WIDE)
    slim = simplify(scene, full)
    choice = Choice(slim, full, budget, Constants(0.3, 1.0, (0,), (0,)), "frame", software=True)
    drawn = DrawnViews([Viewpoint(scene, drawing)], full, budget)
    drawn.coarsen()
    return choice, drawn


def test_savings_and_remaining_cost_add_up(coarse):
    choice, drawn = coarse
    choice.frames = search.measured_frames(choice, drawn)
    told = list(details(choice, drawn))
    assert [each.name for each in told] == ["cull_back_faces", "samples", "triangles"]
    cost = choice.cost(choice.full)
    assert cost.full_total == pytest.approx(choice.frames.taken["full"])
    assert cost.total == pytest.approx(choice.frames.taken["triangles"])
    saved = sum(each.saving for each in told) * cost.full_total
    assert cost.total + saved == pytest.approx(cost.full_total)


@pytest.mark.parametrize("budget", ["4/255", "60/255", WIDE])
def test_samples_and_triangles_are_explained(budget, drawing, scene, planned):
    plan = planned(budget)
    lines, text = lines_of(plan), plan.budget.text
    for name, full in (("samples", 4), ("triangles", 6722)):
        (told,) = (each for each in plan.decisions if each.name == name)
        assert lines[name] == told.text
        own = getattr(plan.detail, name) or full
        alone = replace(
            LevelOfDetail(4, None), **{name: int(told.chosen if told.changed else told.other)}
        )
        added, _ = error(drawing, scene, alone)
        assert told.error == pytest.approx(added, rel=1e-6)
        assert told.changed == (own != full)
        if told.changed:
            verb = "saves" if told.saving >= 0.0 else "costs"
            share = f"{verb} {100.0 * abs(told.saving):.1f} % of the frame time"
            assert told.text == f"{own} instead of {full}: error {text(added)} on its own, {share}"
        else:
            assert told.text == f"{full}: {told.other} would cause an error of {text(added)}"
    *_, last, cost = lines
    assert (last, cost) == ("error", "cost")
    largest = max(plan.error.maximum, plan.error.drawn)
    assert lines["error"].startswith(f"budget met: all pixels within {text(largest)}; ")
    assert lines["error"].endswith(f"as rendered up to {text(plan.error.drawn)}")
    cost = "0.40 to 0.62 of the full frame in 80 % of rounds, median 0.50: "
    assert lines["cost"].startswith(cost)


@pytest.mark.slow
@pytest.mark.parametrize("high", [0.996, 1.0, 1.3])
def test_a_frame_without_a_measured_gain_becomes_the_full_frame(
    high, cli, drawing, scene, monkeypatch
):
    measured = Interval(0.9, 0.8, high)
    monkeypatch.setattr(search, "relative_time", lambda *_: measured)
    plan = fr.plan(scene, WIDE, renderer=drawing)
    assert (plan.shading, plan.detail) == (plan.full, LevelOfDetail(4, None))
    assert (plan.cost.relative, plan.cost.interval, plan.cost.saves) == (1.0, (1.0, 1.0), False)
    assert plan.cost.measured == measured
    assert (plan.error.drawn, plan.error.maximum, plan.elsewhere) == (0.0, 0.0, None)
    assert all(each.error > plan.budget.limit for each in plan.decisions)
    lines = lines_of(plan)
    assert "shading" not in lines  # a cheaper frame is within the budget
    assert {*lines} == {"budget", "basis", "error", "cost"} | {d.name for d in plan.decisions}
    told = "saves nothing, so the plan is the full frame: the cheaper frame took 0.80 to "
    assert lines["cost"].startswith(f"{told}{high:.2f} of its time. Repeat on an idle machine, or ")
    assert lines["error"] == "budget met: the full frame has no error"
    assert load_scene_text(cli, plan) == {}
    status, out, _ = cli.run("plan", *FACE, "--budget", WIDE, "--json")
    found = json.loads(out)
    assert (status, found["cost"]["relative"], found["cost"]["saves"]) == (0, 1.0, False)
    assert fr.Shading.from_dict(found["shading"]) == plan.full


def load_scene_text(cli, plan):
    """Return the table [planned] of a plan's scene file; empty for the full frame."""
    pinned = cli.folder / "pinned.toml"
    pinned.write_text(plan.scene_toml())
    return load_scene(pinned).get("planned", {})


def test_interval_of_the_cost_contains_most_rounds(monkeypatch):
    """A load that lasts for a third of the rounds widens the interval."""
    own = np.array([1.0] * 14 + [1.6] * 7)
    times = np.stack([own, np.full(21, 2.0)], axis=1)
    monkeypatch.setattr(pricing, "seconds", lambda draws, repeats, limit: times)
    found = relative(None, None, 21, 1.0)
    assert (found.low, found.value, found.high) == (0.5, 0.5, 0.8)


def test_a_time_limit_ends_the_rounds(monkeypatch):
    monkeypatch.setattr(pricing, "_FEWEST", 3)
    drawn = []
    times = pricing.seconds([lambda: drawn.append(0)], 9, limit=0.0)
    assert times.shape == (3, 1)
    assert len(drawn) == 1 + 3
    assert pricing.seconds([lambda: None], 5).shape == (5, 1)


def test_changes_that_hardly_save_time_are_undone(drawing, scene, measured_gain, monkeypatch):
    """Each of them costs error, and would leave its mark in the shader of the plan."""
    changes = {}
    for least in (0.0, 0.02, 9.0):
        monkeypatch.setattr(search, "_IDLE", least)
        plan = fr.plan(scene, "4/255", renderer=drawing)
        changes[least] = set(changed(plan.shading, plan.full))
    assert not changes[9.0]
    assert changes[0.02] < changes[0.0]


@pytest.mark.slow
def test_error_at_another_camera_is_an_example(drawing, scene, planned):
    plan = planned(WIDE)
    assert plan.elsewhere.camera == fr.Camera(45.0)
    turned = replace(scene, camera=plan.elsewhere.camera)
    at_share, worst = error(drawing, turned, plan.detail, plan.shading)
    assert (plan.elsewhere.maximum, plan.elsewhere.within) == pytest.approx((worst, at_share))
    told = f"{plan.budget.text(worst)} as rendered at azimuth 45: plan with all cameras"
    assert lines_of(plan)["elsewhere"].startswith(told)
    around = fr.plan(scene, WIDE, cameras=fr.turntable(), renderer=drawing)
    assert around.elsewhere.camera == fr.Camera(22.5)


def test_ratio_compares_frames_of_the_same_round(monkeypatch):
    """A machine that slows down between rounds does not change the ratio."""
    times = np.array([[1.0, 2.0], [1.0, 2.0], [10.0, 20.0], [10.0, 20.0]])
    monkeypatch.setattr("benchmarks.data.seconds", lambda draws, repeats: times)
    found = ratio(None, None, 4)
    assert (found.low, found.value, found.high) == (0.5, 0.5, 0.5)
