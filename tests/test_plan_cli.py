"""Tests ``facerender plan``, ``facerender render --budget``, and the cache of plans."""

from __future__ import annotations

import inspect
import json
import math
import re
import shutil

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands.scene import parse_sizes
from facerender.planning import plan as plan_cache
from facerender.planning.budget import Budget
from facerender.planning.plan import plan as make_plan
from facerender.scene.detail import Planned
from facerender.scene.job import load_scene
from facerender.scene.shading import Shading
from tests.awkward_files import MINI_HEAD
from tests.verification.lights import PLAIN

# Without shadows, plans have fewer candidates.
KEY = "key,radius=0,no-shadow"
SMALL = ("--size", "48", "--samples", "1", "--light", KEY)
FACE = (MINI_HEAD, *SMALL)


PLANS: dict[bytes, fr.Plan] = {}

pytestmark = pytest.mark.usefixtures("measured_gain")


def plan_once(*arguments, **options):
    """Plan, or return the earlier plan for the same arguments."""
    bound = inspect.signature(make_plan).bind(*arguments, **options)
    bound.apply_defaults()
    given = bound.arguments
    own = {
        "cameras": tuple(given["cameras"] or [given["scene"].camera]),
        "sizes": tuple(given["sizes"] or [given["renderer"].size]),
        "progress": None,
    }
    facts = tuple((given | own).items())
    key = b"".join(plan_cache._pieces(facts))
    if key not in PLANS:
        PLANS[key] = make_plan(*arguments, **options)
    return PLANS[key]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("FACERENDER_CACHE_MIB")
    return tmp_path / "cache" / "facerender" / "plans"


@pytest.fixture
def cli(cli, egl, cache, monkeypatch):
    monkeypatch.setattr("facerender.planning.plan.plan", plan_once)
    monkeypatch.setattr("facerender.commands.plan._SILENT", math.inf)
    monkeypatch.setattr(plan_cache, "plan", plan_once)
    return cli


@pytest.fixture
def plan(cli):
    """A function that runs ``facerender plan`` and returns its output; it checks for warnings.

    The prices are from the table by default.
    """

    def plan(*options, mesh=FACE):
        status, out, err = cli.run("plan", *mesh, "--cost", "auto", *options)
        assert (status, err) == (0, "")
        return out

    return plan


def expected(budget, camera=fr.Camera(), mesh=None, cost="auto", **options):
    scene = fr.Scene(mesh or fr.load_mesh(MINI_HEAD), camera, (PLAIN["key"],))
    with fr.Renderer((48, 48), samples=1) as renderer:
        return plan_once(scene, budget, cost=cost, renderer=renderer, **options)


@pytest.fixture
def framed(egl):
    """The plan that ``facerender render`` makes."""
    return expected("2/255", cost="frame")


@pytest.fixture
def planned(monkeypatch, framed, cli):
    """The list of budgets for which a plan was made; every plan is ``framed``."""
    seen = []

    def spy(scene, budget, **options):
        seen.append(budget)
        return framed

    monkeypatch.setattr(plan_cache, "plan", spy)
    return seen


# --- plan ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_text_output(plan):
    out = plan("--budget", "1/255")
    assert out == expected("1/255").explain() + "\n"
    error, cost = out.splitlines()[-2:]
    assert re.search(r"^error +budget met: all pixels within 0\.\d+/255; .* \(\d+, \d+\); ", error)
    assert re.search(r"^cost +[\d.]+ of [\d.]+ .* a fragment, ratio [01]\.\d\d; ", cost)


@pytest.mark.slow
def test_json(plan):
    found = json.loads(plan("--budget", "0.5%", "--json", "--cost", "vega10"))
    assert found == json.loads(json.dumps(expected("0.5%", cost="vega10").as_dict()))
    assert found["budget"] == {"limit": 0.005, "unit": "relative", "exposure": 0.0, "within": 1.0}
    assert "GCN5 (vega10)" in found["cost"]["source"]


@pytest.mark.first_case
@pytest.mark.parametrize("target", [None, "330", "es300", "vulkan"])
def test_emit(target, plan, cli):
    """tests/test_plan.py compiles the shaders."""
    path, image = cli.folder / "lean.glsl", cli.folder / "error.png"
    words = ("--budget", "2/255", "--emit", path, "--error-map", image)
    plan(*words, *(["--target", target] if target else []))
    found = expected("2/255")
    assert path.read_text("ascii") == found.shader(target)
    with Image.open(image) as file:
        assert found.budget.text(found.error.maximum) in file.info["Comment"]
    assert cli.written == ["error.png", "lean.glsl"]


@pytest.mark.slow
@pytest.mark.parametrize("budget", ["1/255", "40/255", "0"])
def test_pinned_scene_renders_with_its_shading(budget, plan, cli):
    pinned = cli.folder / "pinned.toml"
    options = ("--m", "0.25", "--camera", "20,10,1.1", "--ambient", "0.2", "--background", "none")
    found = json.loads(plan("--budget", budget, "--save-scene", pinned, "--json", *options))
    shading = Shading.from_dict(found["shading"])
    with fr.Renderer((48, 48), samples=1) as renderer:
        camera = fr.Camera(20.0, 10.0, zoom=1.1)
        mesh = fr.load_mesh(MINI_HEAD).with_material(m=0.25)
        scene = fr.Scene(mesh, camera, (PLAIN["key"],), ambient=0.2, background=None)
        image = renderer.render(scene, shading).srgb8()
    np.testing.assert_array_equal(cli.render("--scene", pinned, "--samples", "1"), image)
    assert pinned.read_text().startswith("# Give mesh and maps again: ")
    plan("--budget", "3/255", "--save-scene", pinned)
    assert load_scene(pinned)["shading"] == expected("3/255").shading.as_dict()


@pytest.mark.slow
def test_pinned_scene_warns_at_other_sizes_and_samples(plan, cli):
    pinned = cli.folder / "pinned.toml"
    arguments = (MINI_HEAD, "--light", KEY, "--size", "24..32", "--samples", "4")
    plan("--budget", "2/255", "--save-scene", pinned, mesh=arguments)
    assert load_scene(pinned)["planned"] == Planned(((24, 24), (32, 32)), 4)
    render = ("render", MINI_HEAD, "-o", cli.png, "--scene", pinned)
    for options in (
        *(("--size", "24"), ("--size", "32"), ("--size", "30"), ("--size", "30x30")),
        ("--size", "32", "--samples", "1"),  # plans also hold with one sample
    ):
        status, _, err = cli.run(*render, *options)
        assert (status, "warning" in err) == (0, False), (options, err)
    for options, image in (
        (("--size", "33"), "33 x 33 with 4"),
        (("--size", "24x32"), "24 x 32 with 4"),
        (("--size", "32", "--samples", "2"), "32 x 32 with 2"),
    ):
        status, _, err = cli.run(*render, *options)
        assert (status, err.count("\n")) == (0, 1)
        assert f"{pinned} was planned for 24 x 24 to 32 x 32 pixels with 4 samples" in err
        assert f": at {image} samples its error is unknown; plan for this size" in err
    (warning,) = cli.describe("--scene", pinned, "--size", "64")["warnings"]
    assert "was planned for" in warning
    pinned.write_text("[planned]\nsizes = [[8, 8]]\nsamples = 1\n")
    planned_anew = cli.describe("--scene", pinned, "--budget", "2/255", *SMALL[2:])
    assert not planned_anew["warnings"]


@pytest.mark.slow
def test_from_a_scene_file(plan, cli, tmp_path):
    (tmp_path / "scene.toml").write_text(
        f"lights = ['{KEY}']\n[camera]\nazimuth = 35\n[material]\nm = 0.2\n"
        "[shading]\nfresnel = 'dielectric'\n"
    )
    arguments = (MINI_HEAD, *SMALL[:4], "--scene", tmp_path / "scene.toml")
    out = plan("--budget", "2/255", mesh=arguments)
    mesh = fr.load_mesh(MINI_HEAD).with_material(m=0.2)
    full = Shading(fresnel="dielectric")
    assert out == expected("2/255", fr.Camera(35.0), mesh, full=full).explain() + "\n"
    out = plan("--budget", "2/255", "--fresnel", "constant", "--camera", "front", mesh=arguments)
    full = Shading(fresnel="constant")
    assert out == expected("2/255", mesh=mesh, full=full).explain() + "\n"


@pytest.mark.slow
def test_a_message_announces_long_plans_where_no_bar_is_shown(cli, framed, monkeypatch):
    def slow(*_, progress, **options):
        for step in ("views", "prices"):
            progress(step, 0.0)
        return framed

    monkeypatch.setattr("facerender.planning.plan.plan", slow)
    monkeypatch.setattr("facerender.commands.plan._SILENT", -1.0)
    words = ("plan", *FACE, "--budget", "2/255")
    message = "facerender: planning may take minutes, fewer with --light key and fewer --parts\n"
    assert cli.run(*words) == (0, framed.explain() + "\n", message)
    assert cli.run(*words, "--quiet")[2] == ""
    assert message not in cli.run(*words, "--verbose")[2]
    monkeypatch.setattr("facerender.commands.plan._SILENT", 60.0)
    assert cli.run(*words)[2] == ""


@pytest.mark.slow
def test_cameras(plan, tmp_path):
    """tests/test_plan.py checks that plans fit all cameras."""
    path = tmp_path / "path.toml"
    path.write_text("[[cameras]]\nazimuth = 5\n[[cameras]]\nazimuth = 60\nelevation = 10\n")
    found = json.loads(plan("--budget", "30/255", "--json", "--camera", path))
    cameras = [fr.Camera(5.0), fr.Camera(60.0, 10.0)]
    assert [fr.Camera(**each) for each in found["cameras"]] == cameras
    assert " 2 cameras, 48 x 48 pixels" in found["text"]


def test_size(plan):
    found = json.loads(plan("--budget", "30/255", "--json", mesh=(*FACE, "--size", "40x32")))
    assert found["sizes"] == [[40, 32]]


@pytest.mark.parametrize(
    ("text", "sizes"),
    [
        ("512", [(512, 512)]),
        ("512..1024", [(512, 512), (724, 724), (1024, 1024)]),
        ("640x480..960x720", [(640, 480), (784, 588), (960, 720)]),
        ("8x8..8x64", [(8, 8), (8, 11), (8, 16), (8, 23), (8, 32), (8, 45), (8, 64)]),
        ("100..101", [(100, 100), (101, 101)]),
        ("512..512", [(512, 512)]),
    ],
)
def test_range_of_sizes(text, sizes):
    assert parse_sizes(text) == sizes


@pytest.mark.slow
def test_plan_fits_all_sizes_of_a_range(plan):
    arguments = (MINI_HEAD, *SMALL[2:], "--size", "24..48")
    out = plan("--budget", "1/255", mesh=arguments)
    assert out == expected("1/255", sizes=[(24, 24), (34, 34), (48, 48)]).explain() + "\n"
    assert " 1 camera, 24 x 24, 34 x 34, 48 x 48 pixels; no guarantee for other cam" in out


@pytest.mark.slow
def test_within_a_fraction_of_the_pixels(plan):
    out = plan("--budget", "1/255", "--within", "95%")
    assert out == expected("1/255", within=0.95).explain() + "\n"
    assert " 1/255 for 95 % of the pixels, of which rounding may use" in out.splitlines()[0]


def test_exposure_counts(plan):
    normal, bright = (
        json.loads(plan("--budget", "2/255", "--json", "--exposure", stops)) for stops in "04"
    )
    assert normal["error"] != bright["error"]


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--budget", "1/255", "--emit", "x", "--target", "cuda"), r"invalid choice: 'cuda'"),
        (("--budget", "1/255", "--size", "512.."), r"size '': give N or WxH"),
        (("--budget", "1/255", "--size", "8..16..32"), r"size '16\.\.32': give N or WxH"),
        (("--budget", "1/255", "--size", "24x48..48x24"), r"give the smaller size first"),
        (("--budget", "1/255", "--size", "0..4"), r"size 0 x 0: give 1 to 16384 pixels a side"),
        (("--budget", "1/255", "--lobe", "d8"), r"unrecognized arguments: --lobe d8"),
    ],
)
def test_bad_option(options, message, cli):
    cli.fail(message, "plan", *FACE, *options)


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras = []", r"scene\.toml: cameras = \[\]: give a list of names or tables"),
        ("[[cameras]]\nroll = 3", r"scene\.toml: unknown key 'roll' in cameras"),
        ("[shading]\nspecular_lights = [9]", r"specular_lights names light 9: the scene has 3"),
    ],
)
def test_bad_scene_file(text, message, cli, tmp_path):
    (tmp_path / "scene.toml").write_text(text)
    options = ("--budget", "1/255", "--scene", tmp_path / "scene.toml", "--size", "48")
    cli.fail(message, "plan", MINI_HEAD, *options)


@pytest.mark.parametrize("option", ["--emit", "--save-scene", "--error-map"])
def test_invalid_output_paths_are_refused(option, cli):
    place = cli.folder / "missing" / "out.png"
    others = {"--emit": "a.glsl", "--save-scene": "b.toml", "--error-map": "c.png"}
    del others[option]
    written = [word for name, file in others.items() for word in (name, cli.folder / file)]
    options = ("--budget", "1/255", *written, option, place)
    cli.fail(r"cannot write .*; give a file in a writable folder", "plan", *FACE, *options)
    cli.fail(
        r"cannot write .*; give a file", "plan", *FACE, "--budget", "1/255", option, cli.folder
    )


def test_outputs_must_differ_from_each_other_and_from_inputs(cli, tmp_path):
    image = tmp_path / "rough.png"
    Image.new("L", (4, 4), 90).save(image)
    before = image.read_bytes()
    for message, *options in (
        ("is written twice", "--emit", tmp_path / "a.txt", "--save-scene", tmp_path / "a.txt"),
        ("is both input and output", "--roughness-map", image, "--error-map", image),
    ):
        cli.fail(message, "plan", *FACE, "--budget", "1/255", *options)
    assert image.read_bytes() == before
    cli.fail(r"give a \.png", "plan", *FACE, "--budget", "1/255", "--error-map", tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("line", "options"),
    [
        ("m = 0.3", ("--m", "0.4")),
        ("m = 0.3", ("--roughness-map", "a.png")),
        ("ks = 0.3", ("--ks", "0.4")),
        ("ambient = false", ("--ambient", "0.4")),
        ("normal_map = false", ("--normal-map", "a.png")),
        ("specular_lights = [0]", ("--light", "rim")),
    ],
)
def test_options_that_conflict_with_a_pinned_shading(line, options, cli, tmp_path):
    scene = tmp_path / "pinned.toml"
    scene.write_text(f"[shading]\n{line}\n")
    message = rf"pins {line.split()[0]} = .* of the shading: leave {options[0]} out, or remove "
    cli.fail_to_render(message, "--scene", scene, *options)


@pytest.mark.first_case
@pytest.mark.parametrize("shading", ["", "m = 0.3043"])
def test_a_planned_scene_accepts_only_the_m_of_its_plan(shading, cli, tmp_path):
    """The plan's shading may have a constant m; this makes no difference."""
    scene = tmp_path / "planned.toml"
    scene.write_text(
        f"[material]\nm = 0.3\n[shading]\n{shading}\n[planned]\nsizes = [[48, 48]]\nsamples = 1\n"
    )
    once, again = (cli.render("--scene", scene, "--samples", "1", *m) for m in ((), ("--m", "0.3")))
    np.testing.assert_array_equal(once, again)
    message = r"was planned for m = 0\.3: leave --m out, or plan again with --m 0\.4"
    cli.fail_to_render(message, "--scene", scene, "--m", "0.4")


@pytest.mark.slow
def test_pinned_scene_can_be_planned_again(plan, cli):
    path = cli.folder / "again.toml"
    path.write_text(f"lights = ['{KEY}']\n[shading]\nspecular_lights = [0]\n")
    again = plan("--budget", "4/255", "--scene", path, mesh=(MINI_HEAD, *SMALL[:4]))
    assert "cost" in again


@pytest.mark.parametrize(
    "options",
    [
        ("--budget", "1/255", "--lobe", "d8"),
        ("--budget", "1/255", "--only", "specular"),
        ("--size", "24..48", "--budget", "1/255"),
    ],
)
def test_render_with_a_bad_budget(options, cli, cache):
    cli.fail_to_render(r"budget|a plan chooses the lobe|size '24\.\.48'", *options)
    assert not cache.exists()


# --- render --budget -----------------------------------------------------------------------------


def untimed(facts):
    """Return a plan's facts without measured times."""
    facts = json.loads(json.dumps(facts))
    entry = {key: value for key, value in facts.items() if key not in ("text", "cost")}
    decisions = [each | {"saving": 0.0, "text": ""} for each in facts["decisions"]]
    return entry | {"decisions": decisions}


def test_render_within_a_budget(cli, framed):
    status, out, err = cli.run("render", *FACE, "-o", cli.png, "--budget", "2/255", "--samples", 1)
    assert (status, out) == (0, f"{cli.png}\n")
    error, cost = err.splitlines()
    assert error in framed.explain().splitlines()
    assert re.fullmatch(r"cost +0.40 to 0.62 of the full frame .* ms a frame, drawn in .*", cost)
    with fr.Renderer((48, 48), samples=1) as renderer:
        image = renderer.render(framed.detail.of(framed.scene), framed.shading)
        full = renderer.render(framed.scene)
    np.testing.assert_array_equal(np.asarray(Image.open(cli.png)), image.srgb8())
    difference = Budget(1.0).errors(
        image.linear[..., :3].astype(float), full.linear[..., :3].astype(float)
    )
    assert 0.0 < difference.max() <= 2 / 255
    assert cli.written == ["head.png"]


@pytest.mark.slow
@pytest.mark.parametrize(("budget", "within"), [("2/255", ()), ("1/255", ("--within", "95%"))])
def test_render_within_a_budget_as_json(budget, within, cli):
    """The budget applies to every pixel or to a fraction of the pixels."""
    options = ("--light", KEY, "--budget", budget, "--samples", "1", *within)
    facts = cli.describe(*options)
    made = expected(budget, cost="frame", within=0.95 if within else 1.0)
    assert untimed(facts["plan"]) == untimed(made.as_dict())
    assert facts["lobe"] == str(Shading.from_dict(facts["plan"]["shading"]).term.lobe)
    assert "plan" not in cli.describe("--light", KEY)


def shoot(cli, *options, mesh=MINI_HEAD):
    """Render within a budget; return the image and the standard error."""
    arguments = ["--size", "48", "--light", KEY, "--samples", 1, "--budget", "2/255", *options]
    status, _, err = cli.run("render", mesh, "-o", cli.png, *arguments)
    assert status == 0, err
    with Image.open(cli.png) as image:
        return np.asarray(image), err


def test_plans_are_cached(cli, planned, framed, cache):
    first, printed = shoot(cli)
    again, printed_again = shoot(cli)
    assert planned == ["2/255"]
    assert printed == printed_again
    np.testing.assert_array_equal(first, again)
    assert len(list(cache.iterdir())) == 1
    with fr.Renderer((48, 48), samples=1) as renderer:
        image = renderer.render(framed.detail.of(framed.scene), framed.shading).srgb8()
    np.testing.assert_array_equal(again, image)


@pytest.mark.slow
def test_changed_input_causes_a_new_plan(cli, planned, tmp_path):
    shoot(cli)
    shoot(cli, mesh=shutil.copy(MINI_HEAD, tmp_path / "other.glb"))
    # The name of the mesh may be part of the key.
    assert planned in (["2/255"], ["2/255"] * 2)
    for number, level in enumerate((40, 90)):
        Image.new("L", (4, 4), level).save(tmp_path / f"rough{number}.png")
        Image.new("RGB", (4, 4), (level, 60, 60)).save(tmp_path / f"albedo{number}.png")
    for options in (
        *(("--budget", "3/255"), ("--budget", "2%"), ("--exposure", "1"), ("--size", "40")),
        *(("--within", "99.9%"), ("--samples", "2"), ("--full-maps",)),
        *(("--m", "0.2"), ("--ks", "0.5"), ("--kd", "0.5"), ("--ambient", "0.1")),
        *(("--light", "front"), ("--light", "rim"), ("--camera", "10"), ("--fov", "30")),
        *(("--fresnel", "dielectric"), ("--masking", "kelemen"), ("--model", "ward")),
        *(("--anisotropy", "2"), ("--float-albedo",), ("--flip-v",)),
        *((name, tmp_path / f"{file}{number}.png") for number in (0, 1)
          for name, file in (("--roughness-map", "rough"), ("--albedo", "albedo"))),
    ):  # fmt: skip
        planned.clear()
        shoot(cli, *options)
        assert len(planned) == 1, options


def test_irrelevant_options_reuse_the_plan(cli, planned):
    shoot(cli)
    shoot(cli, "--json")
    shoot(cli, "--within", "100%")
    assert len(planned) == 1


@pytest.mark.first_case
@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"3", b"{}"),
        b'{"shading": {"lobe": "d5"}, "text": "x"}',
        b'{"shading": {"gloss": 3}, "text": "x"}',
    ],
)
def test_damaged_cache_entry_is_replaced(content, cli, planned, cache):
    image, printed = shoot(cli)
    (entry,) = cache.iterdir()
    good = entry.read_bytes()
    entry.write_bytes(content)
    again, printed_again = shoot(cli)
    assert len(planned) == 2
    assert printed == printed_again
    np.testing.assert_array_equal(image, again)
    assert entry.read_bytes() == good


def test_default_cache_folder_is_in_the_home_folder(cli, planned, tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    shoot(cli)
    assert len(list((tmp_path / "home/.cache/facerender/plans").iterdir())) == 1


def test_plan_command_does_not_use_the_cache(plan, cache):
    plan("--budget", "2/255")
    assert not cache.exists()
