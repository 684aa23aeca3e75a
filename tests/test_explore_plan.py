"""The plan on the explorer's page: its decisions are switches, what the page draws of them is what
the renderer draws, and what they lose there is measured."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest

import facerender as fr
from facerender.commands import main, parser_of
from facerender.commands.scene import job_of
from facerender.explorer import explorer
from facerender.glsl.library import term_source
from facerender.job import Job, MeshFile
from facerender.lobes import GPower
from facerender.planning.candidates import DECISIONS, changed, values
from facerender.planning.decisions import Decision
from facerender.pricing.table import shipped
from facerender.scenes.light import LIGHTS
from tests.test_explore import MINI, follow, look, maps, opened, pictures, scene_of

SIZE = (360, 360)  # of the picture, where the page is this wide
VIEW = {"viewport": {"width": 360, "height": 900}}
UNDRAWN = Decision("samples", True, "1", "4", 0.002, 0.25, "1 instead of 4")


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Slopes are the same everywhere, which leaves few lobes to fit; two lights."""
    files = maps(tmp_path_factory.mktemp("maps"))
    del files["roughness_map"]
    return Job(MeshFile(str(MINI), **files), lights=(LIGHTS["key"], LIGHTS["fill"]))


@pytest.fixture(scope="module")
def mesh(job):
    return job.mesh.load()


@pytest.fixture(scope="module")
def planned(job, mesh, egl):
    with fr.Renderer(SIZE, backend=egl) as renderer:
        return fr.plan(job.scene(mesh), "7/255", cost="auto", renderer=renderer)


@pytest.fixture(scope="module")
def address(job, mesh, planned, tmp_path_factory):
    path = tmp_path_factory.mktemp("explorer") / "explorer.html"
    told = replace(planned, decisions=(*planned.decisions, UNDRAWN))
    path.write_text(explorer(job, mesh, told), encoding="utf-8")
    return path.as_uri()


@pytest.fixture(scope="module")
def page(browser, address):
    with opened(browser, address, **VIEW) as page:
        page.evaluate("explorer.errors()")
        assert tuple(page.evaluate("explorer.size")) == SIZE
        yield page


def switch(page, name):
    return page.locator("#decisions label", has=page.locator(f"b:text-is('{name}')"))


def losses(page):
    """What each decision loses on screen, by its name, as told."""
    page.click("#plan-measure")
    page.locator("#plan-measure:enabled").wait_for(timeout=60_000)
    return told_losses(page)


def told_losses(page):
    rows = page.locator("#decisions tr", has=page.locator("td"))
    return {
        row.locator("b").inner_text(): row.locator("td").last.inner_text()
        for row in rows.all()
        if row.locator("b").count()
    }


def test_decisions_have_what_the_shadings_differ_in(planned):
    taken = {
        path: value
        for each in planned.decisions
        if each.changed
        for path, value in each.values.items()
    }
    differs = changed(planned.shading, planned.full)
    assert len(differs) > 3
    assert values(planned.shading, differs).items() <= taken.items()
    for each in planned.decisions:
        assert each.values
        names = [name for name, path in DECISIONS.items() if path in each.values]
        had = planned.full if each.changed else planned.shading
        assert values(had, names) != each.values
    assert json.loads(json.dumps(planned.as_dict()))["decisions"][0]["values"]


def test_the_page_begins_with_the_plan(page, planned):
    shown = look(page)
    assert page.inner_text("#plan-told") == "A is the full shading, B is the plan."
    steps = shown["display"]["largest"]
    assert 0.0 < steps <= 255.0 * planned.budget.limit == page.evaluate("explorer.state.budget")
    assert steps == pytest.approx(255.0 * planned.error.drawn, rel=0.05)
    assert steps == pytest.approx(255.0 * planned.error.maximum, rel=0.05)
    assert page.evaluate("explorer.state.a.lobe") == "exact"
    for each in planned.decisions:
        assert switch(page, each.name).locator("input").is_checked() == each.changed
    text = page.inner_text("#plan")
    assert "not drawn here" in text
    assert switch(page, UNDRAWN.name).count() == 0
    for name in ("budget", "basis", "error", "cost"):
        assert planned.lines[name] in text


def test_switches_change_b_and_what_it_loses(page, planned):
    of_plan = look(page)["display"]
    first = next(each.name for each in planned.decisions if each.changed)
    switch(page, first).click()
    assert page.evaluate("explorer.errors()")["display"] != of_plan
    assert "of " in page.inner_text("#plan-told")
    kept = next(each.name for each in planned.decisions if not each.changed)
    switch(page, kept).locator("input").focus()
    page.keyboard.press("Space")
    worse = page.evaluate("explorer.errors()")["display"]["largest"]
    assert worse > 255.0 * planned.budget.limit
    page.get_by_label("f0 of A").fill("0.05")
    assert page.inner_text("#plan-told").startswith("A is not the full shading")
    page.click("#plan-reset")
    assert page.evaluate("explorer.errors()")["display"] == of_plan
    for each in planned.decisions:
        if each.changed:
            switch(page, each.name).click()
    assert page.evaluate("explorer.errors()")["display"]["largest"] == 0.0
    page.click("#plan-reset")


def test_what_each_loses_alone_is_measured(page, planned):
    look(page)
    assert set(told_losses(page).values()) == {"–"}
    places = """() => [...document.querySelectorAll("#plan *")]
        .map(each => each.offsetTop + " " + each.offsetHeight + " " + each.offsetLeft)"""
    before, picture = page.evaluate(places), pictures(page)[1]
    found = losses(page)
    assert found.pop(UNDRAWN.name) == "–"
    assert page.evaluate(places) == before
    np.testing.assert_array_equal(pictures(page)[1], picture)
    for each in planned.decisions:
        told = float(found[each.name].replace("< ", "").replace(",", ""))
        if each.changed and each.error > 1e-3:
            assert told == pytest.approx(255.0 * each.error, rel=0.05)
        for other in planned.decisions:
            switch(page, other.name).locator("input").set_checked(other is each)
        shown = page.evaluate("explorer.errors()")["display"]["largest"]
        assert told == pytest.approx(shown, rel=0.01, abs=1e-3)
    assert told_losses(page)[planned.decisions[0].name] == found[planned.decisions[0].name]
    page.get_by_text("profile", exact=True).click()
    assert set(told_losses(page).values()) == {"–"}


def test_a_link_has_what_is_switched_on(browser, page, address, planned):
    look(page)
    for each in planned.decisions[::2]:
        switch(page, each.name).click()
    page.get_by_label("budget in 1/255").fill("")
    shown = page.evaluate("explorer.errors()")
    with opened(browser, address, fragment=page.evaluate("location.hash"), **VIEW) as other:
        assert other.evaluate("explorer.errors()") == shown
        assert other.evaluate("explorer.state") == page.evaluate("explorer.state")
        for each in planned.decisions:
            assert switch(other, each.name).locator("input").is_checked() == (
                switch(page, each.name).locator("input").is_checked()
            )
        assert other.inner_text("#notes") == ""


FULL = (
    "model:cook-torrance;lobe:exact;fresnel:schlick;masking:v-cavity;constant:;weight:;normal:on;"
    "ambient:on;dark:;frontal:;small:exact"
)
OWN = GPower(4, 0.4, -0.3)
DRAWN = [
    ("normal:off;ambient:off", fr.Shading(normal_map=False, ambient=False)),
    ("dark:0", fr.Shading(specular_lights=[1])),
    ("frontal:1;masking:kelemen", fr.Shading(masking="kelemen", frontal_lights=[1])),
    ("dark:1;frontal:0", fr.Shading(specular_lights=[0], frontal_lights=[0])),
    ("constant:0.45;lobe:d8;weight:0.4", fr.Shading(lobe="d8", m=0.45, ks=0.4)),
    ("constant:0.35;lobe:g-power;g:4;factor:0.4;offset:-0.3", fr.Shading(lobe=OWN, m=0.35)),
    ("constant:0.15;small:plain;model:ward", fr.Shading("ward", m=0.15, small_slope=False)),
]  # fmt: skip


@pytest.mark.parametrize(("words", "shading"), DRAWN, ids=[each[0] for each in DRAWN])
def test_decisions_are_drawn_as_the_renderer_does(page, mesh, egl, words, shading):
    look(page, f"a={words}&b={FULL}")
    apart = np.subtract(*pictures(page))
    with fr.Renderer(SIZE, backend=egl) as renderer:
        scene = scene_of(page, mesh, {})
        frame, full = (renderer.render(scene, each).linear for each in (shading, fr.Shading()))
    assert np.abs(apart - (frame - full)).mean() < 0.05 * np.abs(frame - full).mean()


@pytest.mark.parametrize(("words", "shading"), DRAWN, ids=[each[0] for each in DRAWN])
def test_the_code_has_the_decisions(page, job, mesh, tmp_path, words, shading):
    follow(page, f"a={words}&camera=azimuth:-35")
    command, toml, python, flat = (
        page.evaluate("kind => explorer.code('a', kind)", kind)
        for kind in ("command", "toml", "python", "330")
    )
    assert flat == term_source(shading.term, mesh.materials[0].m, "330")
    file = tmp_path / "a.toml"
    file.write_text(toml)
    given = shlex.split(command.replace("\\\n", "").replace("a.toml", str(file)))[1:]
    options = parser_of(given).parse_args(given)
    said, _ = job_of(options, (8, 8))
    assert said.shading == shading
    assert said.camera.azimuth == -35.0
    assert said.mesh.normal_map == (None if "normal:off" in words else job.mesh.normal_map)
    assert said.mesh.specular_map == (None if "weight" in words else job.mesh.specular_map)
    assert [light.azimuth for light in said.lights] == [light.azimuth for light in job.lights]
    call = python.split("renderer.render(scene, ")[1].split("\n")[0].removesuffix(")")
    assert eval(call, {"fr": fr, "GPower": GPower}) == shading


@pytest.mark.parametrize(("words", "shading"), DRAWN, ids=[each[0] for each in DRAWN])
def test_decisions_are_priced_as_plans_do(page, mesh, words, shading):
    follow(page, f"a={words}&b={FULL}")
    scene = scene_of(page, mesh, {})
    for told, prices in zip(page.evaluate("explorer.prices()"), shipped().values(), strict=True):
        costs = [prices.cost(scene, each)[0] for each in (shading, fr.Shading())]
        assert [told["a"], told["b"]] == pytest.approx(costs, rel=1e-5)
        assert told["difference"] == pytest.approx(costs[1] - costs[0], abs=1e-4)


def test_lights_that_are_gone_are_not_named(page):
    look(page, "a=dark:0;frontal:1&lights=-50,42,3,3,3")
    python = page.evaluate("explorer.code('a', 'python')")
    assert "specular_lights=[]" in python
    assert "frontal_lights" not in python


def test_a_relative_budget_is_measured_as_one(browser, job, mesh, planned, tmp_path):
    budget = replace(planned.budget, unit="relative")
    path = tmp_path / "explorer.html"
    infinite = replace(UNDRAWN, error=float("inf"))
    told = replace(planned, budget=budget, decisions=(*planned.decisions, infinite))
    path.write_text(explorer(job, mesh, told), encoding="utf-8")
    with opened(browser, path.as_uri(), **VIEW) as page:
        page.evaluate("explorer.errors()")
        assert page.evaluate("explorer.state.budget") is None
        assert page.locator("#decisions thead .unit").all_inner_texts()[1:] == ["%", "%", "%"]
        found = losses(page)
        name = planned.decisions[0].name
        for each in planned.decisions:
            switch(page, each.name).locator("input").set_checked(each.name == name)
        shown = page.evaluate("explorer.errors()")["relative"]["largest"]
        assert float(found[name]) == pytest.approx(100.0 * shown, rel=0.01)
        assert "any" in page.locator("#decisions tr").last.inner_text()


def test_nothing_overflows(page):
    inside = """() => [...document.querySelectorAll("#decisions :is(th, td)")]
        .filter(cell => cell.scrollWidth > cell.clientWidth + 1).map(cell => cell.textContent)"""
    for width in (360, 768, 1280, 2560):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(inside) == []
    page.set_viewport_size(VIEW["viewport"])


def test_without_a_plan_there_is_no_section(browser, job, mesh, tmp_path):
    path = tmp_path / "explorer.html"
    path.write_text(explorer(job, mesh), encoding="utf-8")
    with opened(browser, path.as_uri(), fragment="#b=constant:0.3") as page:
        page.evaluate("explorer.errors()")
        assert page.locator("#plan, #decisions").count() == 0
        assert page.evaluate("explorer.state.b.lobe") == "d16"
        assert page.evaluate("explorer.state.budget") is None
        assert "B constant:0.3" in page.inner_text("#notes")


def test_the_command_plans(tmp_path, capsys, monkeypatch, egl):
    monkeypatch.setattr(fr.Renderer, "of", lambda job: fr.Renderer((128, 128), backend=egl))
    out = tmp_path / "page.html"
    assert main(["explore", str(MINI), "--plan", "1/255", "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{out}\n"
    assert printed.err == ""  # progress is for terminals
    facts = json.loads(out.read_text().split('id="facts">')[1].split("</script>")[0])
    assert facts["plan"]["lines"]["budget"].startswith("1/255")
    assert all(each["on"] for each in facts["plan"]["decisions"])


@pytest.mark.parametrize(
    ("budget", "words"),
    [("1", "has no unit"), ("-1/255", "negative"), ("a lot", "no unit that is known")],
)
def test_a_budget_that_is_none_is_refused(tmp_path, capsys, budget, words):
    out = tmp_path / "page.html"
    assert main(["explore", "missing.glb", f"--plan={budget}", "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("facerender: error: ")
    assert words in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("name", ["gone/page.html", "folder.html"])
def test_a_page_that_cannot_be_written_is_refused_before_planning(tmp_path, capsys, name):
    (tmp_path / "folder.html").mkdir()
    out = str(tmp_path / name)
    assert main(["explore", "missing.glb", "--plan", "1/255", "-o", out]) == 2
    assert f"cannot write {out}" in capsys.readouterr().err
