"""The three.js example in Chromium: what its material draws is the float64 BRDF."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from facerender.images.srgb import linear_to_srgb
from facerender.scenes.light import LIGHTS
from tests.conftest import missing, node_tool

ROOT = Path(__file__).parents[1]
OFFLINE = re.compile("ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ETIMEDOUT|ENETUNREACH")
# Pixels of a view of 399 x 713 at 1200 x 800: the highlights of both lights.
POINTS = {
    "sphere": [(150, 290), (190, 315), (170, 340), (130, 315), (290, 265), (310, 265), (270, 290)],
    "head": [(210, 240), (190, 215), (230, 240), (270, 190), (290, 190), (190, 340), (270, 365)],
}


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Address of the built example. The copy keeps the checkout free of node_modules."""
    root = tmp_path_factory.mktemp("threejs")
    example = root / "examples" / "threejs"
    ignore = shutil.ignore_patterns("node_modules", "dist")
    shutil.copytree(ROOT / "examples/threejs", example, ignore=ignore)
    (root / "assets").mkdir()
    shutil.copy(ROOT / "assets/head.glb", root / "assets")
    subprocess.run([sys.executable, ROOT / "tools/npm-package", "-o", root / "out/npm"], check=True)
    npm = [node_tool("npm"), "ci", "--prefer-offline", "--no-audit", "--no-fund"]
    environment = {**os.environ, "NODE_USE_SYSTEM_CA": "1"}  # behind a proxy with its own
    installed = subprocess.run(npm, cwd=example, env=environment, capture_output=True, text=True)
    if installed.returncode and OFFLINE.search(installed.stderr):
        missing("the npm registry cannot be reached")
    assert installed.returncode == 0, installed.stderr
    vite = [node_tool("node"), "node_modules/vite/bin/vite.js", "build"]
    subprocess.run(vite, cwd=example, check=True)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=example / "dist"))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()


@contextmanager
def loaded(site, browser):
    """The page, which must have nothing to say in the console."""
    page = browser.new_page(viewport={"width": 1200, "height": 800})
    said = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.goto(site)
    page.wait_for_function("window.probe")
    yield page
    page.close()
    assert said == []


@pytest.fixture(scope="module")
def page(site, browser):
    """One for tests that say what they look at."""
    with loaded(site, browser) as page:
        yield page


@pytest.fixture
def moved(site, browser):
    """One for a test that moves the eye or the window."""
    with loaded(site, browser) as page:
        yield page


def reference(n, eye, position, m, lobe):
    """Specular radiance of the example's two lights in float64."""
    v = (eye - position) / np.linalg.norm(eye - position)
    lights = [(light.direction, light.irradiance) for light in (LIGHTS["key"], LIGHTS["rim"])]
    return sum(
        np.asarray(irradiance)
        * max(n @ l, 0.0)
        * fr.brdf.cook_torrance(n, l, v, m, 0.028, lobe=lobe)
        for l, irradiance in lights
    )


@pytest.mark.parametrize("shape", POINTS)
def test_highlights_are_the_float64_brdf(page, shape):
    """Within 1e-3 of max(reference, 1e-3), where a white diffuse surface shows about 1."""
    page.select_option("#shape", shape)
    page.check("#specular")
    brightest = 0.0
    for m, lobe in [(0.15, "d16"), (0.4, "d16"), (0.4, "fitted")]:
        page.fill("#m", str(m))
        page.select_option("#lobe", lobe)
        probed = page.evaluate("points => points.map(at => probe(...at))", POINTS[shape])
        for point, values in zip(POINTS[shape], probed, strict=True):
            found = {name: np.array(value) for name, value in values.items()}
            normal, position, eye = found["normal"], found["position"], found["eye"]
            if shape == "sphere":
                assert np.linalg.norm(position) == pytest.approx(0.1, rel=3e-4)
                np.testing.assert_allclose(normal, position / 0.1, atol=1e-3)
            for name, used in [("exact", "exact"), ("approximation", lobe)]:
                expected = reference(normal, eye, position, m, used)
                error = np.abs(found[name] - expected) / np.maximum(expected, 1e-3)
                assert error.max() < 1e-3, (name, m, point)
                brightest = max(brightest, expected.max())
    assert brightest > 1.0


def test_views_show_both_pictures_and_eight_times_their_difference(page):
    page.select_option("#shape", "sphere")
    page.check("#specular")
    page.fill("#m", "0.4")
    page.select_option("#lobe", "d16")
    page.wait_for_timeout(500)  # for the frame that the controls asked for
    views = [
        np.asarray(Image.open(io.BytesIO(figure.screenshot())).convert("RGB")) / 255
        for figure in page.locator("figure").all()
    ]
    for x, y in POINTS["sphere"]:
        found = page.evaluate("at => probe(...at)", [x, y])
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


def test_page_fits_a_telephone(moved):
    moved.set_viewport_size({"width": 420, "height": 800})
    inside = "[document.body.scrollWidth <= innerWidth, document.body.scrollHeight <= innerHeight]"
    assert moved.evaluate(inside) == [True, True]
    sizes = [figure.bounding_box() for figure in moved.locator("figure").all()]
    assert min(min(size["width"], size["height"]) for size in sizes) > 180
