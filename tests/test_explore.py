"""Tests the explorer page in Chromium: its images agree with the float64 reference, its errors with
``facerender compare``, and its controls, links and texts work."""

from __future__ import annotations

import base64
import io
import json
import re
import shlex
import shutil
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
from facerender.explorer.page import drawable, encoded, explorer_page
from facerender.images.image import linear_to_srgb
from facerender.loading import MESH_PATHS, MeshFile
from facerender.lobes import GPower, lobe
from facerender.planning.budget import Budget
from facerender.scene.job import Job
from facerender.scene.scene import default_lights
from facerender.scene.shading import Term
from facerender.scene.view import view_of
from facerender.terms.lobe import LOBES, lobe_entry
from facerender.terms.model import MODELS
from facerender.texture.texture import Texture
from facerender.values.vectors import direction_to
from tests.meshes import with_geometry
from tests.test_parts import row

MINI = Path(__file__).parent / "data" / "mini_head.glb"
VIEW = {"viewport": {"width": 1000, "height": 700}}
PLAIN = tuple(replace(light, shadow=False) for light in default_lights(False))
# Points on the face in the first view, in fractions of the image's width and height.
PLACES = [(x, y) for y in (0.34, 0.42, 0.55, 0.7) for x in (0.46, 0.5, 0.54)]


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


def write(folder: Path, job: Job, mesh: fr.Mesh) -> str:
    """Write a page, and return its address."""
    path = folder / "explorer.html"
    path.write_text(explorer_page(job, mesh), encoding="utf-8")
    return path.as_uri()


@contextmanager
def opened(browser, address, fragment="", before="", **more):
    """Open a page, and wait for its errors; at the end, check that it logged nothing.

    before : script that breaks the page, which therefore has no errors
    """
    page = browser.new_page(**{**VIEW, **more})
    logged = []
    page.on("console", lambda message: logged.append(message.text))
    page.on("pageerror", lambda error: logged.append(str(error)))
    page.add_init_script(before)
    page.goto(address + fragment)
    if not before:
        page.evaluate("explorer.errors()")
    yield page
    page.close()
    assert logged == []


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The address of a page, and its mesh file."""
    folder = tmp_path_factory.mktemp("explorer")
    file = MeshFile(str(MINI), **maps(folder))
    return write(folder, Job(file, lights=PLAIN), file.load()), file


@pytest.fixture(scope="module")
def mesh(written):
    return written[1].load()


@pytest.fixture(scope="module")
def page(browser, written):
    """A page shared by all tests that set its state by a link."""
    with opened(browser, written[0]) as page:
        yield page


def look(page, fragment=""):
    """Follow a link, and return the errors of its images."""
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


def probed(page, places=PLACES):
    """Return pixels, given as fractions of the image's width and height, and their surfaces."""
    at = (np.array(places) * page.evaluate("explorer.size")).astype(int)
    return at, page.evaluate("places => explorer.probe(places)", at.tolist())


def job_from(command):
    """Return the job of a command line."""
    given = shlex.split(command.replace("\\\n", ""))[1:]
    return job_of(parser_of(given).parse_args(given), (8, 8))[0]


def expected(page, scene, found, term):
    """Return the float64 radiance of probed pixels, (N, 3)."""
    width, height = page.evaluate("explorer.size")
    row = {name: np.float32([[each[name] for each in found]]) for name in found[0]}
    gbuffer = GBuffer(
        row["part"].astype(np.int64), row["position"], row["normal"], row["albedo"], row["m"],
        row["specular_weight"], row["occlusion"], np.zeros((1, len(found), 2), np.float32),
        np.ones((1, len(found), len(scene.lights)), np.float32), view_of(scene, width / height),
        (*scene.mesh.center, scene.mesh.radius),
    )  # fmt: skip
    return reference.shade(gbuffer, scene, fr.Shading(**vars(term)))[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "term", "changes"),
    [
        ("", Term(), {}),
        pytest.param("lobe:d8;m:0.25;f0:0.05;ks:0.7", Term(lobe="d8"),
                     {"m": 0.25, "f0": 0.05, "ks": 0.7}, marks=pytest.mark.smoke),
        ("lobe:fitted-fine;fresnel:dielectric;masking:kelemen",
         Term(lobe="fitted-fine", fresnel="dielectric", masking="kelemen"), {}),
        ("lobe:g-power;g:6;factor:0.3;offset:0.4;m:0.35",
         Term(lobe=GPower(6, 0.3, 0.4)), {"m": 0.35}),
        ("model:ward;lobe:fitted;m:0.5", Term("ward", "fitted"), {"m": 0.5}),
        ("model:ward-printed;lobe:exact;m:0.15", Term("ward-printed"), {"m": 0.15}),
    ],
)  # fmt: skip
def test_pixels_curves_and_command_of_a_term(page, mesh, written, tmp_path, words, term, changes):
    """A term (A) and D4 (B) are within 1e-3 of float64, with three kinds of lights."""
    view = "camera=azimuth:-3;zoom:1.05&lights=-50,42,3.6,3.4,3.1,20;30,20,1,1.2,1.4;0,0,1,1,1,0,3"
    errors = look(page, f"a={words}&b=lobe:d4&{view}&exposure=0.5")
    command, toml = page.evaluate("[explorer.command('a'), explorer.scene('a')]")
    (tmp_path / "a.toml").write_text(toml)
    texts = (command, toml.splitlines()[0].removeprefix("# "))
    jobs = [job_from(text.replace("a.toml", str(tmp_path / "a.toml"))) for text in texts]
    for job in jobs:
        assert job.shading == fr.Shading(**vars(term))
        assert {name: job.material[name] for name in changes} == changes
        paths = {name: getattr(written[1], name) for name in MESH_PATHS}
        names = {name: path and Path(path).name for name, path in paths.items()}
        names |= {"roughness_map": None} if "m" in changes else {}
        assert job.mesh == replace(written[1], **names)
        assert (job.camera.azimuth, job.camera.zoom) == (-3.0, 1.05)
        assert job.lights[0] == fr.Light(-50.0, 42.0, (3.6, 3.4, 3.1), radius=20.0, shadow=False)
        position = mesh.center + (0.0, 0.0, 3.0 * mesh.radius)
        np.testing.assert_allclose(job.lights[2].position, position, rtol=1e-5)
    scenes = [(job.ambient, job.camera, job.lights) for job in jobs]
    assert scenes[0] == scenes[1]
    assert all("--exposure 0.5" in text for text in texts)

    _, surfaces = probed(page)
    for which, own, own_changes in (("a", term, changes), ("b", Term(lobe="d4"), {})):
        found = [each[which] for each in surfaces]
        assert min(each["part"] for each in found) >= 0
        radiance = np.array([each.pop("radiance") for each in found])
        scene = fr.Scene(mesh.with_material(**own_changes), job.camera, job.lights, job.ambient)
        truth = expected(page, scene, found, own)
        np.testing.assert_allclose(radiance, truth, rtol=1e-3)
    assert np.ptp(truth) > 0.1

    curve = page.evaluate("explorer.lobe('a')")  # for m of the pixel with the largest error
    cosines = np.cos(np.linspace(0.0, np.pi / 2, 361)).astype(np.float32)
    truth = lobe(term.lobe, cosines, curve["m"], MODELS[term.model].k)
    np.testing.assert_allclose(curve["values"], truth, atol=3e-5)
    m = page.evaluate("place => explorer.probe([place])[0].a.m", errors["display"]["at"])
    assert curve["m"] == m


def test_command_opens_the_page_with_its_scene(browser, tmp_path, capsys):
    """The page has the camera, frame, lobes, m and lights of the command, as render has them."""
    words = [
        *("--camera", "three-quarter", "--frame", "face", "--fov", "30", "--m", "0.2"),
        *("--light=-40,20,3", "--light", "point:0.02,0.1,0.5,2", "--ambient", "0.1"),
        *("--lobe", "d8", "--model", "ward", "--no-shadows"),
    ]
    path = tmp_path / "page.html"
    assert main(["explore", *words, "--against", "fitted", "-o", str(path)]) == 0
    omitted = "blended parts (lash-strands, tear-line, cornea)"
    printed = capsys.readouterr()
    assert f"without {omitted}\n" in printed.err
    assert printed.out == f"{path}\n"
    text = path.read_text(encoding="utf-8")
    assert len(text) <= 4.5e6
    assert re.findall("https?://(?!www.w3.org)", text) == []
    job = job_from(shlex.join(["facerender", "render", *words, "-o", "x.png"]))
    with opened(browser, path.as_uri()) as page:
        now, size = page.evaluate("[explorer.state, explorer.size]")
        at, surfaces = probed(page)
        assert page.locator("#cameras :checked").get_attribute("value") == "three-quarter"
        assert "--frame face" in page.evaluate("explorer.command('b')")
        assert page.inner_text("#omitted") == f"This page omits {omitted}."
    for which, name in (("a", "fitted"), ("b", "d8")):
        values = {each: now[which][each] for each in ("model", "lobe", "m", "f0")}
        assert values == {"model": "ward", "lobe": name, "m": 0.2, "f0": None}
    assert now["lights"][0]["azimuth"] == -40.0
    assert (now["ambient"], now["camera"]["fov"]) == ([0.1] * 3, 30.0)
    mesh = job.scene().mesh
    found = np.array([each["a"]["position"] for each in surfaces])
    of_skin = np.array([each["a"]["part"] >= 0 for each in surfaces])
    assert of_skin.sum() >= 6
    view = view_of(job.scene(), size[0] / size[1])
    drawn = drawable(mesh)  # The page's space has the bounds of the parts that the page draws.
    pixels, _ = view.project(mesh, drawn.center + drawn.radius * found[of_skin], tuple(size))
    np.testing.assert_allclose(pixels, (at + 0.5)[of_skin], atol=1.0)
    light = now["lights"][1]
    away = light["distance"] * direction_to(light["azimuth"], light["elevation"])
    np.testing.assert_allclose(drawn.center + drawn.radius * away, (0.02, 0.1, 0.5), atol=1e-6)


@pytest.mark.parametrize(
    ("words", "output", "message"),
    [
        (f"{MINI} --camera front --camera profile", "a.html", "opens with one camera"),
        (f"{MINI}{9 * ' --light key'}", "a.html", "at most 8 lights"),
        (f"{MINI} --m 7", "a.html", "m = 7"),
        ("missing.glb", "page.png", "give a name that ends in .html"),
        ("missing.glb", "gone/page.html", "cannot write"),
        ("missing.glb", "folder.html", "cannot write"),
    ],
)
def test_invalid_commands_write_no_page(tmp_path, capsys, words, output, message):
    (tmp_path / "folder.html").mkdir()
    assert main(["explore", *words.split(), "-o", str(tmp_path / output)]) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["folder.html"]


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("words", "names"),
    [
        ("--light key --light 20,30", "soft shadows, shadows"),
        (
            "--light key --scene no-shadows.toml --scattering skin --scatter-samples 0"
            " --vertices frames.npy,1",
            "",
        ),
        (
            "--no-shadows --environment studio --second-slope 0.333 --lobe-weight 0.85"
            " --scattering skin --diffuse coupled --no-slope-filter --anisotropy 4 --full-maps"
            " --vertices frames.npy",
            "the environment map (the default lights and ambient light replace the map), "
            "second lobes, subsurface scattering, the coupled diffuse term, "
            "slope_filter of the shading, anisotropy, full_maps of the image, all frames but one",
        ),
        (
            "--no-shadows --part *,alpha=mask,opacity=0.3,emissive=0.2 --normal-strength 0.5"
            " --normal-map normal_map.png",
            "masks, emission, map strengths",
        ),
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
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', Path("page.html").read_text())[1])
    commands_note = "" if "masks" in names else f" Its command omits {names}."
    assert facts["note"] == (f"This page omits {names}.{commands_note}" if names else "")
    assert len(facts["first"]["lights"]) > 0


def test_saved_scene_renders_the_image_of_the_page(browser, tmp_path, written, monkeypatch):
    """The page shows the scene file of a plan, whose constant m applies to every part. The scene
    file that the page saves and the command in its first line render the page's image."""
    monkeypatch.chdir(tmp_path)
    Path("plan.toml").write_text("""
        background = [0.1, 0.2, 0.3]
        lights = [{ azimuth = -30.0, elevation = 30.0, irradiance = [2, 1.5, 1], shadow = false }]
        camera = { azimuth = 20.0, elevation = 5.0, frame = "face", target = [0.0, 0.02, 0.05] }
        material.kd = 0.8
        shading = { lobe = "d8", m = 0.31416 }
    """)
    shutil.copy(MINI, tmp_path)  # the command has the names of the files without directories
    shutil.copy(written[1].normal_map, tmp_path)
    names = MINI.name, Path(written[1].normal_map).name
    words = [names[0], "--normal-map", names[1], "--scene", "plan.toml"]
    assert main(["explore", *words, "-o", "page.html"]) == 0
    with opened(browser, Path("page.html").absolute().as_uri()) as page:
        fields = [page.get_by_label(f"m of plan of {name}") for name in "AB"]
        assert [field.input_value() for field in fields if field.is_visible()] == ["", "0.31416"]
        assert "in A, 0.314 in B" in page.inner_text("#here")
        look(page, "b=lobe:g-power;g:6;factor:0.3;offset:0.4&exposure=0.5&show=b")
        image = images(page)[1]
        behind = (1.0 - image[..., 3:]) * [0.1, 0.2, 0.3]
        shown = linear_to_srgb(2**0.5 * (image[..., :3] - behind) + behind)
        with page.expect_download() as download:
            page.click("#save-scene")
        assert download.value.suggested_filename == "b.toml"
        download.value.save_as("b.toml")
    saved = Path("b.toml").read_text()
    assert "m = 0.31416" in saved
    assert main(shlex.split(saved.splitlines()[0].removeprefix("# facerender "))) == 0
    drawn = np.asarray(Image.open("b.png").convert("RGB")) / 255.0
    assert drawn.shape == shown.shape
    assert np.abs(drawn - shown).mean() < 1.5e-3


def test_errors_of_an_earlier_image_are_marked(page):
    look(page)
    old = "[...document.querySelectorAll('.old')].map(each => each.id || each.tagName)"
    marked = f"[document.getElementById('against').innerText, {old}]"
    assert page.evaluate(marked) == ["B against A", []]
    swapped = page.evaluate(
        f"() => {{ document.getElementById('swap').click(); return {marked}; }}"
    )
    assert swapped == ["computing …", ["mark", "TABLE", "where", "over"]]
    page.evaluate("explorer.errors()")
    assert page.evaluate(marked) == ["B against A", []]


def test_input_out_of_range_shows_the_range(page):
    look(page, "b=lobe:g-power")
    before = page.evaluate("JSON.stringify(explorer.state)")
    hint = page.locator("#range")
    for label, value, words in (
        ("m of B", "7", "give a number from 0.0001 to 2, or nothing for map"),
        ("power g of B", "2.5", "give a whole number from 1 to 31"),
        ("azimuth of light 1", "", "give a number from -3600 to 3600"),
        ("budget in 1/255", "-1", "give a number from 0 to 255, or nothing for none"),
    ):
        assert hint.is_hidden()
        field = page.get_by_label(label, exact=True)
        field.fill(value)
        assert hint.inner_text() == f"{label}: {words}"
        box = hint.bounding_box()
        assert abs(box["y"] - field.bounding_box()["y"]) < 60
        assert 0 <= box["x"] <= VIEW["viewport"]["width"] - box["width"]
        assert page.evaluate("JSON.stringify(explorer.state)") == before
        field.blur()
    assert hint.is_hidden()


def test_m_of_a_term_applies_to_the_skin(browser, tmp_path):
    mesh = row("a", "eye")
    eye = replace(mesh.parts[1], skin=False)
    mesh = with_geometry(mesh.with_material("eye", m=0.125), parts=(mesh.parts[0], eye))
    with opened(browser, write(tmp_path, Job(lights=PLAIN), mesh), "#a=m:0.5;ks:0.25") as page:
        _, surfaces = probed(page, [(x, 0.5) for x in np.linspace(0.0, 0.99, 50)])
    found = {each["a"]["part"]: each["a"] for each in surfaces}
    shown = {part: (own["m"], own["specular_weight"]) for part, own in found.items() if part >= 0}
    assert shown == {0: (0.5, 0.25), 1: (0.125, 1.0)}


def test_images_and_errors_agree_with_renderer_and_compare(page, mesh, egl):
    """The page has JPEG maps and 16-bit positions."""
    shown = look(page, "b=lobe:d8;m:0.4&a=m:0.4&only=specular&camera=azimuth:-35;elevation:4")
    a, b = images(page)
    scene = fr.Scene(mesh.with_material(m=0.4), fr.Camera(-35.0, 4.0), PLAIN)
    with fr.Renderer(tuple(page.evaluate("explorer.size")), backend=egl) as renderer:
        frames = [
            renderer.render(scene, fr.Shading(lobe=lobe), only="specular").linear
            for lobe in ("exact", "d8")
        ]
    covered = a[..., 3] > 0
    assert shown["covered"] == covered.sum() > 10_000
    for image, frame in zip((a, b), frames, strict=True):
        assert np.abs(image - frame)[covered].mean() < 1e-3
    for pair in ((a, b), frames):
        result = compare(*pair, mask=pair[0][..., 3] > 0)
        assert shown["linear"]["largest"] == pytest.approx(result.largest, rel=0.02)
        assert shown["linear"]["mean"] == pytest.approx(result.mean, rel=0.02)
    for measure, unit, scale in (("display", "1/255", 255.0), ("relative", "1%", 1.0)):
        images_ = (each[..., :3].astype(float) for each in (b, a))
        errors = scale * Budget.parse(unit).errors(*images_)
        x, y = shown[measure]["at"]
        assert errors[y, x] == pytest.approx(shown[measure]["largest"], rel=0.01)
        errors = errors[covered]
        assert shown[measure]["largest"] == pytest.approx(errors.max(), rel=0.02)
        assert shown[measure]["most"] == pytest.approx(np.quantile(errors, 0.999), rel=0.02)
        assert shown[measure]["mean"] == pytest.approx(errors.mean(), rel=0.02)
    largest = float(page.inner_text("[data-measure=display] td >> nth=0"))
    assert largest == pytest.approx(shown["display"]["largest"], rel=0.01)


def test_maps_wrap_and_filter_as_in_the_renderer(browser, tmp_path, mesh, egl):
    texels = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    checks = Texture(lambda: Image.fromarray(texels), "checks").sampled(
        ("clamp", "mirror"), nearest=True
    )
    part = replace(mesh.parts[0], uv=3.0 * mesh.parts[0].uv - 1.0)
    tiled = with_geometry(mesh, parts=(part,)).with_material(albedo_map=checks, normal_map=None)
    with opened(browser, write(tmp_path, Job(lights=PLAIN), tiled)) as page:
        size, drawn = tuple(page.evaluate("explorer.size")), images(page)[0]
    with fr.Renderer(size, backend=egl) as renderer:
        frame = renderer.render(fr.Scene(tiled, lights=PLAIN))
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
    columns = [np.interp(4.0 * np.sqrt(x), range(5), column) for column in np.transpose(stops)]
    return 255.0 * np.stack(columns, axis=-1)


@pytest.mark.parametrize("lobes", ["b=lobe:d16", "b=m:0.05;lobe:exact", "b=lobe:exact"])
def test_gain_fits_the_largest_difference(page, lobes):
    errors = look(page, f"show=difference&{lobes}")["display"]
    a, b = (255.0 * linear_to_srgb(each[..., :3]) for each in images(page))
    apart = np.abs(a - b).max(axis=-1)[:-1]
    shown = shot(page)
    if errors["largest"] == 0.0:
        assert shown.max() == 0
        return
    np.testing.assert_allclose(shown, heat(np.clip(apart / errors["largest"], 0, 1)), atol=ROOT)
    assert shown.max() == 255
    texts = (
        page.inner_text(".slider output >> nth=0")[2:],
        page.inner_text("#legend-end").split()[0],
    )
    gain, end = (float(text.replace(",", "")) for text in texts)
    assert (gain, end) == pytest.approx((255.0 / errors["largest"], errors["largest"]), rel=0.01)
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


def test_pointer_and_keys_move_the_mesh_a_light_and_the_split(page):
    look(page)
    box = page.locator("#canvas").bounding_box()

    def drag(x, y, dx, dy):
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + dx, y + dy, steps=3)
        page.mouse.up()
        return page.evaluate("explorer.state")

    now = drag(box["x"] + 30, box["y"] + box["height"] - 30, 100, -20)
    angles = [now["camera"][name] for name in ("azimuth", "elevation")]
    assert angles == pytest.approx([-40.0, -8.0])
    look(page)
    handle = page.locator(".handle").first.bounding_box()
    now = drag(handle["x"] + 10, handle["y"] + 10, 20, -10)
    angles = [now["lights"][0][name] for name in ("azimuth", "elevation")]
    assert angles == pytest.approx([-41.0, 46.5])
    grip = page.locator("#cut").bounding_box()
    x, y = grip["x"] + grip["width"] / 2, grip["y"] + grip["height"] / 2
    assert drag(x, y, 0.2 * box["width"], 0)["cut"] == pytest.approx(0.7, abs=0.01)

    look(page)
    for target, keys in (
        ("#canvas", ("ArrowLeft", "ArrowUp", "+", "+", "-")),
        ("#cut", ("ArrowRight",)),
        (".handle >> nth=1", ("ArrowDown",)),
    ):
        page.focus(target)
        for key in keys:
            page.keyboard.press(key)
    now = page.evaluate("explorer.state")
    assert (now["camera"]["azimuth"], now["camera"]["elevation"]) == (5, -5)
    assert now["camera"]["zoom"] == pytest.approx(1.1)
    assert now["cut"] == pytest.approx(0.52)
    assert now["lights"][1]["elevation"] == pytest.approx(28.0)
    page.press("#canvas", "0")
    assert page.evaluate("explorer.state.camera.azimuth") == 0


def test_every_control_has_a_name_and_changes_the_state(page):
    look(page, "b=lobe:g-power")
    unnamed = """() => [...document.querySelectorAll("button, input, select, canvas, [tabindex]")]
        .filter(each => !each.ariaLabel && !each.labels?.length && !each.textContent.trim())
        .map(each => each.outerHTML)"""
    assert page.evaluate(unnamed) == []

    def assert_changes(label, action, *values):
        before = page.evaluate("JSON.stringify(explorer.state)")
        action(*values)
        assert page.evaluate("JSON.stringify(explorer.state)") != before, label

    for each in page.locator(".panel select").all():
        label = each.get_attribute("aria-label")
        values = each.locator("option").evaluate_all("all => all.map(one => one.value)")
        for value in reversed(values):  # Cook-Torrance last, which has all terms
            if value != each.input_value():
                assert_changes(label, each.select_option, value)
    look(page, "b=lobe:g-power")
    for each in page.locator(".explorer input[type=number]:visible:enabled").all():
        value = "0.61" if each.get_attribute("step") == "any" else "7"
        assert_changes(each.get_attribute("aria-label"), each.fill, value)
    for each in page.locator(".explorer input[type=range]:visible").all():
        assert_changes(each.get_attribute("aria-label"), each.fill, each.get_attribute("max"))
    for each in page.locator(".screen .choice label:has(:not(:checked))").all():
        each.click()
    page.get_by_label("f0 of A").fill("0.05")
    for name in ("Swap A and B", "Copy A to B", "Add a light", "Remove light 1"):
        assert_changes(name, page.get_by_label(name, exact=True).click)
    page.evaluate("explorer.errors()")


def test_link_and_lost_context_restore_the_view_and_two_fingers_zoom(browser, page, written):
    look(page)
    page.evaluate("""() => {
        const {state} = explorer;
        Object.assign(state.b, {lobe: "g-power", g: 6, factor: 0.3, m: 0.4});
        Object.assign(state.camera, {azimuth: -35, zoom: 1.3});
        Object.assign(state, {show: "difference", gain: 16, budget: 3});
        state.lights.splice(1, 1);
        state.lights[0].radius = 5;
    }""")
    page.locator("label", has_text="specular").click()
    shown = page.evaluate("explorer.errors()")
    link = page.evaluate("location.hash")
    with opened(browser, written[0], link, has_touch=True) as other:
        assert other.evaluate("explorer.errors()") == shown
        assert other.evaluate("explorer.state") == page.evaluate("explorer.state")

        other.evaluate(
            "() => { window.loss = document.getElementById('canvas').getContext('webgl2')"
            ".getExtension('WEBGL_lose_context'); loss.loseContext(); }"
        )
        other.get_by_role("alert").filter(has_text="lost the image").wait_for()
        other.evaluate("loss.restoreContext()")
        other.get_by_role("alert").wait_for(state="hidden")
        assert other.evaluate("explorer.errors()") == shown

        client = other.context.new_cdp_session(other)
        box = other.locator("#canvas").bounding_box()
        x, y = box["x"] + box["width"] / 4, box["y"] + box["height"] * 0.8
        for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
            points = [{"x": x, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
            client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        client.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        camera = other.evaluate("explorer.state.camera")
        assert camera == {"azimuth": -35, "elevation": 0, "zoom": pytest.approx(2.6), "fov": 25}


@pytest.mark.parametrize(
    ("link", "place", "text"),
    [
        ("b=lobe:g-power;offset:-0.25", "#tag-b", "B g-power 8, factor 0.25, offset -0.25"),
        ("b=lobe:d16;m:0.8", "#outside", "B: m reaches 0.8.*--outside exact."),
        ("lights=none", "#command", r".*--scene b\.toml(?!.*--light).*"),
        (
            "b=lobe:d32;m:7&show=c&lights=1,2&zoo=1&a=f0:0.04",
            "#notes",
            "These parts .* ignored: B lobe:d32, B m:7, show=c, lights=1,2, zoo=1.",
        ),
        # The stated error of D8 is only known at other m.
        (
            "a=lobe:d8;m:0.25&b=lobe:fitted;m:0.25",
            "#lobes .note",
            r"fitted: stated error [\d.]+ % for every m",
        ),
    ],
)
def test_texts_describe_the_state(page, link, place, text):
    look(page, link)
    assert re.fullmatch(text, page.inner_text(place), re.DOTALL)
    assert (page.evaluate("explorer.state.a.f0") == 0.04) == ("f0" in link)
    assert ("lights = []" in page.evaluate("explorer.scene('b')")) == ("none" in link)


def test_lobe_curves_follow_the_pointer(page):
    look(page, "a=lobe:exact")
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + 0.45 * box["width"], box["y"] + 0.35 * box["height"])
    page.locator("#here", has_text="Under the pointer").wait_for()
    m = probed(page, [(0.45, 0.35)])[1][0]["a"]["m"]
    assert page.evaluate("explorer.lobe('a').m") == pytest.approx(m, rel=0.02)
    for scale in ("log", "polar", "linear"):
        page.locator("#scale label", has_text=scale).click()
        assert page.locator("#lobes .curve").count() == 3
    page.mouse.move(0, 0)
    page.locator("#here", has_text="At the ring").wait_for()


def test_new_lobe_of_the_registry_appears_in_the_page(browser, tmp_path, monkeypatch):
    monkeypatch.setitem(LOBES, "toy", replace(lobe_entry(GPower(5, 0.45, 0.6)), name="toy"))
    mesh = fr.load_mesh(MINI)
    with opened(browser, write(tmp_path, Job(lights=PLAIN), mesh)) as page:
        page.get_by_label("lobe of B").select_option("toy")
        page.evaluate("explorer.errors()")
        found = probed(page, [(0.5, 0.42)])[1][0]["b"]
        radiance = found.pop("radiance")
        truth = expected(page, fr.Scene(mesh, lights=PLAIN), [found], Term(lobe="toy"))
        np.testing.assert_allclose([radiance], truth, rtol=1e-3)
        options = page.get_by_label("lobe of A").locator("option")
        assert options.all_inner_texts() == [*LOBES, "g-power"]


def test_cost_of_an_image_is_measured_and_saved(page):
    look(page, "b=lobe:d4&camera=zoom:0.3")
    place = "[...document.querySelectorAll('.costs')].map(e => [e.offsetWidth, e.offsetHeight])"
    size = page.evaluate(place)
    page.click("#cost")
    with page.expect_download() as download:
        page.click("#save", timeout=60_000)
    saved = json.loads(Path(download.value.path()).read_text())
    shown = page.evaluate("[explorer.size, location.hash.slice(1)]")
    assert [saved["size"], saved["link"]] == shown
    for name in ("base", "a", "b", "difference"):
        times = saved[name]["rounds"]
        assert len(times) == 7
        quartiles = [saved[name][each] for each in ("low", "median", "high")]
        assert quartiles == pytest.approx(np.quantile(times, (0.25, 0.5, 0.75)))
    exact = "cook-torrance, exact, schlick, v-cavity"
    assert saved["shadings"] == {"a": exact, "b": exact.replace("exact", "d4")}
    assert saved["base"]["median"] > 0.0
    assert saved["gpu"] in page.inner_text("#cost-message")
    cells = page.locator(".costs td")
    assert "–" not in cells.all_inner_texts()
    assert page.evaluate(place) == size

    look(page, "b=lobe:d8")  # not the measured image
    assert cells.all_inner_texts() == ["–"] * 4
    assert "another image" in page.inner_text("#cost-message")
    page.click("#cost")
    page.get_by_label("lobe of B").select_option("d4")
    page.locator("#cost-message", has_text="Stopped").wait_for()
    assert page.locator("#save").is_hidden()
    assert page.evaluate(place) == size


@pytest.mark.parametrize(
    ("before", "words"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null;", "This browser has no WebGL 2"),
        ("WebGL2RenderingContext.prototype.getExtension = () => null;", "draw to float targets"),
        ("delete window.DecompressionStream;", "cannot unpack the mesh"),
    ],
)
def test_missing_browser_features_are_reported(browser, written, before, words):
    with opened(browser, written[0], before=before) as page:
        page.get_by_role("alert").filter(has_text=words).wait_for()
        page.get_by_label("lobe of B").select_option("d4")  # the rest of the page still works
        page.wait_for_function("location.hash.includes('lobe:d4')")


# Texts of the page that are cut off by the window, by a box that clips, or by their own control.
CUT = """() => [...document.querySelectorAll(".explorer *")].filter(each => {
    if (!each.checkVisibility() || each.closest("#command, .hidden, svg")
        || each.matches(".choice input, option")) return false;
    const box = each.getBoundingClientRect();
    const isOutside = (outer, hidden) =>
        box.left < outer.left - 0.5 || box.right > outer.right + 0.5
        || hidden && (box.top < outer.top - 0.5 || box.bottom > outer.bottom + 0.5);
    for (let outer = each.parentElement; outer; outer = outer.parentElement) {
        const {overflowX, overflowY} = getComputedStyle(outer);
        if (overflowX !== "visible"
            && isOutside(outer.getBoundingClientRect(), overflowY === "hidden")) return true;
    }
    if (each.matches("select")) {
        const copy = each.cloneNode();
        copy.append(each.selectedOptions[0].cloneNode(true));
        Object.assign(copy.style, {width: "auto", position: "absolute", flex: "none"});
        each.after(copy);
        const needs = copy.offsetWidth;
        copy.remove();
        if (needs > each.offsetWidth) return true;
    }
    return isOutside({left: 0, right: innerWidth})
        || each.matches("input, select") && each.scrollWidth > each.clientWidth;
}).map(each => each.ariaLabel || each.id || each.textContent.trim() || each.tagName)"""


@pytest.mark.parametrize("width", [360, 420, 768, 1920])
def test_nothing_is_cut_off(page, width):
    lights = ";".join(
        f"{azimuth},-12.345,1,0.5,0.314159,12.25" for azimuth in (-180, -100.25, 90.5, 100, 120.75)
    )
    power = "lobe:g-power;factor:0.314159;offset:-12.3456;m:0.314159"
    more = f"lights={lights}&budget=2.5&camera=azimuth:-28"
    page.set_viewport_size({"width": width, "height": 900})
    try:
        for term, show in ((power, "difference"), ("model:ward-printed", "wipe")):
            look(page, f"a={term}&b={term}&{more}&show={show}")
            assert page.evaluate(CUT) == []
            assert page.evaluate("document.documentElement.scrollWidth") <= width
    finally:
        page.set_viewport_size(VIEW["viewport"])


@pytest.mark.parametrize(
    ("width", "height", "ratio"),
    [(1280, 800, 1), (1366, 768, 1.25), (1920, 1080, 1.5), (1280, 800, 2)],
)
def test_canvas_has_one_pixel_per_device_pixel(browser, written, width, height, ratio):
    screen = {"viewport": {"width": width, "height": height}, "device_scale_factor": ratio}
    with opened(browser, written[0], "#show=a", **screen) as page:
        page.add_style_tag(content=OVERLAYS)
        linear = images(page)[0]
        shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
        box = page.evaluate("document.getElementById('canvas').getBoundingClientRect().toJSON()")
    left, top, right, bottom = (round(ratio * box[x]) for x in ("left", "top", "right", "bottom"))
    assert linear.shape[:2] == (bottom - top, right - left)
    drawn = 255.0 * linear_to_srgb(linear[..., :3])
    assert np.ptp(drawn) > 200
    assert np.abs(shown[top:bottom, left:right] - drawn).max() <= 0.6


def test_maps_differ_by_less_than_a_level():
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    texture = Texture(lambda: Image.fromarray(noise), "noise")
    image = Image.open(io.BytesIO(encoded(texture, "color")), formats=["PNG"])
    np.testing.assert_array_equal(image, noise[::-1])
    large = Texture(lambda: Image.new("RGB", (4096, 16)), "large")
    assert Image.open(io.BytesIO(encoded(large, "data"))).size == (2048, 8)
