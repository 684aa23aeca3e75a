"""The library in hosts with preprocessors and compilers of their own: each draws as OpenGL does."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import missing, node_tool, require_module
from trials.hosts import CHOICES, ENGINES, HOSTS, SCENE, desktop, draw

MODULES = {"naga": "wgpu", "glslc": "wgpu", "vispy": "vispy", "Panda3D": "panda3d"}
SCENES = [f"{macros}{SCENE}" for macros in CHOICES.values()]
OFFLINE = re.compile("ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ETIMEDOUT|ENETUNREACH")


@pytest.fixture(scope="session")
def engines(tmp_path_factory) -> Path:
    """Folder where the engines of the web are installed."""
    folder = tmp_path_factory.mktemp("engines")
    for path in (Path(__file__).parents[1] / "trials/engines").glob("[.p]*[cn]"):
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
