"""The library in hosts with preprocessors and compilers of their own: each draws as OpenGL does."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facerender import brdf
from tests.conftest import missing, node_tool, require_module
from tests.verification.hosts import CHOICES, ENGINES, HOSTS, SCENE, desktop, draw, served

ROOT = Path(__file__).parents[1]
MODULES = {"naga": "wgpu", "glslc": "wgpu", "vispy": "vispy", "Panda3D": "panda3d"}
SCENES = [f"{macros}{SCENE}" for macros in CHOICES.values()]
OFFLINE = re.compile("ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ETIMEDOUT|ENETUNREACH")


@pytest.fixture(scope="session")
def engines(tmp_path_factory) -> Path:
    """Folder where the engines of the web are installed."""
    folder = tmp_path_factory.mktemp("engines")
    for path in (ROOT / "tests/verification/engines").glob("[.p]*[cn]"):
        shutil.copy(path, folder)
    npm = [
        node_tool("npm"),
        "ci",
        "--prefer-offline",
        "--ignore-scripts",
        "--no-audit",
        "--no-fund",
    ]
    environment = {**os.environ, "NODE_USE_SYSTEM_CA": "1"}  # behind a proxy with its own
    installed = subprocess.run(npm, cwd=folder, env=environment, capture_output=True, text=True)
    if installed.returncode and OFFLINE.search(installed.stderr):
        missing("the npm registry cannot be reached")
    assert installed.returncode == 0, installed.stderr
    return folder


@pytest.fixture(scope="module")
def expected(egl) -> list[np.ndarray]:
    return desktop(SCENES)[1]


def check(images: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """Within 1e-6 of the value, or of the largest one where that is less."""
    for name, image, other in zip(CHOICES, images, expected, strict=True):
        assert other.max((0, 1)).min() > 0.01, "something is drawn"
        error = np.abs(image - other) / other.max((0, 1))
        assert error.max() < 1e-6, name


def test_choices_are_different_pictures(expected):
    defaults, choices, small, every = expected
    assert np.abs(choices - defaults).max((0, 1)).min() > 1e-3
    assert 0.0 < np.abs(small - defaults).max() < 1e-5
    np.testing.assert_array_equal(every, defaults)


@pytest.mark.parametrize("host", HOSTS)
def test_hosts_draw_what_opengl_does(host, expected):
    if host in MODULES:
        require_module(MODULES[host])
    try:
        _, images = draw(host, SCENES)
    except FileNotFoundError as error:
        missing(f"no {error.filename}: tools/system-libraries --tests")
    check(images, expected)


@pytest.mark.parametrize("host", ENGINES)
def test_engines_of_the_web_draw_what_opengl_does(host, expected, engines, browser):
    _, images = draw(host, SCENES, engines)
    check(images, expected)


@pytest.fixture(scope="module")
def page(engines, browser, tmp_path_factory):
    """The example for Babylon.js, which must have nothing to say in the console."""
    folder = tmp_path_factory.mktemp("babylonjs")
    example = ROOT / "examples/babylonjs"
    for path in example.glob("*.[hj]*"):
        shutil.copy(path, folder)
    versions = [json.loads(path.read_text())["dependencies"]["babylonjs"]
                for path in (folder / "package.json", engines / "package.json")]  # fmt: skip
    assert versions[0] == versions[1], "what is installed is what the example asks for"
    (folder / "node_modules").mkdir()
    (folder / "node_modules/babylonjs").symlink_to(engines / "node_modules/babylonjs")
    package = folder / "node_modules/facerender-shaders"
    subprocess.run([sys.executable, ROOT / "tools/npm-package", "-o", package], check=True)
    with served(folder) as address:
        page = browser.new_page(viewport={"width": 600, "height": 600})
        said = []
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(address)
        page.wait_for_function("window.probe")
        yield page
        page.close()
    assert [text for text in said if "Babylon.js v" not in text and "ReadPixels" not in text] == []


@pytest.mark.parametrize("lobe", ["exact", "d16", "fitted"])
def test_highlights_of_the_babylonjs_example_are_the_float64_brdf(page, lobe):
    page.select_option("#lobe", lobe)
    brightest = 0.0
    for x, y in [(225, 210), (260, 200), (300, 250), (420, 250), (460, 240)]:
        found = page.evaluate("at => probe(...at)", [x, y])
        n, place = np.array(found["normal"]), np.array(found["place"])
        assert np.linalg.norm(place) == pytest.approx(1.0, abs=2e-3)
        eye = np.array(found["eye"]) - place
        v = eye / np.linalg.norm(eye)
        expected = sum(
            np.array(light["irradiance"])
            * max(n @ light["towards"], 0.0)
            * brdf.cook_torrance(n, np.array(light["towards"]), v, 0.3, 0.028, lobe=lobe)
            for light in found["lights"]
        )
        np.testing.assert_allclose(found["specular"], expected, rtol=1e-3, atol=1e-6)
        brightest = max(brightest, expected.max())
    assert brightest > 0.1


def test_three_js_draws_with_the_brdf_of_docs_shaders_md(engines, browser, tmp_path):
    """The snippet as it stands there: a surface seen along its normal, in one light."""
    document = (ROOT / "docs/shaders.md").read_text(encoding="utf-8")
    snippet = re.search(r"```js\n(.*?)```", document, re.DOTALL)[1]
    package = tmp_path / "node_modules/facerender-shaders"
    subprocess.run([sys.executable, ROOT / "tools/npm-package", "-o", package], check=True)
    (tmp_path / "node_modules/three").symlink_to(engines / "node_modules/three")
    names = {
        "three": "./node_modules/three/build/three.module.js",
        "facerender-shaders": "./node_modules/facerender-shaders/index.js",
    }
    light = np.array([1.0, 2.0, 4.0])
    (tmp_path / "index.html").write_text(
        f"""<!doctype html><link rel="icon" href="data:,">
        <script type="importmap">{json.dumps({"imports": names})}</script>
        <script type="module">
        import * as THREE from "three";
        {snippet}
        material.setValues({{ color: 0, roughness: 0.6, metalness: 0 }});
        const scene = new THREE.Scene();
        const light = new THREE.DirectionalLight(0xffffff, 1);
        light.position.set({", ".join(map(str, light))});
        scene.add(light, new THREE.Mesh(new THREE.PlaneGeometry(4, 4), material));
        const camera = new THREE.OrthographicCamera(-1, 1, 1, -1);
        camera.position.z = 1;
        const renderer = new THREE.WebGLRenderer();
        const target = new THREE.WebGLRenderTarget(1, 1, {{ type: THREE.FloatType }});
        renderer.setRenderTarget(target);
        renderer.render(scene, camera);
        const pixel = new Float32Array(4);
        renderer.readRenderTargetPixels(target, 0, 0, 1, 1, pixel);
        window.pixel = [...pixel];
        </script>"""
    )
    with served(tmp_path) as address:
        page = browser.new_page()
        said = []
        page.on("console", lambda message: said.append(message.text))
        page.goto(address)
        drawn = page.wait_for_function("window.pixel").json_value()
        page.close()
    n, l = np.array([0.0, 0.0, 1.0]), light / np.linalg.norm(light)
    expected = brdf.cook_torrance(n, l, n, 0.6**2, 0.04) * (n @ l)
    assert expected > 1e-3
    np.testing.assert_allclose(drawn[:3], expected, rtol=1e-5)
    assert not [text for text in said if "ReadPixels" not in text]
