"""The wheel works away from the checkout, and the package's rooms keep their doors."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import require_backend

ROOT = Path(__file__).parents[1]

# What may be imported without OpenGL; see the arrows in CONTRIBUTING.md.
WITHOUT_GL = [
    *("errors", "data", "image", "lobes", "brdf", "shading", "loading"),
    *("glsl.library", "glsl.catalogue", "glsl.includes"),
    *("scenes.scene", "scenes.file", "scenes.view", "scenes.texture"),
    *("drawing.frame", "drawing.reference", "drawing.prepare"),
    *("comparison.gates", "comparison.flip", "comparison.pictures"),
    *("comparison.goldens", "comparison.report", "page.document"),
    *("pricing.amd", "pricing.interval", "pricing.variants"),
    *("measure.measurement", "measure.pareto", "measure.tables", "measure.plots", "measure.report"),
]


@pytest.mark.parametrize("module", WITHOUT_GL)
def test_modules_without_opengl_do_not_import_it(module):
    code = (
        "import sys, types; sys.modules['moderngl'] = sys.modules['glcontext'] = None\n"
        "package = sys.modules['facerender'] = types.ModuleType('facerender')\n"
        f"package.__path__ = [{str(ROOT / 'facerender')!r}]\n"
        "package.__version__ = '0'\n"
        f"import facerender.{module}\n"
        "assert 'facerender.commands' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_package_leaves_the_heavy_ones_alone():
    code = "import sys, facerender\nprint(*{'trimesh', 'scipy', 'PIL', 'pyrr'} & set(sys.modules))"
    output = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    assert output.stdout.strip() == ""


def test_wheel_renders_away_from_the_checkout(tmp_path):
    require_backend("egl")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", tmp_path, ROOT], check=True)
    (wheel,) = tmp_path.glob("facerender-*.whl")
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--target", site, wheel], check=True)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    code = (
        "import facerender, sys; from facerender.commands import main\n"
        f"assert facerender.__file__.startswith({str(site)!r})\n"
        f"assert str(facerender.shader_dir()).startswith({str(site)!r})\n"
        "assert main(['render', '-o', 'head.png', '--size', '64']) == 0\n"
        "sys.exit(main(['compare', 'head.png', 'head.png', '--report', 'report.html']))"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=environment)
    assert (tmp_path / "head.png").stat().st_size > 1000
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in ("page.css", "viewer.js"):
        assert (ROOT / "facerender" / "page" / name).read_text(encoding="utf-8") in report
    assert (site / "facerender" / "measure" / "reproduce" / "scalar.c").is_file()
    command = [sys.executable, "-m", "pytest", "--facerender-unused=fail"]  # it knows the plugin
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True)
    assert result.returncode == pytest.ExitCode.NO_TESTS_COLLECTED
