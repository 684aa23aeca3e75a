"""Tests the npm package in Chromium: Babylon.js draws the same as OpenGL, and the examples for
three.js and Babylon.js agree with the float64 BRDF."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender import brdf
from facerender.commands.shaders import functions
from facerender.images.image import linear_to_srgb
from facerender.scene.light import LIGHTS
from tests.conftest import missing, node_tool
from tests.test_hosts import SCENES, check
from tests.verification.hosts import babylon as in_babylon
from tests.verification.hosts import desktop, draw, served

pytestmark = pytest.mark.node

ROOT = Path(__file__).parents[1]
OFFLINE = re.compile("ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ETIMEDOUT|ENETUNREACH")
# Pixels in the highlights of both lights; a window of 1200 x 800 has views of 399 x 713 pixels.
POINTS = {
    "sphere": [(150, 290), (190, 315), (170, 340), (130, 315), (290, 265), (310, 265), (270, 290)],
    "head": [(210, 240), (190, 215), (230, 240), (270, 190), (290, 190), (190, 340), (270, 365)],
}


def install(folder: Path, *options: str) -> None:
    """Install the npm packages of a folder's lock file."""
    npm = [node_tool("npm"), "ci", "--prefer-offline", "--no-audit", "--no-fund", *options]
    environment = {**os.environ, "NODE_USE_SYSTEM_CA": "1"}  # for certificates of proxies
    installed = subprocess.run(npm, cwd=folder, env=environment, capture_output=True, text=True)
    if installed.returncode and OFFLINE.search(installed.stderr):
        missing("the npm registry cannot be reached")
    assert installed.returncode == 0, installed.stderr


@contextmanager
def opened(browser, address: str, ignored: str = "", **options):
    """Open a page whose script sets window.probe; at the end, check its console messages.

    ignored : pattern of allowed messages
    """
    page = browser.new_page(**options)
    logged = []
    page.on("console", lambda message: logged.append(message.text))
    page.on("pageerror", lambda error: logged.append(str(error)))
    page.goto(address)
    page.wait_for_function("window.probe")
    yield page
    page.close()
    assert [text for text in logged if not (ignored and re.search(ignored, text))] == []


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    """The folder of the npm package."""
    folder = tmp_path_factory.mktemp("package")
    subprocess.run([sys.executable, ROOT / "tools/npm-package", "-o", folder], check=True)
    return folder


@pytest.fixture(scope="module")
def engines(tmp_path_factory) -> Path:
    """The folder where the JavaScript engines are installed."""
    folder = tmp_path_factory.mktemp("engines")
    for path in (ROOT / "tests/verification/engines").glob("[.p]*[cn]"):
        shutil.copy(path, folder)
    install(folder, "--ignore-scripts")
    return folder


# --- the package ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def installed(package: Path, tmp_path_factory) -> Path:
    """The folder of the packed and installed package."""
    folder = tmp_path_factory.mktemp("npm")
    (folder / "package.json").write_text("{}")
    archive = f"facerender-shaders-{fr.__version__}.tgz"
    for command in (["pack", package], ["install", "--offline", f"./{archive}"]):
        subprocess.run([node_tool("npm"), *command], cwd=folder, check=True, capture_output=True)
    return folder / "node_modules/facerender-shaders"


@pytest.mark.slow
@pytest.mark.smoke
def test_exports_are_complete_flat_sources(installed):
    code = 'import * as all from "facerender-shaders"; console.log(JSON.stringify(all))'
    command = [node_tool("node"), "--input-type=module", "--eval", code]
    output = subprocess.run(command, cwd=installed, check=True, capture_output=True, text=True)
    exports = json.loads(output.stdout)
    names: dict[str, list[str]] = {}
    for function in functions():
        words = re.split("[/_.]", function.file)[1:-1]
        name = words[0] + "".join(map(str.capitalize, words[1:]))
        names.setdefault(name, []).append(function.name)
    assert exports.keys() == names.keys() >= {"cookTorrance", "wardPrinted", "lobeGPower"}
    types = (installed / "index.d.ts").read_text(encoding="utf-8")
    for name, source in exports.items():
        assert all(f" {function}(" in source for function in names[name])
        assert not re.search(r"^\s*#(include|version)", source, re.MULTILINE)
        assert f"\n */\nexport const {name}: string;\n" in types
    assert types.count("/**\n") == types.count("\n */\n") == len(names)
    for file in (fr.shader_dir() / "facerender").rglob("*.glsl"):
        packed = installed / "glsl" / file.relative_to(fr.shader_dir())
        assert packed.read_bytes() == file.read_bytes()
    for file in (ROOT / "docs/languages").iterdir():
        text = (installed / "languages" / file.name).read_text(encoding="utf-8")
        # SPIRV-Cross of Debian 13 writes powr.
        assert text.replace("powr(", "pow(") == file.read_text(encoding="utf-8"), "make npm"
    assert {"LICENSE", "README.md"} <= {path.name for path in installed.iterdir()}


# --- engines -------------------------------------------------------------------------------------


def test_babylon_js_draws_the_same_as_opengl(egl, engines, browser):
    check(draw(partial(in_babylon, engines), SCENES)[1], desktop(SCENES)[1])


@pytest.mark.parametrize(
    ("values", "f0", "f90", "ignored"),
    [
        ("", 0.04, 1.0, ""),
        ("specularIntensity: 0", 0.0, 0.0, ""),
        ("specularIntensity: 0.25, specularColor: [1, 0.5, 0]", [0.01, 0.005, 0.0], 0.25, ""),
        ("specularIntensityMap: texel(0, 0, 0, 51)", 0.008, 0.2, ""),
        ("specularIntensity: 0, metalness: 1, color: [0.5, 0.2, 1]", [0.5, 0.2, 1.0], 1.0, ""),
        ("ior: 2, clearcoatRoughness: 1", 1 / 9, 1.0, ""),
        ("anisotropy: 0.8", 0.04, 1.0, "anisotropy"),
        ("iridescence: 1, anisotropy: 1", 0.04, 1.0, "anisotropy,iridescence"),
    ],
)
def test_three_js_snippet_of_the_documentation(
    package, engines, browser, tmp_path, values, f0, f90, ignored
):
    """The unchanged snippet draws an oblique surface with one light behind it."""
    document = (ROOT / "docs/shaders.md").read_text(encoding="utf-8")
    snippet = re.search(r"```js\n(.*?)```", document, re.DOTALL)[1]
    (tmp_path / "three").symlink_to(engines / "node_modules/three")
    (tmp_path / "shaders").symlink_to(package)
    names = {"three": "./three/build/three.module.js", "facerender-shaders": "./shaders/index.js"}
    light = np.array([1.0, 0.3, -0.6])
    (tmp_path / "index.html").write_text(
        f"""<!doctype html><link rel="icon" href="data:,">
        <script type="importmap">{json.dumps({"imports": names})}</script>
        <script type="module">
        import * as THREE from "three";
        {snippet}
        const texel = (...values) => {{
          const texture = new THREE.DataTexture(new Uint8Array(values), 1, 1);
          texture.needsUpdate = true;
          return texture;
        }};
        const values = {{ color: [0, 0, 0], roughness: 0.6, metalness: 0, {values} }};
        for (const [name, value] of Object.entries(values))
          if (Array.isArray(value)) values[name] = new THREE.Color(...value);
        material.setValues(values);
        window.warnings = [];
        console.warn = (text) => warnings.push(text);
        const scene = new THREE.Scene();
        const light = new THREE.DirectionalLight(0xffffff, 1);
        light.position.set({", ".join(map(str, light))});
        const mesh = new THREE.Mesh(new THREE.PlaneGeometry(4, 4), material);
        mesh.rotation.y = 1.3;
        scene.add(light, mesh);
        const camera = new THREE.OrthographicCamera(-1, 1, 1, -1);
        camera.position.z = 1;
        const renderer = new THREE.WebGLRenderer();
        const target = new THREE.WebGLRenderTarget(1, 1, {{ type: THREE.FloatType }});
        renderer.setRenderTarget(target);
        renderer.render(scene, camera);
        const pixel = new Float32Array(4);
        renderer.readRenderTargetPixels(target, 0, 0, 1, 1, pixel);
        window.probe = [...pixel];
        </script>"""
    )
    with served(tmp_path) as address, opened(browser, address, "ReadPixels") as page:
        drawn, warnings = page.evaluate("[probe, warnings]")
    names = filter(None, ignored.split(","))
    n, v = np.array([np.sin(1.3), 0.0, np.cos(1.3)]), np.array([0.0, 0.0, 1.0])
    l = light / np.linalg.norm(light)
    v_dot_h = np.linalg.norm(l + v) / 2
    grazing = (1.0 - v_dot_h) ** 5
    fresnel = np.array(f0) + (f90 - np.array(f0)) * grazing
    whole = brdf.cook_torrance(n, l, v, 0.6**2, 0.0) / grazing * (n @ l)
    assert whole * grazing > 1e-3
    assert v_dot_h < 0.51, "F90 matters"
    np.testing.assert_allclose(drawn[:3], np.ones(3) * fresnel * whole, rtol=1e-5, atol=1e-9)
    assert warnings == [f"The specular term of facerender ignores {name}." for name in names]


# --- examples ------------------------------------------------------------------------------------


def reference(n, eye, position, lights, m: float, lobe: str):
    """Return the specular radiance of lights, given as directions and irradiances, in float64."""
    v = (eye - position) / np.linalg.norm(eye - position)
    return sum(
        np.asarray(irradiance) * max(n @ l, 0.0) * brdf.cook_torrance(n, l, v, m, 0.028, lobe=lobe)
        for l, irradiance in lights
    )


@pytest.fixture(scope="module")
def babylon(package, engines, browser, tmp_path_factory):
    """The page of the Babylon.js example."""
    folder = tmp_path_factory.mktemp("babylonjs")
    for path in (ROOT / "examples/babylonjs").glob("*.[hj]*"):
        shutil.copy(path, folder)
    asked, own = (
        json.loads((each / "package.json").read_text())["dependencies"]["babylonjs"]
        for each in (folder, engines)
    )
    assert asked == own, "what is installed is what the example asks for"
    (folder / "node_modules").mkdir()
    (folder / "node_modules/babylonjs").symlink_to(engines / "node_modules/babylonjs")
    (folder / "node_modules/facerender-shaders").symlink_to(package)
    size, ignored = {"width": 600, "height": 600}, r"Babylon\.js v|ReadPixels"
    with served(folder) as at, opened(browser, at, ignored, viewport=size) as page:
        yield page


@pytest.mark.parametrize("lobe", ["exact", "d16", "fitted"])
def test_highlights_of_the_babylonjs_example(babylon, lobe):
    babylon.select_option("#lobe", lobe)
    brightest = 0.0
    for at in [(225, 210), (260, 200), (300, 250), (420, 250), (460, 240)]:
        found = babylon.evaluate("at => probe(...at)", at)
        n, eye, place = (np.array(found[name]) for name in ("normal", "eye", "place"))
        assert np.linalg.norm(place) == pytest.approx(1.0, abs=2e-3)
        lights = [(np.array(each["towards"]), each["irradiance"]) for each in found["lights"]]
        expected = reference(n, eye, place, lights, 0.3, lobe)
        np.testing.assert_allclose(found["specular"], expected, rtol=1e-3, atol=1e-6)
        brightest = max(brightest, expected.max())
    assert brightest > 0.1


@pytest.fixture(scope="module")
def site(package, tmp_path_factory) -> Iterator[str]:
    """The address of a built copy of the three.js example."""
    root = tmp_path_factory.mktemp("threejs")
    example = root / "examples" / "threejs"
    ignore = shutil.ignore_patterns("node_modules", "dist")
    shutil.copytree(ROOT / "examples/threejs", example, ignore=ignore)
    (root / "assets").mkdir()
    shutil.copy(ROOT / "assets/head.glb", root / "assets")
    shutil.copytree(package, root / "out/npm")
    install(example)
    vite = [node_tool("node"), "node_modules/vite/bin/vite.js", "build"]
    subprocess.run(vite, cwd=example, check=True)
    with served(example / "dist") as address:
        yield address


@pytest.fixture(scope="module")
def three(site, browser):
    """A page shared by tests that set its state."""
    with opened(browser, site, viewport={"width": 1200, "height": 800}) as page:
        yield page


@pytest.fixture
def moved(site, browser):
    """A page for one test that changes the camera or the window."""
    with opened(browser, site, viewport={"width": 1200, "height": 800}) as page:
        yield page


@pytest.mark.parametrize("shape", POINTS)
def test_highlights_agree_with_float64(three, shape):
    """Errors are at most 1e-3 of max(reference, 1e-3); a white diffuse surface shows about 1."""
    three.select_option("#shape", shape)
    three.check("#specular")
    lights = [(light.direction, light.irradiance) for light in (LIGHTS["key"], LIGHTS["rim"])]
    brightest = 0.0
    for m, lobe in [(0.15, "d16"), (0.4, "d16"), (0.4, "fitted")]:
        three.fill("#m", str(m))
        three.select_option("#lobe", lobe)
        probed = three.evaluate("points => points.map(at => probe(...at))", POINTS[shape])
        for point, values in zip(POINTS[shape], probed, strict=True):
            found = {name: np.array(value) for name, value in values.items()}
            normal, position, eye = found["normal"], found["position"], found["eye"]
            if shape == "sphere":
                assert np.linalg.norm(position) == pytest.approx(0.1, rel=3e-4)
                np.testing.assert_allclose(normal, position / 0.1, atol=1e-3)
            for name, used in [("exact", "exact"), ("approximation", lobe)]:
                expected = reference(normal, eye, position, lights, m, used)
                error = np.abs(found[name] - expected) / np.maximum(expected, 1e-3)
                assert error.max() < 1e-3, (name, m, point)
                brightest = max(brightest, expected.max())
    assert brightest > 0.2


def test_views_show_both_images_and_their_difference(three):
    three.select_option("#shape", "sphere")
    three.check("#specular")
    three.fill("#m", "0.4")
    three.select_option("#lobe", "d16")
    three.wait_for_timeout(500)  # until the next frame is drawn
    views = [
        np.asarray(Image.open(io.BytesIO(figure.screenshot())).convert("RGB")) / 255
        for figure in three.locator("figure").all()
    ]
    for x, y in POINTS["sphere"]:
        found = three.evaluate("at => probe(...at)", [x, y])
        exact, approximation = np.array(found["exact"]), np.array(found["approximation"])
        difference = 8.0 * (approximation - exact) @ [0.2126, 0.7152, 0.0722]
        brighter, darker = np.maximum(difference, 0.0), np.maximum(-difference, 0.0)
        signed = brighter * np.array([1.0, 0.32, 0.07]) + darker * np.array([0.1, 0.45, 1.0])
        for view, linear in zip(views, (exact, approximation, signed), strict=True):
            np.testing.assert_allclose(view[y, x], linear_to_srgb(linear), atol=4 / 255)


def test_dragging_turns_the_shape(moved):
    before = moved.evaluate("probe(200, 350).eye")
    moved.mouse.move(600, 400)
    moved.mouse.down()
    moved.mouse.move(500, 420)
    moved.mouse.up()
    after = moved.evaluate("probe(200, 350).eye")
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))
    assert np.linalg.norm(np.subtract(after, before)) > 0.1


def test_page_fits_a_phone(moved):
    moved.set_viewport_size({"width": 420, "height": 800})
    inside = "[document.body.scrollWidth <= innerWidth, document.body.scrollHeight <= innerHeight]"
    assert moved.evaluate(inside) == [True, True]
    sizes = [figure.bounding_box() for figure in moved.locator("figure").all()]
    assert min(min(size["width"], size["height"]) for size in sizes) > 180
