"""Tests that ``facerender compare`` and the pytest plugin work without the rendering packages and
load no OpenGL library."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facerender.images.files import save_exr
from tests.test_package import ROOT

# Runs first in a process: hides all modules that do not belong to these packages.
ALONE = """
import sys
from importlib.metadata import packages_distributions

NEEDED = {"numpy", "pillow", "openexr", "facerender"}
OF_PYTEST = {"pytest", "pluggy", "iniconfig", "packaging", "pygments"}
HIDDEN = {
    name for name, homes in packages_distributions().items()
    if not {home.lower() for home in homes} & (NEEDED | OF_PYTEST)
}

class Refusing:
    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        hidden = name.partition(".")[0] in HIDDEN
        return None if hidden else self.finder.find_spec(name, path, target)

sys.meta_path[:] = [Refusing(finder) for finder in sys.meta_path]
assert {"moderngl", "glcontext", "trimesh", "scipy", "tqdm", "OpenGL"} <= HIDDEN
"""
COMMAND = """
import sys
from facerender.commands import main
status = main(sys.argv[1:])
with open("/proc/self/maps") as maps:
    libraries = {line.split("/")[-1].strip() for line in maps if "/" in line}
drawing = [name for name in libraries if name.startswith(("libGL", "libEGL", "libOSMesa", "mgl"))]
assert not drawing, drawing
assert not {"moderngl", "glcontext", "trimesh", "scipy"} & set(sys.modules)
sys.exit(status)
"""
SUITE = """
import numpy as np

def test_same(facerender_snapshot):
    facerender_snapshot.check(np.full((40, 40, 3), 0.5, np.float32))

def test_other(facerender_snapshot):
    facerender_snapshot.check(np.full((40, 40, 3), 0.5, np.float32))
"""


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """A folder with the different images a.exr and b.exr."""
    for name, value in (("a", 0.5), ("b", 0.6)):
        save_exr(tmp_path / f"{name}.exr", np.full((40, 40, 3), value, np.float32), {})
    return tmp_path


@pytest.fixture
def alone(tmp_path: Path) -> dict[str, str]:
    """The environment of a process in which only these packages can be imported."""
    folder = tmp_path / "alone"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(ALONE)
    paths = os.pathsep.join(map(str, (folder, ROOT)))
    return {**os.environ, "PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}


def run(command: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_compare_needs_no_rendering_packages(images, alone):
    command = ["-c", COMMAND, "compare", "a.exr", "b.exr", "--report", "report.html", "--json"]
    status, output = run(command, images, alone)
    assert (status, '"same": false' in output) == (1, True), output
    assert (images / "report.html").stat().st_size > 1000


@pytest.mark.slow
def test_rendering_names_the_missing_package(images, alone):
    """This shows that the packages are hidden."""
    status, output = run(["-m", "facerender", "render", "-o", "a.png"], images, alone)
    assert status != 0
    assert "No module named 'glcontext'" in output


@pytest.mark.slow
def test_plugin_needs_no_rendering_packages(images, alone):
    suite = images / "test_suite.py"
    suite.write_text(SUITE)
    goldens = images / "goldens/test_suite"
    goldens.mkdir(parents=True)
    save_exr(goldens / "test_other.exr", np.full((40, 40, 3), 0.6, np.float32), {})
    command = ["-m", "pytest", "-q", "-p", "facerender.pytest_plugin", "-p", "no:cacheprovider"]
    command += ["--facerender-update-missing", "--facerender-report", "report"]
    status, output = run(command, images, alone)
    assert (status, "1 failed, 1 passed" in output) == (1, True), output
    assert (goldens / "test_same.exr").exists()
    assert "test_other differs from its golden" in output
    assert (images / "report/index.html").stat().st_size > 1000
