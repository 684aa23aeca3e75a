"""Tests the explorer page in Chromium: its images agree with the float64 reference, its errors with
``facerender compare``, and its controls, links and texts work."""

from __future__ import annotations

import base64
import io
import json
import re
import shlex
import shutil
import warnings
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.commands import main, parser_of
from facerender.commands.scene import job_of
from facerender.comparison.compare import compare
from facerender.drawing import reference
from facerender.drawing.frame import GBuffer
from facerender.errors import FacerenderWarning
from facerender.explorer.mesh import QUALITIES, drawable, encoded, octahedral
from facerender.explorer.page import explorer_page
from facerender.images.srgb import linear_to_srgb
from facerender.job import Job, MeshFile
from facerender.lobes import GPower, lobe
from facerender.planning.budget import Budget
from facerender.scenes.framing import region_of
from facerender.scenes.texture import Texture
from facerender.scenes.vectors import direction_to
from facerender.scenes.view import view_of
from facerender.shading import Term
from facerender.terms import FRESNEL, LOBES, MASKING, MODELS
from facerender.terms.lobe import Lobe
from tests.people import person
from tests.test_parts import row

MINI = Path(__file__).parent / "data" / "mini_head.glb"
VIEW = {"viewport": {"width": 1000, "height": 700}}
# Points on the face in the first view, in fractions of the image's width and height.
PLAIN = tuple(replace(light, shadow=False) for light in fr.Scene.lights)
PLACES = [
    *((0.50, 0.30), (0.45, 0.35), (0.55, 0.35), (0.50, 0.42), (0.42, 0.42), (0.58, 0.42)),
    *((0.50, 0.55), (0.44, 0.55), (0.56, 0.55), (0.50, 0.66), (0.47, 0.72), (0.53, 0.72)),
]
OWN = GPower(6, 0.3, 0.4)
FRONT = np.array([0.0, 0.0, 1.0])  # direction from the mesh to the point lights
TERMS = [
    ("", Term(), {}),
    ("lobe:d8;m:0.25;f0:0.05;ks:0.7", Term(lobe="d8"), {"m": 0.25, "f0": 0.05, "ks": 0.7}),
    ("lobe:fitted-fine;fresnel:dielectric;masking:kelemen",
     Term(lobe="fitted-fine", fresnel="dielectric", masking="kelemen"), {}),
    ("lobe:g-power;g:6;factor:0.3;offset:0.4;m:0.35", Term(lobe=OWN), {"m": 0.35}),
    ("model:ward;lobe:fitted;m:0.5", Term("ward", "fitted"), {"m": 0.5}),
    ("model:ward-printed;lobe:exact;m:0.15", Term("ward-printed"), {"m": 0.15}),
]  # fmt: skip


def maps(folder: Path) -> dict[str, str]:
    """Write smooth maps, which lose little as JPEGs: normals, roughness 0.45 to 0.65, weight."""
    y, x = np.mgrid[:64, :64] * (2.0 * np.pi / 64)
    slope = 0.25 * np.stack([np.sin(3 * x), np.cos(2 * y), np.full_like(x, 4.0)], axis=-1)
    normal = 0.5 + 0.5 * slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    grey = {"roughness_map": 0.55 + 0.1 * np.sin(x), "specular_map": 0.7 + 0.3 * np.cos(y)}
    files = {}
    for name, values in {"normal_map": normal, **grey}.items():
        files[name] = str(folder / f"{name}.png")
        Image.fromarray(np.uint8(np.round(255.0 * values))).save(files[name])
    return files


def write(folder: Path) -> tuple[str, MeshFile]:
    """Write a page; return its address and its mesh file."""
    mesh = MeshFile(str(MINI), **maps(folder))
    path = folder / "explorer.html"
    path.write_text(explorer_page(Job(mesh, lights=PLAIN), mesh.load()), encoding="utf-8")
    return path.as_uri(), mesh


@contextmanager
def opened(browser, address, before="", fragment="", **more):
    """Open the page; at the end, check that it logged nothing to the console."""
    page = browser.new_page(**{**VIEW, **more})
    logged = []
    page.on("console", lambda message: logged.append(message.text))
    page.on("pageerror", lambda error: logged.append(str(error)))
    if before:
        page.add_init_script(before)
    page.goto(address + fragment)
    yield page
    page.close()
    assert logged == []


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write(tmp_path_factory.mktemp("explorer"))


@pytest.fixture(scope="module")
def address(written):
    return written[0]


@pytest.fixture(scope="module")
def mesh(written):
    return written[1].load()


@pytest.fixture(scope="module")
def page(browser, address):
    """A page shared by all tests that set its state by a link."""
    with opened(browser, address) as page:
        page.evaluate("explorer.errors()")
        yield page


def look(page, fragment=""):
    """Follow a link, and return the errors of its images."""
    follow(page, fragment)
    return page.evaluate("explorer.errors()")


def follow(page, fragment):
    page.evaluate(  # in one call, since the page writes its own link when it is idle
        """link => {
            history.replaceState(null, "", "#");
            location.hash = link;
            dispatchEvent(new HashChangeEvent("hashchange"));
        }""",
        fragment,
    )
    return page.evaluate("explorer.errors()")


def images(page):
    """Return the float images A and B, (H, W, 4)."""
    width, height = page.evaluate("explorer.size")
    code = "async which => new Uint8Array((await explorer.pixels(which)).buffer).toBase64()"
    each = [base64.b64decode(page.evaluate(code, which)) for which in "ab"]
    return [np.frombuffer(data, np.float32).reshape(height, width, 4) for data in each]


def scene_of(page, mesh, changes):
    """Return the scene that a page shows."""
    now = page.evaluate("explorer.state")
    lights = [
        fr.Light(
            each["azimuth"],
            each["elevation"],
            each["irradiance"],
            each["distance"] and tuple(mesh.center + mesh.radius * each["distance"] * FRONT),
            each["radius"],
            shadow=False,
        )
        for each in now["lights"]
    ]
    camera = fr.Camera(**now["camera"])
    return fr.Scene(mesh.with_material(**changes), camera, lights, tuple(now["ambient"]))


def expected(page, mesh, found, term, changes):
    """Return the float64 radiance of probed pixels, (N, 3)."""
    scene = scene_of(page, mesh, changes)
    width, height = page.evaluate("explorer.size")
    row = {name: np.float32([[each[name] for each in found]]) for name in found[0]}
    gbuffer = GBuffer(
        row["part"].astype(np.int64), row["position"], row["normal"], row["albedo"], row["m"],
        row["specular_weight"], row["occlusion"], np.zeros((1, len(found), 2), np.float32),
        np.ones((1, len(found), len(scene.lights)), np.float32), view_of(scene, width / height),
        (*mesh.center, mesh.radius),
    )  # fmt: skip
    return reference.shade(gbuffer, scene, fr.Shading(term=term))[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "term", "changes"),
    [
        pytest.param(*each, marks=[pytest.mark.smoke] * (each[1].lobe == "d8"), id=each[0])
        for each in TERMS
    ],
)
def test_pixels_agree_with_float64(page, mesh, words, term, changes):
    """A is the exact term and B another; both are within 1e-3 of float64."""
    lights = "-50,42,3.6,3.4,3.1,20;30,20,1,1.2,1.4;0,0,1,1,1,0,3"  # a disc, a point light
    look(page, f"b={words}&lights={lights}" if words else f"lights={lights}")
    if not words:
        page.evaluate("explorer.state.b.lobe = 'exact'")
    width, height = page.evaluate("explorer.size")
    at = [[int(x * width), int(y * height)] for x, y in PLACES]
    probed = page.evaluate("places => explorer.probe(places)", at)
    for which, own, own_changes in (("a", Term(), {}), ("b", term, changes)):
        found = [each[which] for each in probed]
        assert min(each["part"] for each in found) >= 0
        radiance = np.array([each.pop("radiance") for each in found])
        truth = expected(page, mesh, found, own, own_changes)
        np.testing.assert_allclose(radiance, truth, rtol=1e-3)
    assert np.ptp(truth) > 0.1


def test_command_opens_the_page_with_its_scene(browser, tmp_path, capsys):
    """The page has the camera, frame, lobes, m and lights of the command, as render has them."""
    words = [
        *("--camera", "three-quarter", "--frame", "face", "--fov", "30", "--m", "0.2"),
        *("--light=-40,20,3", "--light", "point:0.02,0.1,0.5,2", "--ambient", "0.1"),
        *("--lobe", "d8", "--model", "ward"),
    ]
    path = tmp_path / "page.html"
    assert main(["explore", *words, "--against", "fitted", "-o", str(path)]) == 0
    assert "without blended parts (lash-strands, tear-line, cornea)" in capsys.readouterr().err
    given = ["render", *words, "-o", "x.png"]
    job = job_of(parser_of(given).parse_args(given), (8, 8))[0]
    assert (job.camera.frame, job.camera.azimuth) == ("face", -35.0)
    with opened(browser, path.as_uri()) as page:
        page.evaluate("explorer.errors()")
        now = page.evaluate("explorer.state")
        size = np.array(page.evaluate("explorer.size"))
        at = (np.array(PLACES) * size).astype(int)
        probed = page.evaluate("places => explorer.probe(places)", at.tolist())
        assert page.locator("#cameras :checked").get_attribute("value") == "three-quarter"
        assert page.get_by_label("m of B", exact=True).input_value() == "0.2"
        code = page.evaluate("explorer.command('b')")
    for which, name in (("a", "fitted"), ("b", "d8")):
        assert {each: now[which][each] for each in ("model", "lobe", "m", "f0")} == {
            "model": "ward", "lobe": name, "m": 0.2, "f0": None
        }  # fmt: skip
    assert now["lights"][0]["azimuth"] == -40.0
    assert (now["ambient"], now["camera"]["fov"]) == ([0.1] * 3, 30.0)
    mesh = job.scene().mesh
    found = np.array([each["a"]["position"] for each in probed])
    of_skin = np.array([each["a"]["part"] >= 0 for each in probed])
    assert of_skin.sum() >= 6
    view = view_of(job.scene(), size[0] / size[1])
    drawn = drawable(mesh)  # The page's space has the bounds of the parts that the page draws.
    pixels, _ = view.project(mesh, drawn.center + drawn.radius * found[of_skin], tuple(size))
    np.testing.assert_allclose(pixels, (at + 0.5)[of_skin], atol=1.0)
    assert "--frame face" in code
    point = drawn.center + drawn.radius * now["lights"][1]["distance"] * direction_to(
        now["lights"][1]["azimuth"], now["lights"][1]["elevation"]
    )
    np.testing.assert_allclose(point, (0.02, 0.1, 0.5), atol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "front", "--camera", "profile"], "opens with one camera"),
        (["--light", "key"] * 9, "at most 8 lights"),
        (["--m", "7"], "m = 7"),
    ],
)
def test_scenes_that_the_page_cannot_show_are_refused(tmp_path, capsys, words, message):
    assert main(["explore", str(MINI), *words, "-o", str(tmp_path / "a.html")]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("--no-shadows", ""),
        ("--light key", "soft shadows"),
        ("--light 20,30", "shadows"),
        ("--light key --scene no-shadows.toml", ""),
        (
            "--no-shadows --environment studio",
            "the environment map (the default lights and ambient light replace the map)",
        ),
        ("--no-shadows --second-slope 0.333 --lobe-weight 0.85", "second lobes"),
        (
            "--no-shadows --scattering skin --diffuse coupled",
            "subsurface scattering, the coupled diffuse term",
        ),
        ("--no-shadows --scattering skin --scatter-samples 0", ""),
        ("--no-shadows --no-slope-filter", "slope_filter of the shading"),
        ("--no-shadows --anisotropy 4 --full-maps", "anisotropy, full_maps of the image"),
        ("--no-shadows --normal-strength 0.5 --normal-map normal_map.png", "map strengths"),
        ("--no-shadows --part *,alpha=mask,opacity=0.3", "masks"),
        ("--no-shadows --part *,emissive=0.2", "emission"),
        ("--no-shadows --vertices frames.npy", "all frames but one"),
        ("--no-shadows --vertices frames.npy,1", ""),
    ],
)
def test_command_and_note_name_the_features_that_the_page_omits(
    tmp_path, capsys, monkeypatch, mesh, words, names
):
    monkeypatch.chdir(tmp_path)
    maps(tmp_path)
    np.save("frames.npy", np.stack([mesh.parts[0].positions] * 2))
    Path("no-shadows.toml").write_text("[shading]\nshadow_lights = []\n")
    assert main(["explore", str(MINI), *words.split(), "-o", "page.html"]) == 0
    printed = capsys.readouterr().err.splitlines()
    name = f"facerender: warning: the explorer shows {MINI.name} without {names}"
    assert printed == [name] * bool(names)
    facts = re.search(r'id="facts">(.*?)</script>', Path("page.html").read_text())
    omitted = json.loads(facts[1])["omitted"]
    assert ", ".join([*omitted["mesh"], *omitted["scene"]]) == names


def test_note_lists_the_features_that_the_page_omits(browser, tmp_path, mesh):
    def note(job, mesh):
        path = tmp_path / "page.html"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FacerenderWarning)
            path.write_text(explorer_page(job, mesh), encoding="utf-8")
        with opened(browser, path.as_uri()) as page:
            page.evaluate("explorer.errors()")
            assert page.locator("#omitted").is_visible() == (page.inner_text("#omitted") != "")
            lit = np.ptp(images(page)[0][..., :3]) > 0.1
            return page.inner_text("#omitted"), lit

    assert note(Job(lights=PLAIN), mesh) == ("", True)
    soft = note(Job(lights=(fr.Light(radius=3.0),)), mesh)[0]
    assert soft == "This page omits soft shadows. Its command omits soft shadows."
    dark = Job(lights=(), ambient=0.0, environment=fr.EnvironmentFile("studio"))
    assert note(dark, mesh)[1]  # lit by the default lights
    head = note(Job(lights=PLAIN), fr.load_mesh())[0]
    assert head == "This page omits blended parts (lash-strands, tear-line, cornea)."


def test_constant_m_of_a_plan_is_shown_and_drawn(browser, tmp_path, written, egl):
    """The scene file of a plan sets B; its constant m applies to every part."""
    scene = tmp_path / "plan.toml"
    scene.write_text(
        'lights = [{ azimuth = 20.0, shadow = false }]\n[shading]\nlobe = "d8"\nm = 0.31416\n'
    )
    words = [str(MINI), *("--normal-map", written[1].normal_map), "--scene", str(scene)]
    path = tmp_path / "page.html"
    assert main(["explore", *words, "-o", str(path)]) == 0
    with opened(browser, path.as_uri()) as page:
        page.evaluate("explorer.errors()")
        field = page.get_by_label("m of plan of B")
        assert (field.is_visible(), field.input_value()) == (True, "0.31416")
        assert page.get_by_label("m of plan of A").input_value() == ""
        assert "in A, 0.314 in B" in page.inner_text("#here")
        size = tuple(page.evaluate("explorer.size"))
        drawn = images(page)[1]
        assert "m = 0.31416" in page.evaluate("explorer.scene('b')")
        assert "--scene b.toml" in page.inner_text("#command")
    options = parser_of(["render", *words, "-o", "a.png"]).parse_args(
        ["render", *words, "-o", "a.png"]
    )
    job = job_of(options, size)[0]
    with fr.Renderer(size, backend=egl) as renderer:
        frame = renderer.render(job.scene(), job.shading)
    assert np.abs(drawn - frame.linear).mean() < 1e-3


def test_saved_scene_renders_the_image_of_the_page(browser, tmp_path, written, monkeypatch):
    """The scene file and the command in its first line render the page's image in its size."""
    mesh, path = written[1], tmp_path / "page.html"
    job = Job(
        mesh,
        {"kd": 0.8, "m": 0.35},
        fr.Camera(20.0, 5.0, frame="face", target=(0.0, 0.02, 0.05)),
        (fr.Light(-30.0, 30.0, (2.0, 1.5, 1.0), shadow=False),),
        background=(0.1, 0.2, 0.3),
    )
    plain = replace(job, material={"kd": 0.8})
    path.write_text(explorer_page(job, plain.scene().mesh), encoding="utf-8")
    link = "#b=lobe:g-power;g:6;factor:0.3;offset:0.4;m:0.35&exposure=0.5&show=b"
    with opened(browser, path.as_uri(), fragment=link) as page:
        page.evaluate("explorer.errors()")
        size = page.evaluate("explorer.size")
        shown = linear_to_srgb(np.clip(2**0.5 * images(page)[1][..., :3], 0.0, 1.0))
        with page.expect_download() as download:
            page.click("#save-scene")
        assert download.value.suggested_filename == "b.toml"
        download.value.save_as(tmp_path / "b.toml")
    monkeypatch.chdir(tmp_path)
    first = Path("b.toml").read_text().splitlines()[0]
    command = shlex.split(first.removeprefix("# facerender "))
    assert main(command) == 0
    image = Image.open("b.png")
    assert image.size == tuple(size)
    off = np.abs(np.asarray(image.convert("RGB")) / 255.0 - shown)
    assert off.mean() < 1.5e-3


def test_errors_of_an_earlier_image_are_marked(page):
    look(page)
    assert page.locator("#readout table").evaluate("each => each.className") == ""
    assert page.inner_text("#against") == "B against A"
    old = page.evaluate(
        """() => {
            const field = document.querySelector('[aria-label="f0 of B"]');
            field.value = "0.05";
            field.dispatchEvent(new Event("input"));
            return [...document.querySelectorAll(".old")].map(each => each.id || each.tagName);
        }"""
    )
    assert {"TABLE", "where", "over", "mark"} <= set(old)
    assert page.inner_text("#against") == "computing …"
    page.evaluate("explorer.errors()")
    assert page.locator(".old").count() == 0
    assert page.inner_text("#against") == "B against A"


def test_label_shows_the_offset_of_the_field(page):
    for offset in ("0.5", "-0.25"):
        look(page, f"b=lobe:g-power;offset:{offset}")
        assert page.get_by_label("offset of B").input_value() == offset
        assert f"offset {offset}" in page.inner_text("#tag-b")


@pytest.mark.parametrize(
    ("label", "value", "words"),
    [
        ("m of B", "7", "m of B: give a number from 0.0001 to 2, or nothing for map"),
        ("power g of B", "2.5", "power g of B: give a whole number from 1 to 31"),
        ("azimuth of light 1", "", "azimuth of light 1: give a number from -3600 to 3600"),
        ("budget in 1/255", "-1", "budget in 1/255: give a number from 0 to 255, or nothing"),
    ],
)
def test_input_out_of_range_shows_the_range(page, label, value, words):
    look(page, "b=lobe:g-power")
    before = page.evaluate("JSON.stringify(explorer.state)")
    assert page.locator("#range").is_hidden()
    page.get_by_label(label, exact=True).fill(value)
    assert page.inner_text("#range").startswith(words)
    box, field = page.locator("#range").bounding_box(), page.get_by_label(label, exact=True)
    near = field.bounding_box()
    assert abs(box["y"] - near["y"]) < 60
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= VIEW["viewport"]["width"]
    assert page.evaluate("JSON.stringify(explorer.state)") == before
    field.blur()
    assert page.locator("#range").is_hidden()


def test_page_frames_the_head_of_a_bust(browser, tmp_path):
    """The page's first view is the view of fr.Camera()."""
    mesh = person("bust")
    assert region_of(mesh, "auto") is not None
    path = tmp_path / "bust.html"
    path.write_text(explorer_page(Job(lights=PLAIN), mesh), encoding="utf-8")
    with opened(browser, path.as_uri()) as page:
        page.evaluate("explorer.errors()")
        size = np.array(page.evaluate("explorer.size"))
        at = (np.array(PLACES) * size).astype(int)
        probed = page.evaluate("places => explorer.probe(places)", at.tolist())
    found = np.array([[*each["a"]["position"], 1.0] for each in probed])
    clip = found @ view_of(fr.Scene(mesh, fr.Camera()), size[0] / size[1]).matrix
    pixels = (clip[:, :2] / clip[:, 3:] + 1.0) * size / 2.0
    np.testing.assert_allclose(pixels, at + 0.5, atol=1.0)


def test_m_of_a_term_applies_to_the_skin(browser, tmp_path):
    mesh = row("a", "eye")
    eye = replace(mesh.parts[1], skin=False)
    mesh = replace(mesh.with_material("eye", m=0.125), parts=(mesh.parts[0], eye))
    path = tmp_path / "explorer.html"
    path.write_text(explorer_page(Job(lights=PLAIN), mesh), encoding="utf-8")
    with opened(browser, path.as_uri(), fragment="#a=m:0.5;ks:0.25") as page:
        page.evaluate("explorer.errors()")
        width, height = page.evaluate("explorer.size")
        at = [[int(x * width), height // 2] for x in np.linspace(0.0, 0.99, 50)]
        probed = page.evaluate("places => explorer.probe(places)", at)
    found = {each["a"]["part"]: each["a"] for each in probed}
    shown = {part: (own["m"], own["specular_weight"]) for part, own in found.items() if part >= 0}
    assert shown == {0: (0.5, 0.25), 1: (0.125, 1.0)}


def test_errors_agree_with_compare(page):
    shown = look(page, "b=lobe:d8&a=m:0.35&only=specular")
    a, b = images(page)
    covered = a[..., 3] > 0
    result = compare(a, b, mask=covered)
    assert shown["covered"] == covered.sum() > 10_000
    assert shown["linear"]["largest"] == pytest.approx(result.largest, rel=0.02)
    assert shown["linear"]["mean"] == pytest.approx(result.mean, rel=0.02)
    for measure, unit, scale in (("display", "1/255", 255.0), ("relative", "1%", 1.0)):
        budget = Budget.parse(unit)
        errors = scale * budget.errors(b[..., :3].astype(float), a[..., :3].astype(float))[covered]
        assert shown[measure]["largest"] == pytest.approx(errors.max(), rel=0.02)
        assert shown[measure]["most"] == pytest.approx(np.quantile(errors, 0.999), rel=0.02)
        assert shown[measure]["mean"] == pytest.approx(errors.mean(), rel=0.02)
    x, y = shown["display"]["at"]
    steps = 255.0 * Budget.parse("1/255").errors(b[..., :3].astype(float), a[..., :3].astype(float))
    assert steps[y, x] == pytest.approx(shown["display"]["largest"], rel=0.01)
    cells = page.locator("#readout tr[data-measure=display] td").all_inner_texts()
    assert float(cells[0]) == pytest.approx(shown["display"]["largest"], rel=0.01)


def test_images_agree_with_the_renderer(page, mesh, egl):
    """The page has JPEG maps and 16-bit positions."""
    shown = look(page, "b=lobe:d8;m:0.4&a=m:0.4&camera=azimuth:-35;elevation:4")
    drawn = images(page)
    scene = scene_of(page, mesh, {"m": 0.4})
    with fr.Renderer(tuple(page.evaluate("explorer.size")), backend=egl) as renderer:
        frames = [renderer.render(scene, fr.Shading(lobe=lobe)) for lobe in ("exact", "d8")]
    for image, frame in zip(drawn, frames, strict=True):
        assert np.abs(image - frame.linear).mean() < 1e-3
    result = compare(frames[0], frames[1], mask=frames[0].linear[..., 3] > 0)
    assert shown["linear"]["mean"] == pytest.approx(result.mean, rel=0.02)
    assert shown["linear"]["largest"] == pytest.approx(result.largest, rel=0.02)


def test_maps_wrap_and_filter_as_in_the_renderer(browser, tmp_path, mesh, egl):
    texels = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    checks = Texture(lambda: Image.fromarray(texels), "checks").sampled(
        ("clamp", "mirror"), nearest=True
    )
    part = mesh.parts[0]
    tiled = replace(mesh, parts=(replace(part, uv=3.0 * part.uv - 1.0),))
    tiled = tiled.with_material(albedo_map=checks, normal_map=None)
    path = tmp_path / "page.html"
    path.write_text(explorer_page(Job(lights=PLAIN), tiled), encoding="utf-8")
    with opened(browser, path.as_uri()) as page:
        page.evaluate("explorer.errors()")
        size, scene = tuple(page.evaluate("explorer.size")), scene_of(page, tiled, {})
        drawn = images(page)[0]
    with fr.Renderer(size, backend=egl) as renderer:
        frame = renderer.render(scene)
    assert np.abs(drawn - frame.linear).mean() < 2e-3


ROOT = 6.0  # levels, because the root of an error near 0 amplifies the rounding of float32
OVERLAYS = "#handles, #cut, .tag, #mark, #legend { visibility: hidden }"


def shot(page):
    """Return a screenshot of the canvas, (H, W, 3)."""
    image = page.locator("#canvas").screenshot(style=OVERLAYS)
    pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB")).astype(int)
    width, height = page.evaluate("explorer.size")
    return pixels[: height - 1, :width]  # the last row may be incomplete


def heat(x):
    """Return the colours of the difference view, (..., 3) in [0, 255]."""
    stops = [(0, 0, 0), (0.09, 0.17, 0.45), (0.10, 0.52, 0.58), (0.66, 0.82, 0.36), (1, 1, 0.9)]
    places = np.linspace(0.0, 1.0, len(stops))
    columns = [np.interp(np.sqrt(x), places, column) for column in np.transpose(stops)]
    return 255.0 * np.stack(columns, axis=-1)


@pytest.mark.parametrize(
    "lobes",
    ["b=lobe:d16", "a=lobe:fitted&b=lobe:fitted-fine", "b=m:0.05;lobe:exact", "b=lobe:exact"],
)
def test_gain_fits_the_largest_difference(page, lobes):
    errors = look(page, f"show=difference&{lobes}")["display"]
    a, b = (255.0 * linear_to_srgb(np.clip(each[..., :3], 0.0, 1.0)) for each in images(page))
    apart = np.abs(a - b).max(axis=-1)[:-1]
    shown = shot(page)
    if errors["largest"] == 0.0:
        assert shown.max() == 0
        return
    np.testing.assert_allclose(shown, heat(np.clip(apart / errors["largest"], 0, 1)), atol=ROOT)
    assert shown.max() == 255
    gain = 255.0 / errors["largest"]
    assert f"× {gain:.3g}"[:5] in page.inner_text("#sliders").replace(",", "")
    end = float(page.inner_text("#legend-end").split()[0])
    assert end == pytest.approx(errors["largest"], rel=0.01)
    assert page.evaluate("explorer.state.gain") is None

    page.get_by_label("gain", exact=True).fill("3")
    page.evaluate("explorer.errors()")
    np.testing.assert_allclose(shot(page), heat(np.clip(apart * 8 / 255, 0, 1)), atol=ROOT)
    page.get_by_label("Fit the gain").click()
    page.evaluate("explorer.errors()")
    np.testing.assert_array_equal(shot(page), shown)


def test_split_view_divides_the_images(page):
    link = "b=lobe:cosine;m:0.5"
    views = []
    for show in ("a", "b", "wipe&cut=0.25", "difference&gain=4"):
        look(page, f"{link}&show={show}")
        views.append(shot(page))
    a, b, wipe, difference = views
    middle = a.shape[1] // 4
    np.testing.assert_array_equal(wipe[:, :middle], a[:, :middle])
    np.testing.assert_array_equal(wipe[:, middle + 1 :], b[:, middle + 1 :])
    apart = np.abs(a - b).max(axis=-1)
    y, x = np.unravel_index(difference.sum(axis=-1).argmax(), apart.shape)
    assert apart[y, x] > 0.9 * apart.max() > 10

    look(page, f"{link}&show=b&budget=2")
    red = (shot(page) * (2, -1, -1)).sum(axis=-1) > 255
    assert red[apart > 3].mean() > 0.99
    assert red[apart < 1].mean() < 0.01
    assert "Over 2/255" in page.inner_text("#over")


def test_dragging_moves_the_mesh_a_light_and_the_split(page):
    look(page)
    box = page.locator("#canvas").bounding_box()

    def drag(x, y, dx, dy):
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + dx, y + dy, steps=3)
        page.mouse.up()
        return page.evaluate("explorer.state")

    now = drag(box["x"] + 30, box["y"] + box["height"] - 30, 100, -20)
    assert now["camera"]["azimuth"] == pytest.approx(-40.0)
    assert now["camera"]["elevation"] == pytest.approx(-8.0)
    look(page)
    handle = page.locator(".handle").first.bounding_box()
    now = drag(handle["x"] + 10, handle["y"] + 10, 20, -10)
    assert now["lights"][0]["azimuth"] == pytest.approx(-41.0)
    assert now["lights"][0]["elevation"] == pytest.approx(46.5)
    grip = page.locator("#cut").bounding_box()
    x, y = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
    assert drag(x, y, 0.2 * box["width"], 0)["cut"] == pytest.approx(0.7, abs=0.01)


def test_keys_turn_zoom_and_split(page):
    look(page)
    page.focus("#canvas")
    for key in ("ArrowLeft", "ArrowUp", "+", "+", "-"):
        page.keyboard.press(key)
    camera = page.evaluate("explorer.state.camera")
    assert (camera["azimuth"], camera["elevation"]) == (5, -5)
    assert camera["zoom"] == pytest.approx(1.1)
    page.keyboard.press("0")
    assert page.evaluate("explorer.state.camera.azimuth") == 0
    page.focus("#cut")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("explorer.state.cut") == pytest.approx(0.52)
    page.locator(".handle").nth(1).focus()
    page.keyboard.press("ArrowDown")
    assert page.evaluate("explorer.state.lights[1].elevation") == pytest.approx(28.0)


def test_two_fingers_zoom(browser, address):
    with opened(browser, address, has_touch=True) as page:
        page.evaluate("explorer.errors()")
        client = page.context.new_cdp_session(page)
        box = page.locator("#canvas").bounding_box()
        x, y = box["x"] + box["width"] / 4, box["y"] + box["height"] * 0.8
        for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
            points = [{"x": x, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
            client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        client.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        assert page.evaluate("explorer.state.camera.zoom") == pytest.approx(2.0, rel=0.01)
        assert page.evaluate("explorer.state.camera.azimuth") == 0


def test_every_control_has_a_name_and_changes_the_state(page):
    look(page, "b=lobe:g-power")
    unnamed = """() => [...document.querySelectorAll("button, input, select, canvas, [tabindex]")]
        .filter(each => !each.ariaLabel && !each.labels?.length && !each.textContent.trim())
        .map(each => each.outerHTML)"""
    assert page.evaluate(unnamed) == []
    state = lambda: page.evaluate("JSON.stringify(explorer.state)")  # noqa: E731
    for each in page.locator(".panel select:enabled, .bar select").all():
        for value in each.locator("option").evaluate_all("all => all.map(one => one.value)"):
            if value != each.input_value():
                before = state()
                each.select_option(value)
                assert state() != before, each.get_attribute("aria-label")
    page.get_by_label("model of A").select_option("cook-torrance")
    page.get_by_label("model of B").select_option("cook-torrance")
    page.get_by_label("lobe of B").select_option("g-power")
    for each in page.locator(".explorer input[type=number]:visible:enabled").all():
        before = state()
        each.fill("0.61" if each.get_attribute("step") == "any" else "7")
        assert state() != before, each.get_attribute("aria-label")
    for each in page.locator(".explorer input[type=range]:visible").all():
        before = state()
        each.fill(each.get_attribute("max"))
        assert state() != before, each.get_attribute("aria-label")
    for each in page.locator(".screen .choice label:has(:not(:checked))").all():
        each.click()
    page.get_by_label("f0 of A").fill("0.05")
    for name in ("Swap A and B", "Copy A to B", "Add a light", "Remove light 1"):
        before = state()
        page.get_by_label(name, exact=True).click()
        assert state() != before, name
    page.evaluate("explorer.errors()")


def test_link_restores_the_view(browser, page, address):
    look(page, "")
    page.evaluate("""() => {
        const {state} = explorer;
        Object.assign(state.b, {lobe: "g-power", g: 6, factor: 0.3, m: 0.4});
        Object.assign(state.camera, {azimuth: -35, zoom: 1.3});
        Object.assign(state, {show: "difference", gain: 16, budget: 3});
        state.lights.splice(1, 1);
        state.lights[0].radius = 5;
        dispatchEvent(new Event("resize"));
    }""")
    page.locator("label", has_text="specular").click()
    shown = page.evaluate("explorer.errors()")
    link = page.evaluate("location.hash")
    with opened(browser, address, fragment=link) as other:
        assert other.evaluate("explorer.errors()") == shown
        assert other.evaluate("explorer.state") == page.evaluate("explorer.state")


def test_invalid_parts_of_a_link_are_named(page):
    look(page, "b=lobe:d32;m:7&show=c&lights=1,2&zoo=1&a=f0:0.04")
    result = page.inner_text("#notes")
    for word in ("B lobe:d32", "B m:7", "show=c", "lights=1,2", "zoo=1"):
        assert word in result
    assert page.evaluate("explorer.state.a.f0") == 0.04
    assert page.evaluate("explorer.state.b.lobe") == "d16"


@pytest.mark.parametrize(("words", "term", "changes"), TERMS, ids=[each[0] for each in TERMS])
def test_lobe_curves_agree_with_float64(page, words, term, changes):
    """The curves use the slope of the pixel with the largest error."""
    errors = look(page, f"a={words}&b=lobe:d4")
    found = page.evaluate("explorer.lobe('a')")
    angles = np.linspace(0.0, np.pi / 2, 361)
    cosines = np.cos(angles).astype(np.float32)
    truth = lobe(term.lobe, cosines, found["m"], MODELS[term.model].k)
    np.testing.assert_allclose(found["values"], truth, atol=3e-5)
    place = errors["display"]["at"]
    assert found["m"] == page.evaluate("place => explorer.probe([place])[0].a.m", place)


def test_stated_errors_of_another_m_are_not_shown(page):
    look(page, "a=lobe:d8;m:0.25&b=lobe:fitted;m:0.25")
    text = page.locator("#lobes .note").inner_text()
    assert re.fullmatch(r"fitted: stated error [\d.]+ % for every m", text)


def test_lobe_curves_follow_the_pointer(page):
    look(page, "a=lobe:exact")
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 0.35 * box["height"])
    page.locator("#here", has_text="Under the pointer").wait_for()
    place = [int(0.45 * box["width"]), int(0.35 * box["height"])]
    m = page.evaluate("place => explorer.probe([place])[0].a.m", place)
    assert page.evaluate("explorer.lobe('a').m") == pytest.approx(m, rel=0.02)
    for scale in ("log", "polar", "linear"):
        page.locator("#scale label", has_text=scale).click()
        assert page.locator("#lobes .curve").count() == 3
    page.mouse.move(0, 0)
    page.locator("#here", has_text="At the ring").wait_for()


def test_slope_outside_the_domain_is_reported(page):
    look(page, "b=lobe:d16;m:0.8")
    assert "B: m reaches 0.8" in page.inner_text("#outside")
    look(page)
    assert page.inner_text("#outside") == ""


@pytest.mark.parametrize(("words", "term", "changes"), TERMS, ids=[each[0] for each in TERMS])
def test_command_line_and_scene_file_give_the_same_scene(
    page, written, tmp_path, words, term, changes
):
    light = "-50,42,3.6,3.4,3.1,5;20,30,1,1,1,0,2.5"  # a disc, a point light
    follow(page, f"a={words}&camera=azimuth:-35;zoom:1.2&lights={light}&exposure=0.5")
    command, toml = page.evaluate("explorer.command('a')"), page.evaluate("explorer.scene('a')")
    (tmp_path / "a.toml").write_text(toml)
    jobs = []
    for text in (command.replace("\\\n", ""), toml.splitlines()[0].removeprefix("# ")):
        given = shlex.split(text.replace("a.toml", str(tmp_path / "a.toml")))[1:]
        jobs.append(job_of(parser_of(given).parse_args(given), (8, 8))[0])
        job = jobs[-1]
        assert job.shading == fr.Shading(term=term)
        assert {name: job.material[name] for name in changes} == changes
        roughness = None if "m" in changes else written[1].roughness_map
        assert job.mesh == replace(written[1], roughness_map=roughness)
        assert (job.camera.azimuth, job.camera.zoom) == (-35.0, 1.2)
        assert job.lights[0] == fr.Light(-50.0, 42.0, (3.6, 3.4, 3.1), radius=5.0, shadow=False)
    assert jobs[0].lights == jobs[1].lights
    assert jobs[0].lights[1].position is not None
    assert (jobs[0].ambient, jobs[0].camera) == (jobs[1].ambient, jobs[1].camera)
    assert "--exposure 0.5" in command


def test_command_without_lights_reads_them_from_the_scene_file(page):
    look(page, "lights=none")
    command = page.inner_text("#command")
    assert "--scene b.toml" in command
    assert "--light" not in command
    assert "lights = []" in page.evaluate("explorer.scene('b')")


def test_new_lobe_of_the_registry_appears_in_the_page(browser, tmp_path, monkeypatch):
    shaders = tmp_path / "shaders"
    shutil.copytree(fr.shader_dir(), shaders)
    toy = Lobe(
        name="toy", number=40, file="lobe/toy", call="fr_lobe_toy(c, m, k)",
        evaluate=lambda c, m, k: np.asarray(c, float) ** 3 * np.ones_like(m),
        ends={4: 2.0, 0: 2.0}, rounding=lambda c, m, k: (0.0, 0.0),
    )  # fmt: skip
    monkeypatch.setitem(LOBES, "toy", toy)
    (shaders / "facerender/lobe/toy.glsl").write_text(
        "float fr_lobe_toy(float c, float m, int k) { return c * c * c; }\n"
    )
    file = shaders / "facerender/lobe.glsl"
    text = file.read_text(encoding="utf-8")
    for line, own in (  # the steps of CONTRIBUTING.md, in one branch with the exact lobe
        ("#define FR_LOBE_EXACT 1\n", "#define FR_LOBE_TOY 40\n"),
        (
            "#elif FR_LOBE == FR_LOBE_COSINE\n",
            "#elif FR_LOBE == FR_LOBE_TOY\n#define FR_COMPILED_LOBE 40\n",
        ),
        ("FR_LOBE == FR_LOBE_EXACT || ", "FR_LOBE == FR_LOBE_TOY || "),
        ('#include "lobe/exact.glsl"\n', '#include "lobe/toy.glsl"\n'),
        (
            "    if (lobe == FR_LOBE_EXACT)",
            "    if (lobe == FR_LOBE_TOY) return fr_lobe_toy(c, m, k);\n",
        ),
    ):
        assert line in text
        text = text.replace(line, own + line)
    file.write_text(text, encoding="utf-8")
    monkeypatch.setattr("facerender.glsl.library.shader_dir", lambda: shaders)
    monkeypatch.setattr("facerender.explorer.page.shader_dir", lambda: shaders)
    address, file = write(tmp_path)
    mesh = file.load()
    with opened(browser, address) as page:
        page.evaluate("explorer.errors()")
        page.get_by_label("lobe of B").select_option("toy")
        page.evaluate("explorer.errors()")
        width, height = page.evaluate("explorer.size")
        place = [width // 2, int(0.42 * height)]
        found = page.evaluate("place => explorer.probe([place])[0].b", place)
        radiance = np.array([found.pop("radiance")])
        np.testing.assert_allclose(
            radiance, expected(page, mesh, [found], Term(lobe="toy"), {}), rtol=1e-3
        )
        options = page.get_by_label("lobe of A").locator("option").all_inner_texts()
        assert options == [*LOBES, "g-power"]
    for label, entries in (("Fresnel", FRESNEL), ("masking", MASKING)):
        assert f'"{next(iter(entries))}"' in (tmp_path / "explorer.html").read_text(), label
    assert len(MODELS) == 3


def test_cost_is_measured_and_saved(page):
    look(page, "b=lobe:d4&camera=zoom:0.3")
    page.click("#cost")
    with page.expect_download() as download:
        page.click("#save", timeout=60_000)
    saved = json.loads(Path(download.value.path()).read_text())
    assert saved["size"] == page.evaluate("explorer.size")
    assert saved["link"] == page.evaluate("location.hash.slice(1)")
    assert saved["method"] in ("GPU timer", "fence")
    for name in ("base", "a", "b", "difference"):
        times = saved[name]["rounds"]
        assert len(times) == 7
        assert saved[name]["median"] == pytest.approx(np.median(times))
        assert [saved[name]["low"], saved[name]["high"]] == pytest.approx(
            np.quantile(times, (0.25, 0.75))
        )
    assert saved["shadings"] == {
        which: f"cook-torrance, {name}, schlick, v-cavity"
        for which, name in {"a": "exact", "b": "d4"}.items()
    }
    assert saved["base"]["median"] > 0.0
    assert saved["gpu"] in page.inner_text("#cost-message")


def test_costs_belong_to_one_image_and_keep_their_size(page):
    look(page)
    place = "[...document.querySelectorAll('.costs')].map(e => [e.offsetWidth, e.offsetHeight])"
    sizes = [page.evaluate(place)]
    page.click("#cost")
    page.locator("#save").wait_for(timeout=60_000)
    cells = page.locator(".costs td")
    assert "–" not in cells.all_inner_texts()
    sizes.append(page.evaluate(place))
    look(page, "b=lobe:d4")  # not the measured image
    assert cells.all_inner_texts() == ["–"] * 4
    assert "another image" in page.inner_text("#cost-message")
    assert sizes == [page.evaluate(place)] * 2


def test_change_of_the_image_stops_the_measurement(page):
    look(page)
    page.click("#cost")
    page.get_by_label("lobe of B").select_option("d4")
    page.locator("#cost-message", has_text="Stopped").wait_for()
    assert page.locator("#save").is_hidden()


NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
NO_FLOATS = """const own = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
    return name === "EXT_color_buffer_float" ? null : own.call(this, name);
};"""


@pytest.mark.parametrize(
    ("before", "words"),
    [
        (NO_WEBGL, "This browser has no WebGL 2"),
        (NO_FLOATS, "cannot draw to float targets"),
        ("delete window.DecompressionStream;", "cannot unpack the mesh"),
    ],
    ids=["no WebGL", "no float targets", "no DecompressionStream"],
)
def test_missing_browser_features_are_reported(browser, address, before, words):
    with opened(browser, address, before) as page:
        page.get_by_role("alert").filter(has_text=words).wait_for()
        page.get_by_label("lobe of B").select_option("d4")  # the rest of the page still works
        page.wait_for_function("location.hash.includes('lobe:d4')")


def test_lost_context_is_reported_and_restored(browser, address):
    with opened(browser, address) as page:
        shown = page.evaluate("explorer.errors()")
        page.evaluate(
            "() => { window.loss = document.getElementById('canvas').getContext('webgl2')"
            ".getExtension('WEBGL_lose_context'); loss.loseContext(); }"
        )
        page.get_by_role("alert").filter(has_text="lost the image").wait_for()
        page.evaluate("loss.restoreContext()")
        page.get_by_role("alert").wait_for(state="hidden")
        assert page.evaluate("explorer.errors()") == shown


# Texts of the page that are cut off by the window, by a box that clips, or by their own control.
CUT = """() => {
    const cut = [];
    const name = each => each.ariaLabel || each.id || each.textContent.trim() || each.tagName;
    const all = [...document.querySelectorAll(".explorer *")]
        .filter(each => each.checkVisibility() && !each.closest("#command, .hidden, svg")
            && !each.matches(".choice input, option"));
    for (const each of all) {
        const box = each.getBoundingClientRect();
        if (box.left < -0.5 || box.right > innerWidth + 0.5) cut.push(`${name(each)}: the window`);
        for (let outer = each.parentElement; outer; outer = outer.parentElement) {
            if (getComputedStyle(outer).overflowX === "visible") continue;
            const [own, most] = [box, outer.getBoundingClientRect()];
            const hidden = getComputedStyle(outer).overflowY === "hidden";
            if (own.left < most.left - 0.5 || own.right > most.right + 0.5
                || hidden && (own.top < most.top - 0.5 || own.bottom > most.bottom + 0.5)) {
                cut.push(`${name(each)}: ${name(outer)}`);
            }
        }
        if (each.matches("input, select")) {
            const copy = each.cloneNode();
            if (each.matches("select")) copy.append(each.selectedOptions[0].cloneNode(true));
            Object.assign(copy.style, {width: "auto", position: "absolute", flex: "none"});
            const needs = each.matches("select") ? (each.after(copy), copy.offsetWidth) : 0;
            copy.remove();
            if (needs > each.offsetWidth || each.scrollWidth > each.clientWidth) {
                cut.push(`${name(each)}: ${each.value}`);
            }
        }
    }
    return cut;
}"""


@pytest.mark.parametrize("width", [360, 420, 768, 1280, 1920])
@pytest.mark.parametrize("show", ["wipe", "difference"])
def test_nothing_is_cut_off(page, width, show):
    lights = ";".join(
        f"{azimuth},-12.345,1,0.5,0.314159,12.25" for azimuth in (-180, -100.25, 90.5, 100, 120.75)
    )
    page.set_viewport_size({"width": width, "height": 900})
    try:
        for term in (
            "lobe:g-power;factor:0.314159;offset:-12.3456;m:0.314159",
            "model:ward-printed",
        ):
            look(
                page, f"a={term}&b={term}&lights={lights}&show={show}&budget=2.5&camera=azimuth:-28"
            )
            assert page.evaluate(CUT) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    finally:
        page.set_viewport_size(VIEW["viewport"])


@pytest.mark.parametrize("size", [(1280, 800), (1366, 768), (1920, 1080)])
@pytest.mark.parametrize("ratio", [1, 1.25, 1.5, 2])
def test_canvas_has_one_pixel_per_device_pixel(browser, address, size, ratio):
    viewport = {"width": size[0], "height": size[1]}
    with opened(
        browser, address, fragment="#show=a", viewport=viewport, device_scale_factor=ratio
    ) as page:
        page.evaluate("explorer.errors()")
        page.wait_for_timeout(300)
        page.evaluate("explorer.errors()")
        page.add_style_tag(content=OVERLAYS)
        linear = images(page)[0]
        shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        box = page.evaluate("document.getElementById('canvas').getBoundingClientRect().toJSON()")
    height, width = linear.shape[:2]
    left, top = (round(ratio * box[name]) for name in ("left", "top"))
    assert (width, height) == (
        round(ratio * box["right"]) - left,
        round(ratio * box["bottom"]) - top,
    )
    drawn = 255.0 * linear_to_srgb(np.clip(linear[..., :3], 0.0, 1.0))
    off = np.abs(shown[top : top + height, left : left + width] - drawn)
    assert np.ptp(drawn) > 200
    assert off.max() <= 0.6


@pytest.mark.slow
def test_the_built_in_head_fits(tmp_path, capsys):
    assert main(["explore", "-o", str(tmp_path / "head.html")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'head.html'}\n"
    text = (tmp_path / "head.html").read_text(encoding="utf-8")
    assert len(text) <= 4.5e6
    assert "http://" not in text.replace("http://www.w3.org", "")
    assert "https://" not in text


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("page.png", "give a name that ends in .html"),
        ("page", "give a name that ends in .html"),
        ("gone/page.html", "cannot write"),
        ("folder.html", "cannot write"),
    ],
)
def test_invalid_output_is_refused_first(tmp_path, capsys, name, words):
    (tmp_path / "folder.html").mkdir()
    assert main(["explore", "missing.glb", "-o", str(tmp_path / name)]) == 2
    assert words in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["folder.html"]


@pytest.mark.slow
def test_maps_differ_by_less_than_a_level(head):
    for name, kind in (("albedo_map", "color"), ("normal_map", "normal"), ("property_map", "data")):
        texture = getattr(head.materials[0], name)
        image = Image.open(io.BytesIO(encoded(texture, kind)))
        assert image.format == "JPEG"
        off = np.abs(np.asarray(image).astype(int) - np.asarray(texture.rgb()).astype(int))
        assert off.mean() < 1.0
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    texture = Texture(lambda: Image.fromarray(noise), "noise")
    image = Image.open(io.BytesIO(encoded(texture, "color")))
    assert (image.format == "PNG") or np.abs(np.asarray(image).astype(int) - noise[::-1]).mean() < 1
    assert set(QUALITIES) >= {"color", "normal", "data"}
    large = Texture(lambda: Image.new("RGB", (4096, 16)), "large")
    assert Image.open(io.BytesIO(encoded(large, "data"))).size == (2048, 8)


def test_octahedral_unfolds_to_the_same_normals():
    n = np.random.default_rng(2).normal(size=(1000, 3))
    n = np.concatenate([n, np.eye(3), -np.eye(3)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    flat = np.round(octahedral(n) * 32767) / 32767
    z = 1.0 - np.abs(flat).sum(axis=1)
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat < 0, -1, 1)
    back = np.c_[np.where((z < 0)[:, None], folded, flat), z]
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    assert np.abs(back - n).max() < 1e-4
